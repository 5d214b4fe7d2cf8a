rule cameras:
    input:
        upstream("cameras"),
    output:
        artifact("cameras"),
    group:
        group_of("cameras")
    conda:
        "../../envs/object.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("cameras"),
        runtime=minutes_of("cameras"),
    params:
        **params_of("cameras"),
    shell:
        RUN_STAGE
