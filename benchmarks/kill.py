"""Kill -9 at random moments: a run that is killed again and again and resumed has to end in the very
map of an undisturbed one.

    python benchmarks/kill.py --kills 100
    python benchmarks/kill.py --kills 20 --run one-pass     tracked and mapped in one pass
    python benchmarks/kill.py --kills 20 --run windows      at given poses, with --keep-windows

Each process gets `--resume` and dies after a random time of the processor (Linux), until one comes
through; then the next run begins. Prints how often, where it was, and what was found.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from taichi_unifusion.results import RunFolder, inspect

PROGRAM = """
import sys
from taichi_unifusion.results import saver
saver.SHARE = float(sys.argv.pop(1))
from taichi_unifusion.cli.start import main
sys.exit(main())
"""
EAGER = "0.5"  # share of the time for safe points while processes are killed


@dataclass(frozen=True)
class Options:
    """What to kill, and how often."""

    kills: int = 100
    """How many processes are killed."""
    frames: int = 40
    """Frames of the synthetic room that a run has."""
    minutes: float = 60.0
    """It ends after so long, with fewer kills."""
    seed: int = 0
    """Of the moments."""
    run: Literal["given", "windows", "one-pass"] = "given"
    """Frames at given poses, the same with their windows kept, or frames alone in one pass."""


RUNS = {
    "given": [],
    "windows": ["--keep-windows"],
    "one-pass": ["--tracking", "rgbd", "--tracking-passes", "1"],
}


def command(out: Path, options: Options, *more: str, share: str = EAGER) -> list[str]:
    return [
        *(sys.executable, "-c", PROGRAM, share, "reconstruct", "synthetic"),
        *("--option", "width=160", "--option", "height=120", "--end", str(options.frames)),
        *("--device", "cpu", "--threads", "1", "--window", "4", "--surface.voxel-size", "0.1"),
        *("--color.voxel-size", "0.05", "--out", str(out), *RUNS[options.run], *more),
    ]


def run(arguments: list[str], after: float = np.inf) -> tuple[int, str, float]:
    """Exit code and messages of a process, killed after so many seconds of processor time, and how many it
    took: seconds of a clock would depend on what else the machine does.
    """
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=said, text=True)
        spent = 0.0
        while process.poll() is None:
            time.sleep(0.01)
            spent = max(spent, processor_seconds(process.pid))
            if spent > after:
                process.send_signal(signal.SIGKILL)
                process.wait()
        said.seek(0)
        return process.returncode, said.read(), spent


def processor_seconds(pid: int) -> float:
    """Of all threads of a process (Linux); 0 once it has ended."""
    try:
        values = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")


def contents(folder: RunFolder) -> dict[str, bytes]:
    files = [*folder.maps.values(), folder.mesh, folder.trajectory]
    files += [file for file in (folder.tracking, folder.tracked_poses) if file.exists()]
    return {file.name: file.read_bytes() for file in files}


def moment_of(folder: RunFolder, said: str) -> str:
    """Where a process was when it was killed."""
    if folder.record.exists():
        return "writing the results"
    if any(folder.unfinished.glob("generation-*/.*.tmp")) or len(folder.generations) > 1:
        return "making a safe point"
    return "fusing frames" if "compiling kernels" in said else "starting"


def main(options: Options) -> int:
    """Kill and resume until there were so many kills; 1 if any run ended otherwise."""
    place = Path(tempfile.mkdtemp(prefix="unifusion-kill-"))
    chance, wrong, moments, finished, kills = random.Random(options.seed), [], Counter(), 0, 0
    try:
        code, said, took = run(command(place / "whole", options, "--save-every", "0"))
        assert code == 0, said
        expected = contents(RunFolder(place / "whole"))
        folder = RunFolder(place / "killed")
        began = time.monotonic()
        while kills < options.kills and time.monotonic() - began < 60 * options.minutes:
            arguments = command(folder.path, options, "--save-every", "0.05", "--resume")
            code, said, _ = run(arguments, chance.uniform(0.1, 1.1) * took)
            if code == -signal.SIGKILL:
                kills += 1
                moments[moment_of(folder, said)] += 1
                continue
            finished += 1
            left = [*folder.path.rglob("*.tmp"), *folder.path.glob("unfinished"), folder.lock]
            problems = [file for file in left if file.exists()]
            if code or problems or inspect(folder.path).problems or contents(folder) != expected:
                wrong.append((code, problems, re.sub(r"\s+", " ", said)[-400:]))
            shutil.rmtree(folder.path)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    print(f"{kills} kills, {finished} runs came through, {len(wrong)} of them not as undisturbed")
    for moment, count in moments.most_common():
        print(f"  {count:4d} {moment}")
    for each in wrong:
        print(" ", *each)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
