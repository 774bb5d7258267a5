"""Other people's validators of files, where they are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from places import ROOT

VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)), error => { console.error(error); process.exit(1); });
"""
WARNING = 1  # severity; 0: error, 2: information, 3: hint


def gltf_validator() -> Callable[[Path], list[str]]:
    """Khronos's validator: errors and warnings of a GLB file. A test without it is skipped."""
    node = shutil.which("node")
    places = [str(ROOT / ".venv" / "node_modules"), os.environ.get("NODE_PATH", "")]
    environment = {**os.environ, "NODE_PATH": os.pathsep.join(filter(None, places))}
    found = node and subprocess.run(
        [node, "-e", "require('gltf-validator')"], capture_output=True, check=False, env=environment
    )
    if not node or not found or found.returncode:
        pytest.skip("node does not find gltf-validator: make validator, or NODE_PATH")

    def issues(path: Path) -> list[str]:
        done = subprocess.run(
            [node, "-e", VALIDATE, str(path)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        found = json.loads(done.stdout)["messages"]
        return [each["code"] for each in found if each["severity"] <= WARNING]

    return issues
