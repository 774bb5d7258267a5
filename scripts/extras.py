"""Install every extra by itself into an environment of its own (K3), and import what it is for.

python scripts/extras.py                 all of them; gigabytes are fetched, and half an hour
python scripts/extras.py clip viewer     some
python scripts/extras.py clip --index https://download.pytorch.org/whl/cpu     with torch from there

Prints a row an extra: what it takes on disk beyond the bare package, and whether it works.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMPORTS = {  # extra -> what it is for, as the package imports it
    "open3d": ["open3d"],
    "k4a": ["av"],
    "phone": ["av", "OpenEXR", "lz4.block", "h5py"],
    "lzfse": ["liblzfse"],
    "ros": ["rosbags.highlevel", "lz4.frame", "backports.zstd"],
    "realsense": ["pyrealsense2"],
    "video": ["av"],
    "clip": ["torch", "transformers"],
    "viewer": ["viser", "fast_simplification"],
    "models": ["onnxruntime"],
    "texture": ["xatlas", "fast_simplification"],
    "usd": ["pxr.Usd"],
    "cluster": ["dask", "distributed", "dask_jobqueue"],
    "las": ["laspy", "lazrs"],
    "test": ["pytest", "xdist", "safetensors", "evo", "onnx", "selenium"],
    "dev": ["ruff", "pytest"],
}


def megabytes(folder: Path) -> int:
    """Size on disk of a folder [MB]."""
    told = subprocess.run(["du", "-sm", folder], capture_output=True, text=True, check=True)
    return int(told.stdout.split()[0])


def install(extra: str, index: str) -> tuple[int, float, str]:
    """Megabytes of an environment with the extra, seconds, and what went wrong, if anything."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        python = Path(folder) / "bin" / "python"
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        first = [[*pip, "torch", "--index-url", index]] if index and extra == "clip" else []
        names = ", ".join(["taichi_unifusion.cli.main", *IMPORTS.get(extra, [])])
        for command in [
            *first,
            [*pip, f"{ROOT}[{extra}]" if extra else str(ROOT)],
            [python, "-m", "pip", "check"],
            [python, "-c", f"import {names}"],
        ]:
            done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
            if done.returncode:
                said = (done.stderr.strip() or done.stdout.strip()).splitlines()
                return megabytes(Path(folder)), time.perf_counter() - start, said[-1][:200]
        return megabytes(Path(folder)), time.perf_counter() - start, ""


def main() -> int:
    """Install and print; exit code 1 where something went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    parser.add_argument("extras", nargs="*", default=list(extras), choices=[[], *extras])
    parser.add_argument("--index", default="", help="package index that torch comes from")
    options = parser.parse_args()
    bare, _, trouble = install("", "")
    print(f"| (none) | {bare} MB | {trouble or 'works'} |", flush=True)
    wrong = bool(trouble)
    for extra in options.extras or extras:
        size, seconds, trouble = install(extra, options.index)
        print(
            f"| {extra} | + {size - bare} MB | {trouble or 'works'} | {seconds:.0f} s", flush=True
        )
        wrong |= bool(trouble)
    return int(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
