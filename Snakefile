# Nishiki: from photographs under controlled light to the appearance of an object.
# `./nishiki run` calls this with the profile in workflow/profiles/default; see README.md.
from snakemake.utils import min_version

min_version("9.0")


configfile: "config/config.yaml"


include: "workflow/rules/common.smk"


wildcard_constraints:
    scene="[A-Za-z0-9_-]+",
    key="[0-9a-f]{12}",


include: "workflow/rules/ingest.smk"
include: "workflow/rules/separate.smk"
include: "workflow/rules/normals.smk"
include: "workflow/rules/height.smk"
include: "workflow/rules/spectra.smk"
include: "workflow/rules/brdf.smk"
include: "workflow/rules/render.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/polarise.smk"
include: "workflow/rules/cameras.smk"
include: "workflow/rules/mesh.smk"
include: "workflow/rules/texels.smk"
include: "workflow/rules/reflection.smk"
include: "workflow/rules/residual.smk"
include: "workflow/rules/object_render.smk"
include: "workflow/rules/object_evaluate.smk"
include: "workflow/rules/object_report.smk"
include: "workflow/rules/reflectance.smk"
include: "workflow/rules/weave.smk"
include: "workflow/rules/fabric.smk"
include: "workflow/rules/fabric_render.smk"
include: "workflow/rules/fabric_evaluate.smk"
include: "workflow/rules/fabric_report.smk"
include: "workflow/rules/publish.smk"
include: "workflow/rules/part.smk"
include: "workflow/rules/sweep.smk"


rule all:
    default_target: True
    input:
        lambda wildcards: [f"{RESULTS}/{scene}/current/index.json" for scene in SCENES],
        # Each artifact is asked for: Snakemake would not make one again that is missing below an index that is there.
        lambda wildcards: [
            manifest for scene in SCENES for manifest in FLOW.artifacts(scene)
        ],
