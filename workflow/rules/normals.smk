rule normals:
    input:
        upstream("normals"),
    output:
        artifact("normals"),
    group:
        group_of("normals")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("normals"),
        runtime=minutes_of("normals"),
    params:
        **params_of("normals"),
    shell:
        RUN_STAGE
