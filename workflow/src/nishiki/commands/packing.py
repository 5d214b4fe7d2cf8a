"""The command that packs one scene as a crate."""

import argparse
from pathlib import Path

from nishiki.archive.damage import shown
from nishiki.archive.digitisation import capture_method
from nishiki.archive.pack import PackedScene, pack, write_zip
from nishiki.artifacts.artifact import Artifact, open_artifact
from nishiki.artifacts.stage import PROJECT_VERSION
from nishiki.capture.schema_base import ABOUT
from nishiki.engine.plan import Plan
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError
from nishiki.installation import PROJECT
from nishiki.progress import Progress
from nishiki.stages.table import CHAIN


def pack_scene(options: argparse.Namespace, rest: list[str]) -> int:
    """Pack a finished scene: a folder, and a ZIP file of it where asked for."""
    from nishiki.engine.project import load_yaml

    target = Path(options.output)
    flow = Workflow(load_yaml(options.configfile), only=options.scene, file=options.configfile)
    (name,) = flow.plans
    expect_outside(target, Path(flow.results))
    scene = _scene(flow, name, flow.plans[name])
    tell = Progress(f"pack {name}")
    digest = pack(scene, PROJECT, target, with_capture=not options.without_capture, tell=tell)
    print(f"{shown(target)}: {len(scene.artifacts)} results; digest {digest}")
    if options.zip:
        archive = target.with_name(f"{target.name}.zip")
        write_zip(target, archive)
        print(shown(archive))
    return 0


def expect_outside(target: Path, results: Path) -> None:
    """UserError where a crate would lie inside the results or inside a sealed capture, which nothing may change."""
    for parent in target.resolve().parents:
        if parent == results.resolve():
            raise UserError(f"{target}: inside the results ({results}). Remedy: another folder")
        if (parent / "bagit.txt").is_file():
            raise UserError(f"{target}: inside the sealed capture {parent}. Remedy: another folder")


def _scene(flow: Workflow, name: str, plan: Plan) -> PackedScene:
    from nishiki.capture.folder import payload_of
    from nishiki.capture.schema import read_capture_file

    capture = plan.scene.capture
    described = read_capture_file(payload_of(capture) / "capture.yaml")
    stages = {
        stage: {"key": planned.key, "settings": planned.settings, "upstream": planned.upstream}
        for stage, planned in plan.stages.items()
    }
    return PackedScene(
        name=name,
        version=PROJECT_VERSION,
        artifacts=_artifacts(flow, name, plan),
        capture=capture,
        capture_digest=plan.facts.capture_digest,
        about={key: getattr(described, key) for key in ABOUT},
        facts={
            "products": list(plan.scene.products),
            "stages": stages,
            "left_out": dict(plan.left_out),
            "held_out": list(plan.held_out),
            "truth_sha256": plan.facts.truth_sha256,
        },
        does={stage: CHAIN[stage].does for stage in plan.stages},
        method=capture_method(described),
    )


def _artifacts(flow: Workflow, name: str, plan: Plan) -> list[Artifact]:
    """The artifacts of a scene, each made from the others. Raises UserError where a run has to come first."""
    artifacts: dict[str, Artifact] = {}
    for stage in plan.stages:
        try:
            artifacts[stage] = open_artifact(Path(flow.artifact(name, stage)))
        except UserError as error:
            raise UserError(f"{name} is not finished: {error}") from None
        for above, entry in artifacts[stage].manifest["upstream"].items():
            if above in artifacts and artifacts[above].digest != entry.get("digest"):
                raise UserError(f"{artifacts[stage].folder}: made from another {above}. Remedy: ./nishiki run first")
    return list(artifacts.values())
