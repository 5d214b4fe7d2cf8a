rule report:
    input:
        upstream("report"),
    output:
        artifact("report"),
    params:
        **params_of("report"),
    threads: 1
    resources:
        mem_mb=memory_of("report"),
        runtime=minutes_of("report"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
