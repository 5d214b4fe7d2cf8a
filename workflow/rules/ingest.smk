rule ingest:
    input:
        upstream("ingest"),
    output:
        artifact("ingest"),
    params:
        **params_of("ingest"),
    threads: 2
    resources:
        mem_mb=memory_of("ingest"),
        runtime=minutes_of("ingest"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
