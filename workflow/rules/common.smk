# What every rule is made of: paths, inputs, parameters and resources, all derived from the plans.
import json
import os
import shlex
import sys

PROJECT_FOLDER = workflow.basedir
SOURCE = os.path.join(PROJECT_FOLDER, "workflow", "src")
if os.path.isdir(SOURCE):  # a checkout; an installed package is on the path
    sys.path.insert(0, SOURCE)

from nishiki.errors import UserError
from nishiki.artifacts.provenance import canonical
from nishiki.engine.workflow import PARTS
from nishiki.engine.workflow import Workflow
from nishiki.stages.table import CHAIN
from nishiki.engine.running_lock import scenes_to_make
from nishiki.processes import interrupt_when_terminated
from nishiki.threads import ALONE, VARIABLES as THREADS
from snakemake.exceptions import WorkflowError

shell.prefix(f"export PATH={shlex.quote(os.path.dirname(sys.executable))}:$PATH; ")

try:
    FLOW = Workflow(config, lazy=True)
except UserError as error:
    raise WorkflowError(str(error)) from None

PLANS = FLOW.plans
RESULTS = FLOW.results
# A run asks for its unfinished scenes; a Snakemake that is started by hand for all.
SCENES = scenes_to_make(FLOW.project.results, PLANS)

# Quoted for the shell, its braces for Snakemake.
SCRIPTS = shlex.quote(os.path.join(PROJECT_FOLDER, "scripts"))
SCRIPTS = SCRIPTS.replace("{", "{{").replace("}", "}}")

# The one command of all stages; {rule} names the stage.
RUN_STAGE = (
    " ".join(
        [
            *(f"{name}={{threads}}" for name in THREADS),
            *(f"{name}={n}" for name, n in ALONE.items()),
        ]
    )
    + " python "
    + SCRIPTS
    + "/stage.py {rule} --scene {wildcards.scene} {params.source} --settings {params.settings:q}"
    " --code {params.code} --libraries {params.libraries:q} --inputs {input:q} --output {output:q}"
)
# The same of one part of a divided stage.
RUN_PART = (
    RUN_STAGE.replace("{rule}", "{wildcards.stage}")
    + " --part {wildcards.number}/{wildcards.total}"
)


def artifact(stage):
    """Declared output of a stage; `update` keeps the finished one until its successor is complete."""
    return update(f"{RESULTS}/{{scene}}/{stage}/{{key}}/artifact.json")


def upstream(stage):
    """Input function: artifacts that a stage of a scene reads, and its own parts where it is divided."""
    return lambda wildcards: (
        FLOW.inputs(wildcards.scene, stage, wildcards.key)
        + FLOW.part_paths(wildcards.scene, stage, wildcards.key)
    )


def params_of(stage):
    """Parameters whose change reruns a stage: its code, its libraries, its settings."""
    return {
        "settings": lambda wildcards: canonical(
            FLOW.stage(wildcards.scene, stage, wildcards.key).settings
        ),
        "source": lambda wildcards: FLOW.source(wildcards.scene, stage),
        "code": lambda wildcards: FLOW.code(stage),
        "libraries": lambda wildcards: FLOW.libraries(
            wildcards.scene, stage, wildcards.key
        ),
    }


# Inside a job of a cluster two processes of Snakemake wait for the stage.
ENGINE_MB = 400


def memory_of(stage):
    """Memory by the cost model, half as much again at each further attempt."""
    return lambda wildcards, attempt: job_memory(wildcards.scene, stage, attempt)


def job_memory(scene, stage, attempt):
    beside = ENGINE_MB if workflow.non_local_exec else 0
    return FLOW.memory_mb(scene, stage, attempt, beside=beside)


def minutes_of(stage):
    """Time limit by the cost model, twice as long at each further attempt."""
    return lambda wildcards, attempt: FLOW.minutes(wildcards.scene, stage, attempt)


def group_of(stage):
    """Jobs of one scene that a cluster runs as one; no group on this machine."""
    return lambda wildcards: (
        FLOW.group(wildcards.scene, stage, wildcards.key)
        if workflow.non_local_exec
        else None
    )
