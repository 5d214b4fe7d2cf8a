rule render:
    input:
        upstream("render"),
    output:
        artifact("render"),
    group:
        group_of("render")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("render"),
        runtime=minutes_of("render"),
    params:
        **params_of("render"),
    shell:
        RUN_STAGE
