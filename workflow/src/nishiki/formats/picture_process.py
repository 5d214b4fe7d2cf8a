"""Decode pictures in a child process, which limits the resources of a hostile or damaged file.

The child is started once and kept, one for each thread that reads at the same time. It gets an open file, never a name;
answers are JSON, and pixels lie in memory that both map, so that nothing is copied. Each request has its own limits,
which the system enforces: address space, from what the header claims, and processor time, from the decoded size. A
child that exceeds them, or whose decoder breaks down, costs one CaptureError; the next request starts another child.
"""

import atexit
import json
import mmap
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nishiki.formats.coding import coding_from
from nishiki.formats.files import read_bytes
from nishiki.formats.picture_files import RAW_SUFFIXES, Exif, ImageHeader, Picture, Wanted, open_jpeg, open_png
from nishiki.formats.problems import CaptureError, Problem, error, refuse

LEAST_MEMORY = 512 << 20  # bytes of address space beyond the idle child's: libraries, a file's directory
THREAD_MEMORY = 16 << 20  # bytes of address space for each processor: libraries start a thread for each
MEMORY_FACTOR = 4  # copies of a decoded picture that a decoder may hold
LEAST_SECONDS, BYTES_A_SECOND = 20, 4 << 20  # processor time; the slowest codec, LZMA, unpacks ten times as much
MESSAGE = 1 << 16
COPY_AGAIN = "Copy the file again from the camera or the archive"
_START = "import sys; sys.path[:] = sys.argv[2:]; from nishiki.formats.picture_process import serve; serve()"


def request_header(handle: int, suffix: str, name: str) -> ImageHeader:
    """Read the header of an open picture. CaptureError (image-unreadable, image-truncated, image-unsupported, ...)."""
    answer, _ = _ask({"do": "header", "suffix": suffix, "name": name}, handle, 0)
    values = answer["header"]
    built = {"names": tuple(values["names"]), "coding": coding_from(values["coding"]), "exif": Exif(**values["exif"])}
    return ImageHeader(**{**values, **built})


def request_codes(handle: int, header: ImageHeader, suffix: str, name: str, wanted: dict[str, Any]) -> np.ndarray:
    """Read codes (rows, columns, channels) of an open picture, alpha included, in memory shared with the child.

    wanted: channels, luma, and region (row, column, rows, columns) or None. CaptureError as `request_header`.
    """
    size = header.decoded_bytes + os.fstat(handle).st_size
    answer, memory = _ask({"do": "codes", "suffix": suffix, "name": name, **wanted}, handle, size)
    if memory is None:
        raise ValueError("the decoder sent no pixels")
    shape, dtype = tuple(answer["shape"]), np.dtype(answer["dtype"])
    try:
        flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
        mapped = mmap.mmap(memory, max(int(np.prod(shape)) * dtype.itemsize, 1), flags)
    finally:
        os.close(memory)
    return np.frombuffer(mapped, dtype, int(np.prod(shape))).reshape(shape)


def hold(content: bytes) -> int:
    """Copy a file's content to anonymous memory, and return its handle."""
    handle = _anonymous()
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(handle, rest) :]
    return handle


class _Child:
    """A decoding process and the socket to it."""

    def __init__(self) -> None:
        self.socket, other = socket.socketpair()
        with other:
            command = [sys.executable, "-I", "-S", "-c", _START, str(other.fileno()), *filter(None, sys.path)]
            self.process = subprocess.Popen(
                command, pass_fds=(other.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, env={**os.environ, "MALLOC_ARENA_MAX": "2"},
            )  # fmt: skip

    def end(self) -> int:
        """Close the socket, which ends the child; return its exit status."""
        self.socket.close()
        return self.process.wait()


_idle: list[_Child] = []
_lock = threading.Lock()


@atexit.register
def end_children() -> None:
    """End idle decoding processes, so that their time counts as that of this process's children."""
    while _idle:
        _idle.pop().end()


os.register_at_fork(after_in_child=_idle.clear)  # the children belong to the parent


def _ask(request: dict[str, Any], handle: int, size: int) -> tuple[dict[str, Any], int | None]:
    """Send a request about an open file; return the answer, and a handle of memory where it has pixels."""
    with _lock:
        child = _idle.pop() if _idle else None
    child = child or _Child()
    try:
        _send(child.socket, {**request, "size": size}, handle)
        answer, memory = _receive(child.socket)
    except (EOFError, OSError):
        raise CaptureError(_breakdown(child.end(), request["name"])) from None
    except BaseException:
        child.process.kill()  # interrupted between question and answer
        child.end()
        raise
    with _lock:
        _idle.append(child)
    if "problem" in answer:
        raise CaptureError(Problem(**answer["problem"]))
    return answer, memory


def _breakdown(status: int, name: str) -> Problem:
    if status == -signal.SIGXCPU:
        return error("image-absurd", name, "image takes much longer to decode than its size accounts for",
                     remedy=COPY_AGAIN)  # fmt: skip
    found = f"decoder ended with status {status}"
    return error("image-truncated", name, "cannot be decoded", found=found, remedy=COPY_AGAIN)


def _send(connection: socket.socket, message: dict[str, Any], handle: int | None) -> None:
    content = json.dumps(message).encode()
    content = struct.pack("=I", len(content)) + content
    sent = socket.send_fds(connection, [content], [] if handle is None else [handle])
    connection.sendall(content[sent:])


def _receive(connection: socket.socket) -> tuple[dict[str, Any], int | None]:
    """Receive a message and its handle. EOFError where the other side has ended."""
    content, handles, _, _ = socket.recv_fds(connection, MESSAGE, 1)
    length = 4 + struct.unpack("=I", content[:4])[0] if len(content) >= 4 else MESSAGE
    while len(content) < length and (more := connection.recv(length - len(content))):
        content += more
    if len(content) < length:
        raise EOFError("no answer")
    return json.loads(content[4:]), handles[0] if handles else None


def serve() -> None:
    """Answer requests until the other side closes the connection: the main function of the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt from the keyboard is for the parent, which ends this
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with socket.socket(fileno=int(sys.argv[1])) as connection:
        while True:
            try:
                request, file = _receive(connection)
            except EOFError:
                return
            if file is None:
                return
            with os.fdopen(file, "rb") as picture:
                _limit(request["size"])
                answer, memory = _answer(picture, request)
            _send(connection, answer, memory)
            if memory is not None:
                os.close(memory)


def _limit(size: int) -> None:
    """Set the limits of a request about a picture of so many bytes, file and pixels."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + LEAST_SECONDS + size // BYTES_A_SECOND
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb") as file:
            present = int(file.read().split()[0]) * resource.getpagesize()
        allowed = present + LEAST_MEMORY + THREAD_MEMORY * (os.cpu_count() or 1) + MEMORY_FACTOR * size
        resource.setrlimit(resource.RLIMIT_AS, (allowed, resource.RLIM_INFINITY))


def _answer(file: BinaryIO, request: dict[str, Any]) -> tuple[dict[str, Any], int | None]:
    name, memory = request["name"], _Memory()
    try:
        if request["do"] == "matlab":
            return {"numbers": stored_numbers(file, request["names"])}, None
        picture = open_picture(file, request["suffix"], name)
        if request["do"] == "header":
            return {"header": asdict(picture.header)}, None
        region = request["region"]
        wanted = Wanted(tuple(request["channels"]), request["luma"])
        codes = picture.decode(wanted, np.empty if region else memory.make)
        header = picture.header
        channels = codes.shape[2] if header.kind == "exr" or wanted.luma else header.channels
        if codes.shape != (header.rows, header.columns, channels) or codes.dtype != header.sample:
            stated = f"{header.rows} x {header.columns} x {channels} of {header.sample}"
            raise ValueError(f"{' x '.join(map(str, codes.shape))} of {codes.dtype} where {stated} are stated")
        if region:
            row, column, rows, columns = region
            part = codes[row : row + rows, column : column + columns]
            codes = memory.make(part.shape, part.dtype.name)
            codes[...] = part
        return {"shape": codes.shape, "dtype": codes.dtype.name}, memory.handle
    except CaptureError as e:
        memory.drop()
        return {"problem": asdict(e.problems[0])}, None
    except MemoryError:
        memory.drop()
        what = "image takes much more memory to decode than its size accounts for"
        return {"problem": asdict(error("image-absurd", name, what, remedy=COPY_AGAIN))}, None
    except Exception as e:  # whatever a damaged file makes a decoder stumble over, its own error classes included
        memory.drop()
        what = "image is cut off or damaged"
        found = (str(e) or type(e).__name__)[:300]
        return {"problem": asdict(error("image-truncated", name, what, found=found, remedy=COPY_AGAIN))}, None


def _anonymous() -> int:
    """Open memory without a name, or a nameless file where the system has no such memory."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("picture", os.MFD_CLOEXEC)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class _Memory:
    """Anonymous memory that another process opens by its handle."""

    handle: int | None = None

    def make(self, shape: tuple[int, ...], dtype: str) -> np.ndarray:
        """Make an array of zeros in the memory."""
        count = int(np.prod(shape))
        self.handle = _anonymous()
        size = max(count * np.dtype(dtype).itemsize, 1)
        os.ftruncate(self.handle, size)
        return np.frombuffer(mmap.mmap(self.handle, size), dtype, count).reshape(shape)

    def drop(self) -> None:
        """Release the memory."""
        if self.handle is not None:
            os.close(self.handle)


MOST_NUMBERS = 1 << 20  # of all variables together


def read_matlab(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read the named variables that the file has: arrays of numbers, cell arrays as object arrays of these.

    Shapes are MATLAB's (two axes at least). ValueError where it is no such file, is damaged, or holds one of the
    variables as something else (text, complex numbers, sparse matrices, cells in cells); FileNotFoundError;
    nishiki.formats.files.Refused where it is larger than is read.
    """
    handle = hold(read_bytes(path, "matlab_bytes", name=path.name))
    try:
        request = {"do": "matlab", "name": path.name, "names": names}
        stored = _ask(request, handle, os.fstat(handle).st_size)[0]["numbers"]
    except CaptureError as e:
        raise ValueError(e.problems[0].found or e.problems[0].what) from None
    finally:
        os.close(handle)
    return {name: _array(*content) for name, content in stored.items()}


def stored_numbers(file: BinaryIO, names: Sequence[str]) -> dict[str, tuple[tuple[int, ...], list]]:
    """Read shape and values of variables of an open file, in MATLAB's order; a cell is nested likewise.

    Runs in the process that decodes. Errors of any kind where `read_matlab` raises ValueError.
    """
    from scipy.io import loadmat

    file.seek(0)
    stored = loadmat(file, variable_names=names)
    content, left = {}, MOST_NUMBERS
    for name in names:
        if name not in stored:
            continue
        cells = stored[name].ravel() if stored[name].dtype == object else [stored[name]]
        left -= sum(cell.size for cell in cells)
        if left < 0 or any(cell.dtype.kind not in "fiu" for cell in cells):
            raise ValueError(f"{name!r} holds no numbers, or more than {MOST_NUMBERS}")
        content[name] = _describe_array(stored[name])
    return content


def _describe_array(array: np.ndarray) -> tuple[tuple[int, ...], list]:
    values = array.ravel(order="F")
    return array.shape, [_describe_array(cell) for cell in values] if array.dtype == object else values.tolist()


def _array(shape: list[int], values: list[Any]) -> np.ndarray:
    cells = bool(values) and isinstance(values[0], list)
    array = np.empty(len(values), object if cells else np.float64)
    for i, value in enumerate(values):
        array[i] = _array(*value) if cells else value
    return array.reshape(shape, order="F")


def open_picture(file: BinaryIO, suffix: str, name: str) -> Picture:
    """Open a picture by its content, camera raw by its suffix."""
    file.seek(0)
    start = file.read(32)
    if suffix.lower() in RAW_SUFFIXES:
        from nishiki.formats.decoders import open_raw

        return open_raw(file, name)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return open_png(file)
    if start.startswith(b"\xff\xd8"):
        return open_jpeg(file, name)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        from nishiki.formats.decoders import open_tiff

        return open_tiff(file, name)
    if start.startswith(b"\x76\x2f\x31\x01"):
        from nishiki.formats.decoders import open_exr

        return open_exr(file, name)
    expected = "PNG, JPEG, TIFF, OpenEXR or camera raw"
    found = f"{start[:8]!r}" if start else "an empty file"
    remedy = "Copy the file again from the camera or the archive, or move it away"
    refuse("image-unreadable", name, "not an image", expected=expected, found=found, remedy=remedy)
