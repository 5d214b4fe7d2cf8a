rule spectra:
    input:
        upstream("spectra"),
    output:
        artifact("spectra"),
    group:
        group_of("spectra")
    conda:
        "../../envs/painting.yaml"
    threads: 1
    resources:
        mem_mb=memory_of("spectra"),
        runtime=minutes_of("spectra"),
    params:
        **params_of("spectra"),
    shell:
        RUN_STAGE
