"""Seal a capture as a BagIt bag (RFC 8493), whose manifest records the digest of every file."""

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from datetime import date as Date
from pathlib import Path

from nishiki.formats.files import Refused, flush, is_plain, leads_out, open_regular, put_file, read_bytes, walk
from nishiki.formats.problems import WHERE_IS_IT, CaptureError, Problem, error, raise_errors, refuse
from nishiki.formats.text_tables import refusal

MANIFEST, TAG_MANIFEST = "manifest-sha256.txt", "tagmanifest-sha256.txt"
TAGS = ("bagit.txt", "bag-info.txt", MANIFEST)
RESTORE = "Restore it from a backup; a sealed capture must stay as it was"
BAGIT = "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n"


def sha256_of(path: Path) -> str:
    """Compute the SHA-256 of a file, 64 hexadecimal digits."""
    with os.fdopen(open_regular(path, path.name), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def payload_files(folder: Path) -> Iterator[Path]:
    """Yield regular files below a folder, sorted by their relative names; links to folders are not followed.

    CaptureError (seal-link, file-special, name-unusable) for links that lead out of the folder or nowhere, for pipes
    and devices, which could be read for ever, and for names that are not UTF-8.
    """
    files, problems = [], []
    for name, entry in walk(folder):
        path = Path(entry.path)
        problem = _strange(name, entry, folder)
        if problem is not None:
            problems.append(problem)
        elif not path.is_dir():
            files.append((name, path))
    raise_errors(problems)
    return iter(path for _, path in sorted(files))


def _strange(name: str, entry: os.DirEntry, folder: Path) -> Problem | None:
    """Return the fault of a folder entry that cannot be read and listed as a file; None for a regular one."""
    if not is_plain(name.replace("\n", "").replace("\r", "")):
        remedy = "Rename the file; a manifest holds names in UTF-8, without control characters"
        return error("name-unusable", name, "file name with control characters, or not UTF-8", remedy=remedy)
    if entry.is_symlink() and (not os.path.exists(entry.path) or leads_out(Path(entry.path), folder)):
        found, remedy = f"leads to {os.path.realpath(entry.path)}", "Replace the link by a copy of its file"
        return error("seal-link", name, "link that leads out of the folder or nowhere", found=found, remedy=remedy)
    if not entry.is_file() and not entry.is_dir():
        return error("file-special", name, "neither a file nor a folder", remedy="Remove it from the capture folder")
    return None


def payload_digests(folder: Path, *, progress: Callable[[str], None] | None = None) -> dict[str, str]:
    """Digest every file by its name in a bag ('data/...'); progress: called with each name."""
    digests = {}
    for path in payload_files(folder):
        name = f"data/{path.relative_to(folder).as_posix()}"
        digests[name] = sha256_of(path)
        if progress:
            progress(name)
    return digests


def manifest_text(digests: dict[str, str]) -> str:
    """Write manifest lines 'digest  name' by name; line ends and '%' in names percent-encoded (RFC 8493, 2.1.3)."""
    lines = (f"{digests[name]}  {name}".replace("%", "%25").replace("\r", "%0D") for name in sorted(digests))
    return "".join(line.replace("\n", "%0A") + "\n" for line in lines)


def read_manifest(path: Path) -> dict[str, str]:
    """Read digests by name from a manifest. CaptureError (seal-manifest) for invalid lines and unreadable files."""
    entries, problems = {}, []
    for number, line in enumerate(_manifest_lines(path), start=1):
        entry = manifest_entry(line)
        if entry is None or entry[0] in entries:
            expected = "64 hexadecimal digits and a name inside the bag, each name once"
            where = f"{path.name} line {number}"
            problems.append(error("seal-manifest", where, "line", expected=expected, found=line[:80]))
            continue
        entries[entry[0]] = entry[1]
    raise_errors(problems)
    return entries


def manifest_entry(line: str) -> tuple[str, str] | None:
    """Parse name and digest of a manifest line; None where it has none, or the name leads outside."""
    match = re.fullmatch(r"([0-9a-fA-F]{64})[ \t]+\*?([^\s*].*)", line)
    if match is None or match[2].startswith("/") or ".." in match[2].split("/"):
        return None
    return re.sub(r"%(25|0[dD]|0[aA])", lambda code: chr(int(code[1], 16)), match[2]), match[1].lower()


def _manifest_lines(path: Path) -> list[str]:
    """Read lines of a manifest; only line feeds end them, as names may hold any other character."""
    try:
        if leads_out(path, path.parent):
            what, remedy = "link out of the folder", "Copy the file itself into the folder"
            refuse("seal-manifest", path.name, what, found=os.path.realpath(path), remedy=remedy)
        lines = read_bytes(path, "manifest_bytes", name=path.name).decode("utf-8").split("\n")
    except (FileNotFoundError, UnicodeDecodeError) as e:
        raise CaptureError(error("seal-manifest", path.name, "cannot be read as UTF-8 text", found=str(e))) from e
    except Refused as e:
        raise CaptureError(refusal(e, "seal-manifest")) from e
    return [line.removesuffix("\r") for line in (lines[:-1] if not lines[-1] else lines)]


def capture_digest(root: Path) -> str:
    """Compute the SHA-256 over the sorted payload manifest: a capture's identity, the same before and after sealing.

    Read the manifest of a sealed capture (`check` verifies the files), otherwise every file.
    """
    if (root / "bagit.txt").is_file():
        text = manifest_text(read_manifest(root / MANIFEST))
    else:
        payload = root / "data" if (root / "data" / "capture.yaml").is_file() else root
        text = manifest_text(payload_digests(payload))
    return hashlib.sha256(text.encode()).hexdigest()


def seal(root: Path, *, progress: Callable[[str], None] | None = None) -> str:
    """Make the capture folder a bag, in place, and return its digest.

    The folder's contents move into data/. Safe against being killed at any moment: the bag is prepared beside it as
    NAME.sealing, the whole folder is moved into that by one rename, and a second rename puts it in place; running seal
    again finishes what was begun. Of a link the folder that it leads to is sealed, and the link stays. Raises
    CaptureError: seal-done, seal-link, seal-occupied, folder-missing.
    """
    root = root.resolve()
    half = root.with_name(root.name + ".sealing")
    if not root.exists() and (half / "data").is_dir():
        # Killed between the two renames: the payload is whole; the tag files are made anew in case they are not.
        _refuse_links(half)
        _write_tags(half, half / "data", progress)
        os.rename(half, root)
        return capture_digest(root)
    if not root.is_dir():
        refuse("folder-missing", str(root), "no such capture folder", remedy=WHERE_IS_IT)
    if (root / "bagit.txt").is_file():
        remedy = "A sealed capture stays as it is; copy its data folder to make another capture"
        refuse("seal-done", str(root), "capture is already sealed", remedy=remedy)
    inside = (root / "data" / "capture.yaml").is_file()
    _refuse_links(root)
    if inside:
        _write_tags(root, root / "data", progress)
        return capture_digest(root)
    _clear_half(half)
    half.mkdir()
    _write_tags(half, root, progress)
    os.rename(root, half / "data")
    os.rename(half, root)
    flush(root.parent)
    return capture_digest(root)


def _clear_half(half: Path) -> None:
    """Remove tag files of a sealing that was killed before its first rename. Anything else is left alone."""
    if not half.exists():
        return
    tag_files = {f".{name}.part" for name in (*TAGS, TAG_MANIFEST)} | {*TAGS, TAG_MANIFEST}
    strange = sorted({path.name for path in half.iterdir()} - tag_files)
    if strange:
        what = "folder exists already and may hold another capture: move it away"
        refuse("seal-occupied", str(half), what, found=", ".join(strange[:5]))
    for path in half.iterdir():
        path.unlink()
    half.rmdir()


def sealed_digests(root: Path) -> dict[str, str]:
    """Read digests of a sealed capture's files by name relative to data/; empty for an unsealed one."""
    if not (root / "bagit.txt").is_file():
        return {}
    return {name.removeprefix("data/"): digest for name, digest in read_manifest(root / MANIFEST).items()}


def expect_sealed(path: Path, name: str, digests: dict[str, str]) -> None:
    """Raise CaptureError (seal-changed, seal-foreign) if the file differs from its digest; no digests: no check."""
    if not digests:
        return
    if name not in digests:
        refuse("seal-foreign", name, "not listed in the manifest", remedy=RESTORE)
    digest = sha256_of(path)
    if digest != digests[name]:
        expected, found = f"sha256 {digests[name][:12]}...", f"{digest[:12]}..."
        refuse("seal-changed", name, "changed after sealing", expected=expected, found=found, remedy=RESTORE)


def verify_seal(root: Path, *, digests: bool = True) -> list[Problem]:
    """List missing, changed and foreign files of a sealed capture (seal-missing, seal-changed, seal-foreign).

    digests: read every file; otherwise only the names are compared.
    """
    missing = [name for name in TAGS if not (root / name).is_file()]
    if missing:
        return [error("seal-missing", name, "file of the seal is missing") for name in missing]
    problems: list[Problem] = []
    try:
        _refuse_links(root)
        listed = read_manifest(root / MANIFEST)
        present = {p.relative_to(root).as_posix(): p for p in payload_files(root / "data")}
    except CaptureError as e:
        return list(e.problems)
    for name in sorted(set(listed) - set(present)):
        problems.append(error("seal-missing", name, "listed in the manifest but missing", remedy=RESTORE))
    for name in sorted(set(present) - set(listed)):
        problems.append(error("seal-foreign", name, "not listed in the manifest", remedy="Remove it, or seal anew"))
    for name in sorted(set(listed) & set(present)) if digests else ():
        try:
            expect_sealed(present[name], name, listed)
        except CaptureError as e:
            problems += e.problems
    if (root / TAG_MANIFEST).is_file():
        try:
            tags = read_manifest(root / TAG_MANIFEST)
        except CaptureError as e:
            return [*problems, *e.problems]
        for name, digest in tags.items():
            if not (root / name).is_file() or sha256_of(root / name) != digest:
                problems.append(error("seal-changed", name, "file of the seal changed after sealing", remedy=RESTORE))
    return problems


def _write_tags(bag: Path, payload: Path, progress: Callable[[str], None] | None) -> None:
    """Write bag-info, manifests, and last bagit.txt, whose presence makes the folder a bag."""
    digests = payload_digests(payload, progress=progress)
    size = sum((payload / name.removeprefix("data/")).stat().st_size for name in digests)
    info = f"Bagging-Date: {Date.today().isoformat()}\nPayload-Oxum: {size}.{len(digests)}\n"
    texts = {"bag-info.txt": info, MANIFEST: manifest_text(digests)}
    tags = {n: hashlib.sha256(t.encode()).hexdigest() for n, t in {**texts, "bagit.txt": BAGIT}.items()}
    for name, text in {**texts, TAG_MANIFEST: manifest_text(tags), "bagit.txt": BAGIT}.items():
        put_file(bag / name, text)
    flush(bag)


def _refuse_links(root: Path) -> None:
    """Refuse links: even one inside the folder may break when the bag is copied."""
    links = [name for name, entry in walk(root) if entry.is_symlink()]
    what = "link in a sealed capture, or one to be sealed: replace it by a copy of its file"
    raise_errors(error("seal-link", name, what) for name in links)
    payload_files(root)
