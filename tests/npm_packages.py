"""Where packages of npm are that some tests ask for a second opinion."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest


def npm_folder(*files: str) -> Path | None:
    """The first folder of NODE_PATH that has all these files below it; None where none has."""
    folders = [Path(folder) for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if folder]
    return next((folder for folder in folders if all((folder / file).is_file() for file in files)), None)


def gltf_problems(path: Path) -> list[dict]:
    """Errors and warnings of the validator of Khronos; skips without node or the validator."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed, which runs the validator of glTF")
    script = "const v=require('gltf-validator'),f=require('fs'),p=require('path'),n=process.argv[1];"
    script += "const beside=u=>f.promises.readFile(p.join(p.dirname(n),u)).then(b=>new Uint8Array(b));"
    script += "v.validateBytes(new Uint8Array(f.readFileSync(n)),{externalResourceFunction:beside})"
    script += ".then(r=>console.log(JSON.stringify(r.issues)))"
    done = subprocess.run([node, "-e", script, str(path)], capture_output=True, text=True, check=False)
    if "Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("the npm package gltf-validator is not installed (set NODE_PATH to its folder)")
    issues = json.loads(done.stdout)
    return [each for each in issues["messages"] if each["severity"] < 2]
