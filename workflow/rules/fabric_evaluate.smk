rule fabric_evaluate:
    input:
        upstream("fabric_evaluate"),
    output:
        artifact("fabric_evaluate"),
    group:
        group_of("fabric_evaluate")
    conda:
        "../../envs/fabric.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("fabric_evaluate"),
        runtime=minutes_of("fabric_evaluate"),
    params:
        **params_of("fabric_evaluate"),
    shell:
        RUN_STAGE
