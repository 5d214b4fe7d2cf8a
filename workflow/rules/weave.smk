rule weave:
    input:
        upstream("weave"),
    output:
        artifact("weave"),
    group:
        group_of("weave")
    conda:
        "../../envs/fabric.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("weave"),
        runtime=minutes_of("weave"),
    params:
        **params_of("weave"),
    shell:
        RUN_STAGE
