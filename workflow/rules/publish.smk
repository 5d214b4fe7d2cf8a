# results/<scene>/current: links to the artifacts of the present configuration, and to what a user wants to open.
localrules:
    publish,


rule publish:
    input:
        lambda wildcards: FLOW.artifacts(wildcards.scene),
    output:
        update(f"{RESULTS}/{{scene}}/current/index.json"),
    conda:
        "../../envs/painting.yaml"
    params:
        stages=lambda wildcards: FLOW.stages_text(wildcards.scene),
        code=lambda wildcards: FLOW.code("publish"),
    shell:
        "python "
        + SCRIPTS
        + "/publish.py --scene {wildcards.scene} --stages {params.stages:q} --code {params.code} --output {output:q}"
