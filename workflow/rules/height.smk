rule height:
    input:
        upstream("height"),
    output:
        artifact("height"),
    group:
        group_of("height")
    conda:
        "../../envs/painting.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("height"),
        runtime=minutes_of("height"),
    params:
        **params_of("height"),
    shell:
        RUN_STAGE
