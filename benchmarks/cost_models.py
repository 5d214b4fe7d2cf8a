"""What the stages took against what their cost models say: peak memory and processor time, one JSON line a stage.

    python benchmarks/cost_models.py                              simulate tiny scenes of all chains, run, compare
    python benchmarks/cost_models.py --configfile config.yaml     compare the finished results of a configuration

A ratio is model over measurement: below 1 a cluster would kill the job, above 2 it would reserve more than twice what
is needed. `fixed` tells how much of the model's memory does not grow with the scene.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT / "workflow/src"))
TINY = ("tiny", "object-tiny", "satin-tiny")


def nishiki(folder: Path, *arguments: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    command = [sys.executable, "-m", "nishiki", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)


def tiny_results(folder: Path) -> None:
    """Simulated tiny scenes, run twice: the second time with kernels that are compiled already."""
    rows = "".join(f"{name}\t{name}\t{name}-truth\n" for name in TINY)
    (folder / "scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
    (folder / "config.yaml").write_text("scenes: scenes.tsv\n")
    for name in TINY:
        nishiki(folder, "simulate", "--output", name, "--truth", f"{name}-truth", "--preset", name)
    for _ in range(2):
        nishiki(folder, "run", "--configfile", "config.yaml", "--forceall")


def compared(configfile: Path) -> list[dict]:
    """A line for each finished artifact of a configuration, relative to the present folder."""
    from nishiki.artifacts.artifact import RUN
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow
    from nishiki.stages.table import CHAIN

    flow = Workflow(load_yaml(configfile))
    lines = []
    for scene, plan in flow.plans.items():
        for stage in plan.stages:
            path = Path(flow.artifact(scene, stage)).with_name(RUN)
            if not path.is_file():
                continue
            run = json.loads(path.read_text())
            memory, seconds = flow.memory_mb(scene, stage), flow.seconds(scene, stage)
            lines.append(
                {
                    "stage": stage,
                    "geometry": plan.facts.geometry,
                    "scene": scene,
                    "pixels": plan.facts.pixels,
                    "observations": plan.facts.observations,
                    "peak_memory_mib": run["peak_memory_mib"],
                    "model_memory_mib": memory,
                    "memory_ratio": round(memory / run["peak_memory_mib"], 2),
                    "fixed": round(CHAIN[stage].cost(plan.facts).mib / memory, 2),
                    "processor_s": run["process_cpu_seconds"],
                    "model_s": round(seconds, 1),
                    "time_ratio": round(seconds / run["process_cpu_seconds"], 2),
                    "wall_s": run["seconds"],
                }
            )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configfile", type=Path, help="a configuration whose results are there")
    options = parser.parse_args()
    if options.configfile:
        os.chdir(options.configfile.resolve().parent)
        report(compared(Path(options.configfile.name)))
        return
    with tempfile.TemporaryDirectory() as name:
        tiny_results(Path(name))
        os.chdir(name)
        report(compared(Path("config.yaml")))
        os.chdir(PROJECT)


def report(lines: list[dict]) -> None:
    for line in lines:
        print(json.dumps({"case": "cost model", **line}))
    for what in ("memory_ratio", "time_ratio"):
        ratios = [line[what] for line in lines]
        summary = {"case": f"all stages, {what}", "stages": len(lines), "least": min(ratios), "most": max(ratios)}
        print(json.dumps({**summary, "below_1": sum(ratio < 1 for ratio in ratios), "default": True}))


if __name__ == "__main__":
    main()
