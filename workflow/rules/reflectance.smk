rule reflectance:
    input:
        upstream("reflectance"),
    output:
        artifact("reflectance"),
    group:
        group_of("reflectance")
    conda:
        "../../envs/fabric.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("reflectance"),
        runtime=minutes_of("reflectance"),
    params:
        **params_of("reflectance"),
    shell:
        RUN_STAGE
