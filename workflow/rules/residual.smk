rule residual:
    input:
        upstream("residual"),
    output:
        artifact("residual"),
    group:
        group_of("residual")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("residual"),
        runtime=minutes_of("residual"),
    params:
        **params_of("residual"),
    shell:
        RUN_STAGE
