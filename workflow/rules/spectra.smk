rule spectra:
    input:
        upstream("spectra"),
    output:
        artifact("spectra"),
    params:
        **params_of("spectra"),
    threads: 1
    resources:
        mem_mb=memory_of("spectra"),
        runtime=minutes_of("spectra"),
    conda:
        "../../envs/painting.yaml"
    shell:
        RUN_STAGE
