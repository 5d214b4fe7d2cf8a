rule normals:
    input:
        upstream("normals"),
    output:
        artifact("normals"),
    params:
        **params_of("normals"),
    threads: 2
    resources:
        mem_mb=memory_of("normals"),
        runtime=minutes_of("normals"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
