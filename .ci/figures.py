"""Print the size and the style of the project as one table: `python .ci/figures.py`.

Every figure is read from the tracked files, without importing the package. `--list` prints the assertions on sentences
and the docstrings that begin with no verb of `.ci/verbs.txt`.
"""

import argparse
import ast
import json
import re
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
SHORT = 4  # lines of a body that is written where it is called
ARGUMENTS = 8
WORDS = re.compile(r"(?<![\w./_=<-])[A-Za-z]{2,}[,;:]? [a-z]{2,}(?![\w/_=(-]|\.\w)")
"""Two English words in succession: no path, name of a setting, option or figure."""
OURS = re.compile(r"^nishiki[: ]|^-m |^(?:python|git|pip|uv)\b|^\./nishiki|^--")
"""A command line, which is no sentence."""
METHODS = ("startswith", "endswith", "search", "fullmatch", "count")


def tracked(*patterns: str) -> list[Path]:
    """List the tracked files of some patterns."""
    names = subprocess.run(
        ["git", "ls-files", "-z", "--", *patterns], cwd=PROJECT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    return [PROJECT / name for name in names if name and (PROJECT / name).is_file()]


def texts(node: ast.AST) -> Iterator[str]:
    """Yield the literal texts of an expression, those of f-strings joined; arguments of calls and keys are none."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str):
            yield node.value
    elif isinstance(node, ast.JoinedStr):
        yield "".join(str(part.value) if isinstance(part, ast.Constant) else "7" for part in node.values)
    elif not isinstance(node, ast.Call | ast.Subscript):
        for child in ast.iter_child_nodes(node):
            yield from texts(child)


def is_sentence(text: str) -> bool:
    """Whether a text that a test compares with holds two English words in succession."""
    return not OURS.match(text) and bool(
        WORDS.search(re.sub(r"\.[*+]", " | ", text).replace("\\", "").replace("\n", " "))
    )


def given_texts(function: ast.AST) -> dict[str, list[str]]:
    """Collect the texts that parameters and loop variables of a test stand for, by their names."""
    given: dict[str, list[str]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.For | ast.comprehension):
            names, values = [item.id for item in ast.walk(node.target) if isinstance(item, ast.Name)], node.iter
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("parametrize") and len(node.args) > 1:
            names, values = re.findall(r"\w+", " ".join(texts(node.args[0]))), node.args[1]
        else:
            continue
        if isinstance(values, ast.Call) and isinstance(getattr(values.func, "value", None), ast.Dict):
            values = ast.List(values.func.value.values)  # {name of a case: case}.values()
        for row in getattr(values, "elts", [values]):
            cells = row.args if isinstance(row, ast.Call) else getattr(row, "elts", [])
            pairs = zip(names, cells, strict=False) if len(cells) >= len(names) > 1 else [(n, row) for n in names]
            for name, cell in pairs:
                found = [item.value for item in ast.walk(cell) if isinstance(item, ast.Constant)]
                given.setdefault(name, []).extend(text for text in found if isinstance(text, str))
    return given


def compared(function: ast.AST) -> Iterator[tuple[int, ast.AST]]:
    """Yield line and text of each comparison of a test: `in`, `==`, `match=`, and methods such as `startswith`."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            for part in ast.walk(node.test):
                if isinstance(part, ast.Compare):
                    if any(isinstance(op, ast.In | ast.NotIn) for op in part.ops):
                        yield part.lineno, part.left
                    elif any(isinstance(op, ast.Eq | ast.NotEq) for op in part.ops):
                        for side in (part.left, *part.comparators):
                            yield part.lineno, side
                elif isinstance(part, ast.Call) and getattr(part.func, "attr", "") in METHODS and part.args:
                    yield part.lineno, part.args[0]
        elif isinstance(node, ast.keyword) and node.arg == "match":
            yield node.value.lineno, node.value


def sentences() -> list[str]:
    """List the assertions of the tests that fix a sentence of the program, as file, line and text.

    A text that stands elsewhere in the same file is the test's own: a title, a file that it writes.
    """
    found = []
    for path in tracked("tests/*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inside = {id(item) for _, node in compared(tree) for item in ast.walk(node)}
        inside |= {id(item) for item in decorated(tree)}
        own = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside
        ]
        for function in tree.body:
            given, lines = given_texts(function), {}
            for line, node in compared(function):
                names = [item.id for item in ast.walk(node) if isinstance(item, ast.Name)]
                every = [*texts(node), *(text for name in names for text in given.get(name, ()))]
                for text in every:
                    if is_sentence(text) and not any(text in other for other in own):
                        lines.setdefault(line, text)
            found += [f"{path.relative_to(PROJECT)}:{line}: {text!r}" for line, text in sorted(lines.items())]
    return found


def decorated(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes of all parameters of tests and of the values of loops."""
    for node in ast.walk(tree):
        if isinstance(node, ast.For):
            yield from ast.walk(node.iter)
        elif isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                yield from ast.walk(decorator)


def functions(trees: dict[Path, ast.Module]) -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Yield every function with its file."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield path, node


def summaries_without_verb() -> list[str]:
    """List the docstrings of functions, except properties, whose first word is none of `.ci/verbs.txt`."""
    verbs, found = set((PROJECT / ".ci/verbs.txt").read_text(encoding="utf-8").split()), []
    for path in tracked("workflow/src/*.py", "scripts/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (text := ast.get_docstring(node)):
                is_property = any(ast.unparse(each).endswith("property") for each in node.decorator_list)
                if not is_property and text.split()[0].rstrip(".,:;") not in verbs:
                    found.append(f"{path.relative_to(PROJECT)}:{node.lineno}: {text.splitlines()[0]}")
    return found


def one_caller_helpers(trees: dict[Path, ast.Module]) -> int:
    """Count the functions of a module's top whose body has at most `SHORT` lines and that one place names."""
    named = Counter(
        node.id if isinstance(node, ast.Name) else node.attr
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute)
    )
    imported = {
        alias.name
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    count = 0
    for tree in trees.values():
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and not node.decorator_list and node.name not in imported:
                body = node.body[1:] if ast.get_docstring(node) else node.body
                if body and body[-1].end_lineno - body[0].lineno < SHORT and named[node.name] == 1:
                    count += 1
    return count


def ruff(rule: str) -> int:
    """Count the findings of one rule of ruff in the package."""
    found = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--isolated", "--select", rule, "--output-format", "json",
         "--config", "lint.pydocstyle.convention='numpy'", "--config", f"lint.pylint.max-args={ARGUMENTS}",
         "workflow/src", "scripts"],
        cwd=PROJECT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return len(json.loads(found.stdout))


def words(pages: list[Path]) -> int:
    """Count the words of some pages."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)


def rows() -> Iterator[tuple[str, str]]:
    """Yield name and value of every figure."""
    package = tracked("workflow/src/*.py", "scripts/*.py")
    lengths = [len(path.read_text(encoding="utf-8").splitlines()) for path in package]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in package}
    defined = [node for _, node in functions(trees)]
    documented = [node for node in defined if ast.get_docstring(node)]
    numpydoc = [
        node for node in documented if re.search(r"\n *(Parameters|Returns|Raises)\n *---", ast.get_docstring(node))
    ]
    constants = [
        node
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        and re.fullmatch(r"-?[\d.e+-]+", ast.unparse(node.value or node))
    ]
    yield "lines of Python in the package", f"{sum(lengths):,}"
    yield "files; median of their lines", f"{len(package)}; {statistics.median(lengths):.0f}"
    yield "functions; helpers of four lines or fewer with one caller", f"{len(defined):,}; {one_caller_helpers(trees)}"
    yield "functions with a docstring; of these in numpydoc sections", f"{len(documented):,}; {len(numpydoc)}"
    yield "docstrings of functions that do not begin with a verb", str(len(summaries_without_verb()))
    yield "docstrings whose summary is no line of its own (D205)", str(ruff("D205"))
    yield f"functions with more than {ARGUMENTS} arguments", str(ruff("PLR0913"))
    yield "stages", str(len(tracked("docs/stages/*.md")) - 1)
    yield "assertions that fix a sentence", str(len(sentences()))
    yield "numeric constants of modules", f"{len(constants):,}"
    pages = tracked("*.md")
    notes = [page for page in pages if {"notes", "decisions"} & set(page.parts)]
    developers = {"CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "architecture.md", "release.md", "api.md"}
    users = [
        page
        for page in pages
        if page not in notes and page.name not in developers and (page.parent == PROJECT or "docs" in page.parts)
    ]
    yield "words of the users' pages; of the developers' notes and decisions", f"{words(users):,}; {words(notes):,}"


def main() -> None:
    """Print the table, or the assertions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", action="store_true", help="print what two of the rows count")
    if parser.parse_args().list:
        print("\n".join([*sentences(), *summaries_without_verb()]))
        return
    table = list(rows())
    width = max(len(name) for name, _ in table)
    print("\n".join(f"{name:{width}}  {value}" for name, value in table))


if __name__ == "__main__":
    main()
