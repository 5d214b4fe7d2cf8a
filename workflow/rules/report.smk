rule report:
    input:
        upstream("report"),
    output:
        artifact("report"),
    group:
        group_of("report")
    conda:
        "../../envs/painting.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("report"),
        runtime=minutes_of("report"),
    params:
        **params_of("report"),
    shell:
        RUN_STAGE
