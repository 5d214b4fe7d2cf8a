rule mesh:
    input:
        upstream("mesh"),
    output:
        artifact("mesh"),
    group:
        group_of("mesh")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("mesh"),
        runtime=minutes_of("mesh"),
    params:
        **params_of("mesh"),
    shell:
        RUN_STAGE
