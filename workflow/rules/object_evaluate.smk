rule object_evaluate:
    input:
        upstream("object_evaluate"),
    output:
        artifact("object_evaluate"),
    group:
        group_of("object_evaluate")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("object_evaluate"),
        runtime=minutes_of("object_evaluate"),
    params:
        **params_of("object_evaluate"),
    shell:
        RUN_STAGE
