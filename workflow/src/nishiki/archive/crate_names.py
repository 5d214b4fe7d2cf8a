"""The manifest of a crate: `manifest-sha256.txt`, which `sha256sum --check` understands."""

import re

from nishiki.artifacts.artifact import is_inside
from nishiki.errors import UserError
from nishiki.formats.files import name_fault

MANIFEST = "manifest-sha256.txt"
LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def manifest_text(digests: dict[str, str]) -> str:
    """Lines 'digest  name', sorted by name. Raises UserError for a name that not every system can have."""
    for name in digests:
        if fault := name_fault(name):
            raise UserError(f"{name!r}: cannot be packed: {fault}. Remedy: give the file another name")
    return "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))


def parse_manifest_text(data: bytes) -> dict[str, str]:
    """Digest by name. Raises ValueError where a byte is not as `manifest_text` writes it, or a name leads outside."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 ({error.reason})") from None
    digests = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        match = LINE.fullmatch(line)
        if match is None or not is_inside(match[2]) or name_fault(match[2]):
            raise ValueError(f"line {number}: expected 64 hexadecimal digits and a name inside the crate")
        digests[match[2]] = match[1]
    if manifest_text(digests).encode("utf-8") != data:
        raise ValueError("not as it was written: lines are sorted, each name stands once")
    return digests
