rule object_render:
    input:
        upstream("object_render"),
    output:
        artifact("object_render"),
    group:
        group_of("object_render")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("object_render"),
        runtime=minutes_of("object_render"),
    params:
        **params_of("object_render"),
    shell:
        RUN_STAGE
