rule ingest:
    input:
        upstream("ingest"),
    output:
        artifact("ingest"),
    group:
        group_of("ingest")
    conda:
        "../../envs/painting.yaml"
    threads: 2
    resources:
        mem_mb=memory_of("ingest"),
        runtime=minutes_of("ingest"),
    params:
        **params_of("ingest"),
    shell:
        RUN_STAGE
