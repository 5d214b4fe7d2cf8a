rule fabric_render:
    input:
        upstream("fabric_render"),
    output:
        artifact("fabric_render"),
    group:
        group_of("fabric_render")
    conda:
        "../../envs/fabric.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("fabric_render"),
        runtime=minutes_of("fabric_render"),
    params:
        **params_of("fabric_render"),
    shell:
        RUN_STAGE
