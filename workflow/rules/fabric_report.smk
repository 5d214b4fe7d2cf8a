rule fabric_report:
    input:
        upstream("fabric_report"),
    output:
        artifact("fabric_report"),
    group:
        group_of("fabric_report")
    conda:
        "../../envs/fabric.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("fabric_report"),
        runtime=minutes_of("fabric_report"),
    params:
        **params_of("fabric_report"),
    shell:
        RUN_STAGE
