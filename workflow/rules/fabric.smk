rule fabric:
    input:
        upstream("fabric"),
    output:
        artifact("fabric"),
    group:
        group_of("fabric")
    conda:
        "../../envs/fabric.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("fabric"),
        runtime=minutes_of("fabric"),
    params:
        **params_of("fabric"),
    shell:
        RUN_STAGE
