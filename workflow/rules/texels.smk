rule texels:
    input:
        upstream("texels"),
    output:
        artifact("texels"),
    group:
        group_of("texels")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("texels"),
        runtime=minutes_of("texels"),
    params:
        **params_of("texels"),
    shell:
        RUN_STAGE
