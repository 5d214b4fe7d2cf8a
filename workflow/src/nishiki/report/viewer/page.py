"""Write the page of a viewer: its modules, manifest and blocks of data, beside it or inside it."""

import base64
import json
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.provenance import modules_of

PAGE = Path(__file__).parent / "page"
ESCAPED = ((b"\\", b"\\\\"), (b'"', b'\\"'), (b"\n", b"\\n"), (b"\r", b"\\r"))
"""Characters forbidden in quoted text, the sign of the escape first."""


class Blocks:
    """Blocks of data by name: inlined while all together are small, otherwise written as scripts beside the page."""

    def __init__(self, output: ArtifactWriter, *, inline_bytes: int):
        self.output = output
        self.inline_bytes = inline_bytes
        self.kept: dict[str, bytes] | None = {}
        self.bytes: dict[str, int] = {}

    def add(self, name: str, data: bytes) -> None:
        """Add the next block."""
        self.bytes[name] = len(data)
        if self.kept is None:
            self._write(name, data)
            return
        self.kept[name] = data
        if sum(self.bytes.values()) > self.inline_bytes:
            for each, content in self.kept.items():
                self._write(each, content)
            self.kept = None

    def _write(self, name: str, data: bytes) -> None:
        """Write a script whose text is the bytes, for a page that reads it as windows-1252 (page/loader.js)."""
        text = data
        for letter, escaped in ESCAPED:
            text = text.replace(letter, escaped)
        script = f'nishikiData("{name}",{len(data)},"'.encode("ascii") + text + b'");\n'
        self.output.path(f"data/{name}.js").write_bytes(script)


def write_page(blocks: Blocks, manifest: dict[str, Any], entry: Path) -> dict[str, Any]:
    """Write index.html of a manifest and its blocks; return sizes in bytes. entry: the page's first module."""
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    files = sorted(PAGE.glob("texts.*.json"))
    texts = {path.name.split(".")[1]: json.loads(path.read_text(encoding="utf-8")) for path in files}  # by language
    modules = {}
    for path in modules_of(entry, [PAGE]):
        name = "page" if path == entry else path.stem
        text = path.read_bytes() + f"\n//# sourceURL=viewer/{name}.js\n".encode("ascii")  # the name in errors
        modules[f"viewer/{name}"] = f"data:text/javascript;base64,{base64.b64encode(text).decode('ascii')}"
    manifest = {**manifest, "data": {"inline": blocks.kept is not None}}
    environment = Environment(loader=FileSystemLoader(PAGE), autoescape=True, keep_trailing_newline=True)
    html = environment.get_template("index.html.j2").render(
        title=manifest["title"],
        version=manifest["version"],
        texts=Markup(_script_json(texts)),
        modules=Markup(_script_json({"imports": modules})),
        manifest=Markup(_script_json(manifest)),
        blocks={name: base64.b64encode(data).decode("ascii") for name, data in (blocks.kept or {}).items()},
        style=Markup((PAGE / "style.css").read_text(encoding="utf-8")),
    )
    blocks.output.path("index.html").write_text(html, encoding="utf-8")
    blocks.output.path("embed.js").write_bytes((PAGE / "embed.js").read_bytes())
    return {
        "page_bytes": len(html.encode("utf-8")),
        "data_bytes": sum(blocks.bytes.values()),
        "blocks": len(blocks.bytes),
        "inline": blocks.kept is not None,
    }


def _script_json(value: Any) -> str:
    """Write JSON in which no content can end the script element."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def webp(planes: list[np.ndarray]) -> bytes:
    """Encode a lossless WebP of three planes (rows, columns) uint8."""
    import cv2

    picture = np.stack(planes[::-1], axis=-1)  # OpenCV keeps blue first
    return cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def webp_stack(planes: list[np.ndarray]) -> bytes:
    """Encode planes (rows, columns) uint8, three to a lossless WebP; before each its length, four bytes, lowest first.

    The last picture is filled up with zeros.
    """
    parts = []
    for first in range(0, len(planes), 3):
        three = planes[first : first + 3]
        colours = three + [np.zeros_like(three[0])] * (3 - len(three))
        data = webp(colours)
        parts += [struct.pack("<I", len(data)), data]
    return b"".join(parts)


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Pack named arrays into bytes for `unpackArrays` of the page.

    Parameters
    ----------
    arrays : mapping of str to numpy.ndarray
        Arrays of type int8 to int32, uint8 to uint32 or float32.

    Returns
    -------
    bytes
        Deflated (zlib): length of the header (4 bytes, little endian), header, bytes of the arrays. All first bytes of
        an array's numbers come before all second ones: numbers that are small or near each other deflate further so.
    """
    head, bodies = [], []
    for name, values in arrays.items():
        plain = np.ascontiguousarray(values).reshape(-1)
        little = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
        head.append({"name": name, "type": plain.dtype.name, "shape": list(values.shape)})
        bodies.append(np.ascontiguousarray(little.view(np.uint8).reshape(-1, plain.dtype.itemsize).T).tobytes())
    text = json.dumps(head, separators=(",", ":")).encode()
    return zlib.compress(struct.pack("<I", len(text)) + text + b"".join(bodies), 9)
