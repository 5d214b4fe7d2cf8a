rule evaluate:
    input:
        upstream("evaluate"),
    output:
        artifact("evaluate"),
    group:
        group_of("evaluate")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("evaluate"),
        runtime=minutes_of("evaluate"),
    params:
        **params_of("evaluate"),
    shell:
        RUN_STAGE
