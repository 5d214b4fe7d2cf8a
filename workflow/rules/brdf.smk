rule brdf:
    input:
        upstream("brdf"),
    output:
        artifact("brdf"),
    params:
        **params_of("brdf"),
    threads: 2
    resources:
        mem_mb=memory_of("brdf"),
        runtime=minutes_of("brdf"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
