rule separate:
    input:
        upstream("separate"),
    output:
        artifact("separate"),
    group:
        group_of("separate")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("separate"),
        runtime=minutes_of("separate"),
    params:
        **params_of("separate"),
    shell:
        RUN_STAGE
