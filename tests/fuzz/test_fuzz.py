"""I1: mutated files end in a UniFusionError or are read; never in a traceback, a crash, a hang or gigabytes.

UNIFUSION_FUZZ says how many mutations a reader gets, `make fuzz` gives 20,000; recordings and meshes
of other programs, which take milliseconds, get a tenth. A mutation is known by its seed.
"""

from __future__ import annotations

import os
import shutil
import time
import warnings
from pathlib import Path

import pytest
from fuzz_targets import TARGETS
from memory import peak_memory
from mutator import mutate

from taichi_unifusion.errors import UniFusionError

COUNT = int(os.environ.get("UNIFUSION_FUZZ", "200"))
LONGEST = 10  # [s] of one file, on a machine that others use too
MOST_MEMORY = 1000  # [MB] of all files of one reader, whatever they ask for


@pytest.mark.parametrize("name", TARGETS)
def test_i1_mutated_files_are_read_or_refused(name, tmp_path):
    target = TARGETS[name]
    made = target.make(tmp_path / target.name)
    root = Path(made) if isinstance(made, (str, Path)) else tmp_path / target.name
    files = sorted(p for p in ([root] if root.is_file() else root.rglob("*")) if p.is_file())
    sound = {file: file.read_bytes() for file in files}
    failures, slowest = [], 0.0
    with peak_memory() as peak, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(COUNT // 10 if target.slow else COUNT):
            file = files[seed % len(files)]
            file.write_bytes(mutate(sound[file], seed))
            start = time.perf_counter()
            try:
                _read(target.read, root)
            except Exception as error:  # noqa: BLE001 - whatever escapes is what is looked for
                failures.append(f"seed {seed}, {file.name}: {type(error).__name__}: {error}"[:300])
            slowest = max(slowest, time.perf_counter() - start)
            file.write_bytes(sound[file])
    assert failures == [], "\n".join([f"{len(failures)} failures", *failures[:12]])
    assert slowest < LONGEST and peak.megabytes < MOST_MEMORY
    shutil.rmtree(tmp_path)


def _read(read, path: Path) -> bool:
    """Whether a file is read; what we say of one that is not is a sentence."""
    try:
        read(path)
    except UniFusionError as error:
        assert str(error) and "Traceback" not in str(error)
        return False
    return True


def test_i1_sound_files_are_read(tmp_path):
    """Else mutations would fuzz nothing."""
    refused = []
    for name, target in TARGETS.items():
        folder = tmp_path / f"of-{name}"
        folder.mkdir()
        made = target.make(folder / target.name)
        root = Path(made) if isinstance(made, (str, Path)) else folder / target.name
        if not _read(target.read, root):
            refused.append(name)
    assert refused == []


def test_mutations_are_the_same_for_a_seed_and_differ_between_seeds():
    data = bytes(range(256)) * 4
    assert [mutate(data, s) for s in range(50)] == [mutate(data, s) for s in range(50)]
    assert len({mutate(data, s) for s in range(200)} - {data}) > 180
    assert mutate(b"", 3) is not None
