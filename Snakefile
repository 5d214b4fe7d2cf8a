# Nishiki: from photographs under controlled light to the appearance of an object.
# `./nishiki run` calls this with the profile in workflow/profiles/default; see README.md.
from snakemake.utils import min_version

min_version("9.0")


configfile: "config/config.yaml"


include: "workflow/rules/common.smk"


# A scheduler of a cluster terminates every process of a run at once. Snakemake's own handler takes a lock that the
# interrupted thread may hold, and then waits for ever; an interrupt ends its jobs in order.
onstart:
    interrupt_when_terminated()


wildcard_constraints:
    scene="[A-Za-z0-9_-]+",
    key="[0-9a-f]{12}",


include: "workflow/rules/stages.smk"
include: "workflow/rules/campaign.smk"


rule all:
    default_target: True
    input:
        lambda wildcards: [
            f"{RESULTS}/{scene}/current/index.json"
            for scene in SCENES
            if FLOW.can_be_planned(scene)
        ],
        # Each artifact is asked for: Snakemake would not make one again that is missing below an index that is there.
        lambda wildcards: [
            manifest
            for scene in SCENES
            if FLOW.can_be_planned(scene)
            for manifest in FLOW.artifacts(scene)
        ],
