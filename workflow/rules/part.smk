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
