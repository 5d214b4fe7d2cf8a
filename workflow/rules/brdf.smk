rule brdf:
    input:
        upstream("brdf"),
    output:
        artifact("brdf"),
    group:
        group_of("brdf")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("brdf"),
        runtime=minutes_of("brdf"),
    params:
        **params_of("brdf"),
    shell:
        RUN_STAGE
