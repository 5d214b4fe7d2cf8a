"""Pages and navigation of the documentation site that follow from other files (a hook of mkdocs; see mkdocs.yml).

README, CONTRIBUTING and CHANGELOG stand at the root of the repository, for readers there, and become pages. Stages come
into the navigation from their table, and a stage whose page nobody has written yet gets one with its tables. Decisions
and developers' notes come into the navigation from their folders.
"""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "workflow" / "src"))

from nishiki.artifacts.provenance import program_of
from nishiki.stages.table import CHAIN, chain_of

ROOT = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"(\]\()(?!\w+:|#)([^)#\s]+)")
OUTWARD = re.compile(r"\[([^]]*)\]\(((?:\.\./)+)([^)#\s]+)(#[^)]*)?\)")


def on_config(config: Any) -> Any:
    """Put stages, decisions and notes into the navigation."""
    docs = Path(config.docs_dir)
    listed = {}
    for folder in ("decisions", "notes"):
        names = [path.relative_to(docs).as_posix() for path in sorted((docs / folder).rglob("*.md"))]
        listed[f"{folder}/README.md"] = [name for name in names if not name.endswith("README.md")]
    _extend(config.nav, listed)
    return config


def _extend(nav: list[Any], after: dict[str, list[str]]) -> None:
    for number, item in enumerate(list(nav)):
        if isinstance(item, str):
            nav[number + 1 : number + 1] = after.get(item, [])
            continue
        for name, inside in item.items():
            if isinstance(inside, list) and inside[0] in ("plane", "mosaic", "turntable", "goniometer"):
                shared = [] if inside[0] == "plane" else list(chain_of("plane"))
                item[name] = [{stage: f"stages/{stage}.md"} for stage in chain_of(inside[0]) if stage not in shared]
            elif isinstance(inside, list):
                _extend(inside, after)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages at the root, with their links as seen from docs/, and pages of stages that have none."""
    root = Path(config.config_file_path).parent
    for name, page in ROOT.items():
        text = LINK.sub(lambda link: link[1] + _seen_from_docs(link[2]), (root / name).read_text(encoding="utf-8"))
        files.append(File.generated(config, page, content=text))
    for name, stage in CHAIN.items():
        if files.get_file_from_path(f"stages/{name}.md") is None:
            package = program_of(name).parent.name
            line = f"Declared in [{name}](../../workflow/src/nishiki/stages/{package}/__init__.py)."
            files.append(File.generated(config, f"stages/{name}.md", content=f"# {name}: {stage.does}\n\n{line}\n"))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links to files outside docs/ become their names, for the site does not hold the code."""
    depth = page.file.src_uri.count("/")
    return OUTWARD.sub(lambda link: _outward(link, depth), markdown)


def _seen_from_docs(path: str) -> str:
    if path in ROOT:
        return ROOT[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else f"../{path}"


def _outward(link: re.Match[str], depth: int) -> str:
    """A link that leads out of docs/ as the name of the file; any other as it is."""
    text, up, path, place = link.groups()
    if up.count("/") <= depth:
        return link[0]
    return f"[{text}]({'../' * depth}{ROOT[path]}{place or ''})" if path in ROOT else f"`{path}`"
