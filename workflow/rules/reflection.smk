rule reflection:
    input:
        upstream("reflection"),
    output:
        artifact("reflection"),
    group:
        group_of("reflection")
    conda:
        "../../envs/object.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("reflection"),
        runtime=minutes_of("reflection"),
    params:
        **params_of("reflection"),
    shell:
        RUN_STAGE
