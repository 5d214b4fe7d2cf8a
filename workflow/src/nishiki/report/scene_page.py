"""Write the page of a scene: the sections of its stages, then omissions, conditions, provenance and verification."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from markupsafe import Markup

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.declaration import Closed, Limit, at_bounds, limit_checks, limit_warnings
from nishiki.artifacts.provenance import canonical
from nishiki.artifacts.stage import Context
from nishiki.report import page
from nishiki.report.pictures import file_jpeg
from nishiki.report.svg import figure, plain

PLANNED = ("hold_out", "positions_mm", "without", "truth_sha256", "training_sha256", "left_out")
"""Settings filled in by the plan; a user does not write them."""
LONGEST_TEXT = 160  # characters of a line
THUMBNAIL, THUMBNAIL_COLUMNS = "thumbnail.jpg", 320


class Head(NamedTuple):
    """The head of a page: title of the capture, kind of scene, and more as of `Page`."""

    title: str | None
    about: str
    facts: Sequence[tuple[str, str]]
    tiles: Sequence[page.Metric]
    verdict: Sequence[tuple[str, str]]
    warnings: Sequence[str] = ()


SLIGHT = 0.05
"""Share of a surface, of light or of a value up to which a headline is silent on a lack or an error."""


def headline(
    measured: Sequence[tuple[float | None, float, str]], advice: Sequence[tuple[bool, str, str]]
) -> list[tuple[str, str]]:
    """Return label and text of each line, without empty lines.

    measured : values (None: not measured), limits below which they are good, and texts; advice : whether a lack holds,
    the lack, and its remedy; the first that holds is what would improve most.
    """
    good = [words for value, limit, words in measured if value is not None and value < limit]
    doubtful = [words for value, limit, words in measured if value is not None and value >= limit]
    doubtful += [lack for holds, lack, _ in advice if holds]
    remedy = next((remedy for holds, _, remedy in advice if holds), "")
    rows = [("Good", "; ".join(good)), ("Doubtful", "; ".join(doubtful)), ("To improve it most", remedy)]
    return [(label, text[:1].upper() + text[1:] + ".") for label, text in rows if text]


class SceneData:
    """Input of the sections of a page: all that is known of one scene.

    inputs : artifacts by stage; diagnostics : of each; evaluation : evaluation.json, empty without one; settings : of
    the page; widest : columns of a picture.
    """

    def __init__(self, context: Context):
        self.context, self.inputs, self.settings = context, context.inputs, context.settings
        self.widest = context.settings.picture_columns
        self.diagnostics = {name: artifact.diagnostics for name, artifact in self.inputs.items()}
        evaluate = next((each for name, each in self.inputs.items() if name.endswith("evaluate")), None)
        self.evaluation: dict[str, Any] = page.read_json(evaluate, "evaluation.json") or {}

    def value(self, *path: str) -> Any:
        """Return the diagnostic at a path that begins with a stage; None where any part of the path is missing."""
        return at(self.diagnostics, *path)


def at(values: Any, *path: str) -> Any:
    """Return the value at a path of names, of a list those of its entries; None where a part of the path is missing."""
    for name in path:
        values = [at(each, name) for each in values] if isinstance(values, list) else (values or {}).get(name)
    return values


def fact_rows(values: Any, facts: Sequence[tuple[str, str, float]]) -> list[tuple[str, page.Cell]]:
    """Return label and value of facts, without those that are missing; of several values, the mean and the range.

    facts : label with the unit, path of the value with dots between its names, and factor from the value to the unit.
    """
    rows: list[tuple[str, page.Cell]] = []
    for label, path, factor in facts:
        value = at(values, *path.split("."))
        several = list(value.values()) if isinstance(value, dict) else value
        if isinstance(several, list):
            numbers = [factor * each for each in several if each is not None]
            mean = sum(numbers) / len(numbers) if numbers else None
            value = numbers and f"{figure(mean)} ({figure(min(numbers))} to {figure(max(numbers))})"
        elif isinstance(value, bool):
            value = text(value)
        elif isinstance(value, float) or factor != 1:
            value = value and round(factor * value, 9)
        if value or value == 0:
            rows.append((label, value))
    return rows


def write_scene_page(
    data: SceneData,
    stages: Mapping[str, Any],
    head: Head,
    sections: Sequence[tuple[str, Callable[[Any], page.PageSection | None]]],
    *,
    more_left_out: Sequence[page.Block] = (),
    more_made: Sequence[page.Block] = (),
) -> dict[str, Any]:
    """Write `report.html`; return the stage's diagnostics.

    stages : declarations in the order of the flow; sections : each with the stage without which it is left out;
    more_left_out, more_made : blocks of this kind of scene.

    Beside it stands a thumbnail of the first rendered picture. Thumbnail, title and figures are what the page of all
    scenes shows.
    """
    context, stamp, settings = data.context, data.context.stamp, data.settings
    inputs = {name: each for name, each in data.inputs.items() if each.stage == name}  # none in place of another
    closing = closing_sections(inputs, stages, stamp, settings.left_out, more_left_out, more_made)
    viewer = next((name for name in inputs if name.endswith("viewer")), None)
    beyond = [
        f"{name}: {warning}"
        for name in stages
        if name in inputs
        for warning in limit_warnings(
            name, stages[name].limits, inputs[name].diagnostics, inputs[name].settings.get("allow", ())
        )
    ]
    shown = [section for stage, write in sections if stage in data.inputs and (section := write(data))]
    if viewer:
        address, summary = f"{viewer}/index.html", "move lamps or the object, zoom, measure, compare: loaded at a click"
        frame = page.PageSection(
            "viewer", "Look for yourself", [page.EmbeddedPage(address, "Viewer", summary)], "Viewer"
        )
        shown = [frame, *shown]
    made = page.Page(
        title=settings.title or head.title or stamp["scene"],
        subtitle=Markup("Scene <code>{}</code>, {}.").format(stamp["scene"], head.about),
        sections=[*shown, *closing],
        version=stamp["version"],
        footer=f"Nishiki {stamp['version']}, scene {stamp['scene']}, report {stamp['key']}.",
        stamp=f"{stamp['scene']}/{stamp['stage']}/{stamp['key']}",
        facts=head.facts,
        tiles=head.tiles,
        verdict=head.verdict,
        warnings=[*head.warnings, *beyond],
    )
    html = page.render_page(made)
    context.output.path("report.html").write_text(html, encoding="utf-8")
    rendered = (artifact for stage, artifact in inputs.items() if stage.endswith("render"))
    pictures = (page.contents(each, f"{name}.png") for each in rendered for name in each.diagnostics["pictures"])
    if picture := next(filter(None, pictures), None):
        context.output.path(THUMBNAIL).write_bytes(file_jpeg(picture, THUMBNAIL_COLUMNS))
    return {
        "bytes": len(html.encode()),
        "stages": sorted(inputs),
        "title": made.title,
        "about": head.about,
        "figures": [dataclasses.asdict(tile) for tile in head.tiles],
    }


def closing_sections(
    inputs: Mapping[str, Artifact],
    stages: Mapping[str, Any],
    stamp: Mapping[str, str],
    left_out: Mapping[str, str],
    more_left_out: Sequence[page.Block] = (),
    more_made: Sequence[page.Block] = (),
) -> list[page.PageSection]:
    """Return the last four sections. left_out : of the plan, name to reason."""
    there = [name for name in stages if name in inputs]
    diagnostics = {name: inputs[name].diagnostics for name in there}
    rows = [row for name in there for row in conditions(inputs[name].manifest, stages[name].limits)]
    made = (
        "Each stage below left one artifact, named by a key over its settings and inputs. Settings that differ from "
        "the default are marked. Times and memory of a run are in its run.json, outside of what is digested, so that "
        "the same inputs give the same bytes."
    )
    return [
        page.PageSection("left-out", "What was read and what was left out, and why",
                [*left_out_blocks(left_out, diagnostics), *more_left_out], "Left out"),
        page.PageSection("conditions", "Conditions and flags", [page.Table(
            ("Stage", "figure", "value", "expected", "state"), rows, "lwrll",
            "Condition numbers, flagged shares and errors of every stage, with the limits beyond which a run stops, "
            "or warns, unless the stage's setting “allow” names them.")], "Conditions"),
        page.PageSection("made", "How it was made",
                [*more_made, made, *(record(inputs[name].manifest, stages[name]) for name in there)]),
        page.PageSection("verify", "How to verify", verification(stamp)),
    ]  # fmt: skip


def left_out_blocks(left_out: Mapping[str, str], diagnostics: Mapping[str, Mapping[str, Any]]) -> list[page.Block]:
    """Return omissions of the plan, files of the capture read by ingest, and measured decisions of stages.

    diagnostics : of every stage by its name: `read` of ingest says what was read, `economy` of any stage what it
    decided (see `nishiki.model_selection.decision`).
    """
    blocks: list[page.Block] = []
    if read := diagnostics.get("ingest", {}).get("read"):
        files = [
            (row["what"], row["read"], row["of"], f"{row['bytes_read'] / 1e6:.2f}", f"{row['bytes_of'] / 1e6:.2f}")
            for row in [*read["files"], {**read["total"], "what": "all files"}]
        ]
        caption = "Files of the capture. Those that no stage of the plan looks at were not opened."
        blocks.append(
            page.Table(("files", "read", "of", "MB read", "MB of"), files, "lrrrr", caption, last_is_sum=True)
        )
        kept = "{} of {} channels".format(*read["channels"])
        blocks.append(f"Kept of that: {kept}.")
    blocks.append(page.Facts(sorted(left_out.items())) if left_out else "The plan left nothing out.")
    decided = [
        (stage, what.replace("_", " "), *(entry.get(name) for name in ("decision", "criterion")),
         *("" if entry.get(name) is None else entry[name] for name in ("measured", "limit")),
         *(entry.get(name) for name in ("loss", "override")))
        for stage, reported in diagnostics.items()
        for what, entry in (reported.get("economy") or {}).items()
    ]  # fmt: skip
    if decided:
        head = ("stage", "what", "decision", "criterion", "measured", "limit", "loss", "to decide otherwise")
        caption = "Decided by the stages themselves, each by what it measured; a setting overrides most of them."
        blocks.append(page.Table(head, decided, "llwwrrww", caption))
    return blocks


def conditions(manifest: Mapping[str, Any], limits: Sequence[Limit]) -> list[tuple[page.Cell, ...]]:
    """Return rows (stage, meaning, value, limit, state) of one artifact; last, the parameters that ended at a bound.

    A run stops where a result is beyond a limit and not allowed to be; beyond some it goes on with a warning.
    """
    stage, rows = manifest["stage"], list[tuple[page.Cell, ...]]()
    for check in limit_checks(limits, manifest["diagnostics"], manifest["settings"].get("allow", ())):
        limit = check.limit
        stated = "none"
        if limit.most is not None:
            stated = f"at most {plain(limit.most)}"
        elif limit.least is not None:
            stated = f"at least {plain(limit.least)}"
        state = "–"
        if limit.stated:
            state = "doubtful" if limit.doubtful(check.value) and not check.beyond else "within"
            state = state if not check.beyond else "beyond, allowed" if check.allowed else f"beyond: {limit.remedy}"
        rows.append((stage, limit.meaning, plain(check.value), stated, state))
    for parameter in at_bounds(manifest["diagnostics"]):
        rows.append((stage, f"fitted parameter at a bound: {parameter}", None, "inside its range", "at its bound"))
    return rows


def record(manifest: Mapping[str, Any], stage: Any) -> page.Fold:
    """Return settings, diagnostics, inputs, code and libraries of one stage."""
    name, key = manifest["stage"], manifest["key"]
    rows, changed = settings_rows(manifest["settings"], stage.settings)
    upstream = [
        Markup("{} <code>{}</code>").format(other, entry.get("key") or f"sha256 {entry['digest'][:12]}…")
        for other, entry in manifest["upstream"].items()
    ]
    libraries = [f"{library} {version}" for library, version in sorted(manifest.get("libraries", {}).items())]
    megabytes = sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6
    code = Markup("<code>{}</code>").format
    blocks: list[page.Block] = [
        page.Table(("name", "value", "default", "meaning"), rows, "lwww", "Settings", marked=changed),
        page.Table((), [(code(place), value) for place, value in flat(manifest["diagnostics"])], "lw", "Diagnostics"),
        page.Facts([
            ("Made from", Markup(", ").join(upstream)),
            ("Code", code(manifest.get("code") or "not recorded")),
            ("Libraries", ", ".join(libraries) or "not recorded"),
            ("Files", f"{figure(len(manifest['files']))}, {megabytes:.1f} MB"),
            ("Times, memory", code(f"{name}/{key}/run.json")),
        ]),
    ]  # fmt: skip
    mark = f"{len(changed)} setting{'s' * (len(changed) > 1)} changed" if changed else ""
    return page.Fold(name, stage.does, blocks, code=key, mark=mark)


def settings_rows(values: Mapping[str, Any], model: type[Closed]) -> tuple[list[tuple[page.Cell, ...]], set[int]]:
    """List name, value, default and meaning of each setting in the order of the model; numbers of the changed ones."""
    defaults = model().model_dump(mode="json")
    rows: list[tuple[page.Cell, ...]] = []
    changed = set()
    for number, (name, field) in enumerate(model.model_fields.items()):
        value = values.get(name, defaults[name])
        planned = name in PLANNED
        if not planned and canonical(value) != canonical(defaults[name]):
            changed.add(number)
        default = "set by the plan" if planned else text(defaults[name])
        rows.append((Markup("<code>{}</code>").format(name), text(value), default, field.description or ""))
    return rows, changed


def verification(stamp: Mapping[str, str]) -> list[page.Block]:
    """Return the commands that check all of it."""
    scene, code = stamp["scene"], Markup("<code>{}</code>").format
    return [
        Markup(
            "Every file of every artifact is listed with its SHA-256 in an <code>artifact.json</code>, which also "
            "names the artifacts that it was made from and their digests. Paths are relative to {}."
        ).format(code(f"results/{scene}/")),
        page.CommandLines(
            f"./nishiki verify results/{scene}       # recompute every digest; names each damaged, missing or foreign "
            f"file\n./nishiki explain {scene}              # would anything run again, and why\n"
            "./nishiki run                        # make whatever is missing or out of date"
        ),
        Markup(
            "This page is itself an artifact: {}. It holds no date: the same inputs give the same page byte for byte."
        ).format(code(f"{stamp['stage']}/{stamp['key']}")),
    ]


def flat(values: Mapping[str, Any], path: str = "") -> list[tuple[str, str]]:
    """Return diagnostics as (name, text) lines; blocks become dotted names, long lists are cut."""
    lines = []
    for name, value in values.items():
        place = f"{path}.{name}" if path else name
        lines += flat(value, place) if isinstance(value, dict) else [(place, text(value))]
    return lines


def text(value: Any) -> str:
    """Return a setting or diagnostic as short text."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return plain(value, 6)
    if isinstance(value, dict):
        value = ", ".join(f"{key}: {text(item)}" for key, item in value.items()) or "none"
    elif isinstance(value, list | tuple):
        value = ", ".join(text(item) for item in value) or "none"
    line = str(value) or "(empty)"
    return line if len(line) <= LONGEST_TEXT else line[: LONGEST_TEXT - 1] + "…"
