# What is not a stage: links to the present artifacts, parts of divided stages, sweeps.
# results/<scene>/current: links to the artifacts of the present configuration, and to what a user wants to open.
localrules:
    publish,


rule publish:
    input:
        lambda wildcards: FLOW.artifacts(wildcards.scene),
    output:
        update(f"{RESULTS}/{{scene}}/current/index.json"),
    conda:
        "../../envs/painting.yaml"
    params:
        stages=lambda wildcards: FLOW.stages_text(wildcards.scene),
        code=lambda wildcards: FLOW.code("publish"),
    shell:
        "python "
        + SCRIPTS
        + "/publish.py --scene {wildcards.scene} --stages {params.stages:q} --code {params.code} --output {output:q}"


# A part of a divided stage, for any stage; the stage's own rule joins the parts, and they are removed.
def share(wildcards):
    return 1 / int(wildcards.total)


rule part:
    input:
        lambda wildcards: FLOW.inputs(wildcards.scene, wildcards.stage, wildcards.key),
    output:
        temp(
            directory(
                f"{RESULTS}/{PARTS}/{{scene}}/{{stage}}/{{key}}/{{number}}-of-{{total}}"
            )
        ),
    wildcard_constraints:
        stage="[a-z_]+",
        number="[0-9]+",
        total="[0-9]+",
    group:
        lambda wildcards: (
            FLOW.group(wildcards.scene, wildcards.stage, wildcards.key, part=True)
            if workflow.non_local_exec
            else None
        )
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: job_memory(
            wildcards.scene, wildcards.stage, attempt
        ),
        runtime=lambda wildcards, attempt: FLOW.minutes(
            wildcards.scene, wildcards.stage, attempt, share(wildcards)
        ),
    params:
        settings=lambda wildcards: canonical(
            FLOW.stage(wildcards.scene, wildcards.stage, wildcards.key).settings
        ),
        source=lambda wildcards: FLOW.source(wildcards.scene, wildcards.stage),
        code=lambda wildcards: FLOW.code(wildcards.stage),
        libraries=lambda wildcards: FLOW.libraries(
            wildcards.scene, wildcards.stage, wildcards.key
        ),
    shell:
        RUN_PART


# Sweeps: each timed repeat is a job of its own, alone on the machine; the page is made when all are there.
RUN_REPEAT = (
    "python "
    + SCRIPTS
    + "/repeat.py --first {params.first:q} --threads {params.threads} --output {output:q} -- "
    "--scene {wildcards.scene} {params.source} --settings {params.settings:q}"
    " --code {params.code} --libraries {params.libraries:q} --inputs {params.inputs:q}"
)


def usual_threads(wildcards):
    """Threads that the stage's own rule would get here."""
    declared = workflow.get_rule(wildcards.stage).resources["_cores"]
    return min(int(getattr(declared, "value", declared)), all_cores(wildcards))


def all_cores(wildcards):
    """All processors of this machine, so that a repeat runs alone; on a cluster, which has no such number, two."""
    try:
        return workflow.cores
    except WorkflowError:
        return 2


rule repeat:
    input:
        lambda wildcards: FLOW.inputs(wildcards.scene, wildcards.stage, wildcards.key),
        first=lambda wildcards: FLOW.path(
            wildcards.scene, wildcards.stage, wildcards.key
        ),
    output:
        update(FLOW.timing("{scene}", "{stage}", "{key}", "{number}")),
    wildcard_constraints:
        stage="[a-z_]+",
        number="[0-9]+",
    conda:
        "../../envs/painting.yaml"
    threads: all_cores
    resources:
        mem_mb=lambda wildcards: FLOW.memory_mb(wildcards.scene, wildcards.stage),
        runtime=lambda wildcards: FLOW.minutes(wildcards.scene, wildcards.stage),
    params:
        settings=lambda wildcards: canonical(
            FLOW.stage(wildcards.scene, wildcards.stage, wildcards.key).settings
        ),
        source=lambda wildcards: FLOW.source(wildcards.scene, wildcards.stage),
        code=lambda wildcards: FLOW.code(wildcards.stage),
        libraries=lambda wildcards: FLOW.libraries(
            wildcards.scene, wildcards.stage, wildcards.key
        ),
        first=lambda wildcards: FLOW.path(
            wildcards.scene, wildcards.stage, wildcards.key
        ),
        inputs=lambda wildcards: FLOW.inputs(
            wildcards.scene, wildcards.stage, wildcards.key
        ),
        threads=usual_threads,
    shell:
        RUN_REPEAT


rule sweep:
    input:
        FLOW.sweep_inputs(),
    output:
        update(FLOW.sweep_path("sweep.json")),
    conda:
        "../../envs/painting.yaml"
    params:
        configuration=canonical(config),
        plan=FLOW.sweep_text(),
        code=FLOW.code("sweep"),
    shell:
        "python "
        + SCRIPTS
        + "/sweep.py --configuration {params.configuration:q} --output {output:q}"
