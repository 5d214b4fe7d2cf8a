rule height:
    input:
        upstream("height"),
    output:
        artifact("height"),
    params:
        **params_of("height"),
    threads: 1
    resources:
        mem_mb=memory_of("height"),
        runtime=minutes_of("height"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
