"""The viewer's page: one index.html that holds its modules, and the blocks of data beside it or inside it."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.javascript import modules_of

PAGE = Path(__file__).parent / "page"
ESCAPED = ((b"\\", b"\\\\"), (b'"', b'\\"'), (b"\n", b"\\n"), (b"\r", b"\\r"))
"""What no text between quotes may hold, the sign of the escape first."""


class Blocks:
    """Blocks of data by name: kept while all together are small, otherwise written as scripts beside the page."""

    def __init__(self, output: ArtifactWriter, *, inline_bytes: int):
        self.output = output
        self.inline_bytes = inline_bytes
        self.kept: dict[str, bytes] | None = {}
        self.bytes: dict[str, int] = {}

    def add(self, name: str, data: bytes) -> None:
        """The next block."""
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
        """A script whose text is the bytes, for a page that reads it as windows-1252 (page/loader.js)."""
        text = data
        for letter, escaped in ESCAPED:
            text = text.replace(letter, escaped)
        script = f'nishikiData("{name}",{len(data)},"'.encode("ascii") + text + b'");\n'
        self.output.path(f"data/{name}.js").write_bytes(script)


def write_page(blocks: Blocks, manifest: dict[str, Any], entry: Path) -> dict[str, Any]:
    """Write index.html of a manifest and its blocks; sizes in bytes, for the diagnostics. entry: the module that the
    page begins with."""
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    paths = {"page" if path == entry else path.stem: path for path in modules_of(entry, [PAGE])}
    modules = {f"viewer/{name}": _module(path, name) for name, path in paths.items()}
    manifest = {**manifest, "data": {"inline": blocks.kept is not None}}
    environment = Environment(loader=FileSystemLoader(PAGE), autoescape=True, keep_trailing_newline=True)
    html = environment.get_template("index.html.j2").render(
        title=manifest["title"],
        version=manifest["version"],
        texts=Markup(_script_json(_texts())),
        modules=Markup(_script_json({"imports": modules})),
        manifest=Markup(_script_json(manifest)),
        blocks={name: base64.b64encode(data).decode("ascii") for name, data in (blocks.kept or {}).items()},
        style=Markup((PAGE / "style.css").read_text(encoding="utf-8")),
    )
    blocks.output.path("index.html").write_text(html, encoding="utf-8")
    return {
        "page_bytes": len(html.encode("utf-8")),
        "data_bytes": sum(blocks.bytes.values()),
        "blocks": len(blocks.bytes),
        "inline": blocks.kept is not None,
    }


def _module(path: Path, name: str) -> str:
    """A module as an address that holds it; errors name it as `viewer/...`."""
    text = path.read_bytes() + f"\n//# sourceURL=viewer/{name}.js\n".encode("ascii")
    return f"data:text/javascript;base64,{base64.b64encode(text).decode('ascii')}"


def _texts() -> dict[str, dict[str, str]]:
    """The page's texts by language."""
    files = sorted(PAGE.glob("texts.*.json"))
    return {path.name.split(".")[1]: json.loads(path.read_text(encoding="utf-8")) for path in files}


def _script_json(value: Any) -> str:
    """JSON that no content can end the script element of."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
