rule evaluate:
    input:
        upstream("evaluate"),
    output:
        artifact("evaluate"),
    params:
        **params_of("evaluate"),
    threads: 2
    resources:
        mem_mb=memory_of("evaluate"),
        runtime=minutes_of("evaluate"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
