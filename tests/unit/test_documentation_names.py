"""Modules, names and files that the documentation mentions exist."""

import re
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
SOURCE = PROJECT / "workflow" / "src"
PAGES = [*PROJECT.glob("*.md"), *(PROJECT / "docs").rglob("*.md"), *(PROJECT / "envs").glob("*.md")]
PAGES = [page for page in PAGES if page.name != "CHANGELOG.md"]
DOTTED = re.compile(r"\bnishiki(?:\.[A-Za-z_]\w*)+(?![\w.]*\.(?:md|yaml)\b)")
FILES = re.compile(r"\b(?:tests|scripts|workflow|config|docs)/[\w/.-]*\w\.(?:py|smk|yaml|md)\b")
MODULES = re.compile(r"`([a-z_]+/[\w/]+\.py)`")
NOT_CODE = ("nishiki.scene", "nishiki.modulefile")  # an attribute of an image file, and a file


def missing_name(dotted: str) -> bool:
    """Whether a dotted name is neither a module nor something that its module's text names."""
    parts = dotted.split(".")
    for known in range(len(parts), 0, -1):
        path = SOURCE.joinpath(*parts[:known])
        file = path.with_suffix(".py") if path.with_suffix(".py").is_file() else path / "__init__.py"
        if file.is_file():
            return known < len(parts) and not re.search(rf"\b{parts[known]}\b", file.read_text(encoding="utf-8"))
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(PROJECT)))
def test_what_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    names = {name for name in DOTTED.findall(text) if name not in NOT_CODE and missing_name(name)}
    files = {name for name in FILES.findall(text) if not (PROJECT / name).exists()}
    roots = (PROJECT, SOURCE, SOURCE / "nishiki")
    modules = {name for name in MODULES.findall(text) if not any((root / name).exists() for root in roots)}
    assert not names | files | modules


def test_a_name_that_is_gone_is_noticed():
    assert missing_name("nishiki.no_such_module")
    assert missing_name("nishiki.stages.base.NoSuchClass")
    assert not missing_name("nishiki.stages.base.Stage")
