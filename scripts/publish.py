"""Point results/<scene>/current at the artifacts of the present configuration."""

import _project  # noqa: F401, I001

import argparse
import json
from pathlib import Path

from nishiki.artifacts.artifact import publish
from nishiki.stages.table import CHAIN


def main() -> None:
    """Publish the links of a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True, help="name of the scene")
    parser.add_argument("--stages", required=True, metavar="JSON", help="stage names and their keys")
    parser.add_argument("--code", default="", help="digest of the code, recorded in the index")
    parser.add_argument("--output", type=Path, required=True, help="results/<scene>/current/index.json")
    arguments = parser.parse_args()
    stages = json.loads(arguments.stages)
    deliverables = {name: CHAIN[name].deliverables for name in stages}
    current = arguments.output.parent
    publish(current, scene=arguments.scene, stages=stages, deliverables=deliverables, code=arguments.code)


if __name__ == "__main__":
    main()
