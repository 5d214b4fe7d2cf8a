rule separate:
    input:
        upstream("separate"),
    output:
        artifact("separate"),
    params:
        **params_of("separate"),
    threads: 2
    resources:
        mem_mb=memory_of("separate"),
        runtime=minutes_of("separate"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
