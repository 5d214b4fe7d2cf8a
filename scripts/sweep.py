"""Sweep: table, page and drawings of error against run time, from the evaluations and timed repeats of all variants."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import _project  # noqa: F401
from nishiki.artifacts.artifact import open_artifact
from nishiki.capture.taking import table_text
from nishiki.engine.plan import PlannedVariant, SceneSweep
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError, require
from nishiki.formats.files import put_file
from nishiki.sweep.page import render_sweep, scene_content, sweep_content, table_rows
from nishiki.sweep.variants import (
    MeasureSettings,
    VariantRow,
    as_measure,
    average_common,
    candidates,
    paths_in,
    values_of,
    variant_row,
)
from nishiki.version import PROJECT_VERSION


def main() -> None:
    """Write sweep.html, sweep.csv and the drawings, and sweep.json when they are all there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configuration", required=True, metavar="JSON", help="configuration, with the sweep's name")
    parser.add_argument("--output", type=Path, required=True, help="sweep.json to make")
    arguments = parser.parse_args()
    try:
        flow = Workflow(json.loads(arguments.configuration))
        sweep = require(flow.sweep)
        scenes = []
        for swept in sweep.scenes:
            measures, errors = errors_of(flow, swept)
            rows = [row_of(flow, swept, variant, errors[variant.name]) for variant in swept.variants]
            scenes.append(
                scene_content(
                    swept.scene,
                    rows,
                    measures,
                    axis=sweep.settings.axis,
                    counted=swept.counted,
                    evaluation=swept.evaluation,
                )
            )
        title = sweep.settings.title or f"Sweep {sweep.name}"
        content = sweep_content(sweep.name, title, PROJECT_VERSION, sweep.settings, scenes)
    except UserError as error:
        raise SystemExit(f"nishiki sweep: {error}") from None
    folder = arguments.output.parent
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files_of(content).items():
        put_file(folder / name, text)
    put_file(arguments.output, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def errors_of(flow: Workflow, swept: SceneSweep) -> tuple[list[MeasureSettings], dict[str, list[float]]]:
    """Return the sweep's measures, or the usual one of the evaluations, and their values for every variant."""
    evaluations = {variant.name: evaluation_of(flow, swept, variant) for variant in swept.variants}
    settings = {
        variant.name: {name: stage.settings for name, stage in variant.plan.stages.items()}
        for variant in swept.variants
    }

    def values(measure: MeasureSettings) -> dict[str, float | None]:
        return average_common(
            {name: values_of(measure, sources, settings[name]) for name, sources in evaluations.items()}
        )

    asked = [as_measure(given) for given in require(flow.sweep).settings.error]
    if not asked:
        usual = candidates(require(flow.sweep).settings.stage, swept.facts.geometry)
        asked = [next((one for one in usual if None not in values(one).values()), usual[-1])]
    table = {name: [] for name in evaluations}
    for measure in asked:
        for name, value in values(measure).items():
            if value is None:
                known = ", ".join(paths_in(evaluations[name][0])[:40])
                raise UserError(
                    f"the evaluation of {swept.scene}, variant {name!r}, has no figure {measure.path!r}. Remedy: name "
                    f"another one under `error`; its diagnostics hold: {known}"
                )
            table[name].append(value)
    return asked, table


def evaluation_of(flow: Workflow, swept: SceneSweep, variant: PlannedVariant) -> list[dict]:
    """Read the sources of a measure: the evaluation's diagnostics, then evaluation.json."""
    artifact = open_artifact(Path(flow.evaluation(swept, variant)))
    return [artifact.diagnostics, json.loads(artifact.path("evaluation.json").read_text(encoding="utf-8"))]


def row_of(flow: Workflow, swept: SceneSweep, variant: PlannedVariant, errors: list[float]) -> VariantRow:
    """Read the result of one variant."""
    records = {
        stage: [json.loads(Path(path).read_text()) for path in paths]
        for stage, paths in flow.timings(swept, variant).items()
    }
    settings = require(flow.sweep).settings
    default = settings.default or swept.variants[0].names[0]
    keys = {stage: variant.plan.stages[stage].key for stage in records}
    return replace(
        variant_row(variant.name, variant.names, variant.changes, errors, records, keys=keys),
        default=default in variant.names,
        paper=settings.paper in variant.names,
        peer=bool(set(settings.peers) & set(variant.names)),
        apart=bool(set(settings.apart) & set(variant.names)),
    )


def files_of(content: dict) -> dict[str, str]:
    """Write the page, the table and the drawings as texts, by file name."""
    rows = table_rows(content)
    names = list(dict.fromkeys(key for row in rows for key in row))
    table = table_text([names, *([row.get(name, "") for name in names] for row in rows)])
    drawings = {plot["file"]: plot["svg"] for scene in content["scenes"] for plot in scene["plots"]}
    return {**drawings, "sweep.csv": table, "sweep.html": render_sweep(content)}


if __name__ == "__main__":
    main()
