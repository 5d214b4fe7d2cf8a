rule polarise:
    input:
        upstream("polarise"),
    output:
        artifact("polarise"),
    group:
        group_of("polarise")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("polarise"),
        runtime=minutes_of("polarise"),
    params:
        **params_of("polarise"),
    shell:
        RUN_STAGE
