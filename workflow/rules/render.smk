rule render:
    input:
        upstream("render"),
    output:
        artifact("render"),
    params:
        **params_of("render"),
    threads: 2
    resources:
        mem_mb=memory_of("render"),
        runtime=minutes_of("render"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
