rule object_report:
    input:
        upstream("object_report"),
    output:
        artifact("object_report"),
    group:
        group_of("object_report")
    conda:
        "../../envs/object.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("object_report"),
        runtime=minutes_of("object_report"),
    params:
        **params_of("object_report"),
    shell:
        RUN_STAGE
