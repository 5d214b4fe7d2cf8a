# One rule a stage, from the table of the stages.
ENVIRONMENTS = {"turntable": "object", "goniometer": "cloth"}

for stage in CHAIN.values():

    rule:
        name:
            stage.name
        input:
            upstream(stage.name),
        output:
            artifact(stage.name),
        group:
            group_of(stage.name)
        conda:
            f"../../envs/{ENVIRONMENTS.get(stage.geometry, 'painting')}.yaml"
        threads: stage.threads
        resources:
            mem_mb=memory_of(stage.name),
            runtime=minutes_of(stage.name),
        params:
            **params_of(stage.name),
        shell:
            RUN_STAGE
