"""Damage to files, and what becomes of the recordings that they belong to: a clear error or a skipped
frame, no hang, no crash, no gigabytes.
"""

from __future__ import annotations

import resource
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FrameError, UniFusionError

LONGEST = 20  # [s] for one recording of some kilobytes, on a busy machine; a hang takes for ever
MOST_BYTES = 1 << 30  # that a damaged header may ask for
EXTREMES = [0, 1, 0x7F, 0x80, 0xFF]
WORDS = [b"\xff" * 4, b"\x00" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one to four faults: bits, extreme numbers, cuts, pieces that are gone, doubled or
    moved.
    """
    content = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not content:
            break
        # half of them near the start, where headers are
        reach = len(content) if rng.random() < 0.5 else min(len(content), 2000)
        at, kind = int(rng.integers(reach)), rng.integers(7)
        length = int(rng.integers(1, 64))
        if kind == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at] = int(rng.choice(EXTREMES))
        elif kind == 2:
            word = WORDS[int(rng.integers(len(WORDS)))]
            content[at : at + len(word)] = word
        elif kind == 3:
            del content[at:]
        elif kind == 4:
            del content[at : at + length]
        elif kind == 5:
            content[at:at] = content[at : at + length]
        else:
            other = int(rng.integers(len(content)))
            content[at : at + length] = content[other : other + length]
    return bytes(content)


def outcome(format: str, path: Path) -> str:
    """What becomes of a recording: every error that is not ours comes through."""
    try:
        dataset = open_dataset(format, path)
    except UniFusionError as error:
        assert len(str(error)) < 5000
        return "refused"
    read = 0
    for i in range(len(dataset)):
        try:
            frame = dataset[i]
        except FrameError as error:
            assert len(str(error)) < 5000
            continue
        assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all()
        read += 1
    return "all read" if read == len(dataset) and read else "some read" if read else "none read"


def fuzz(
    format: str,
    base: Path,
    files: Sequence[Path],
    count: int,
    seed: int,
    scratch: Path,
    kept: Path,
    become: Callable[[str, Path], str] = outcome,
) -> Counter[str]:
    """What becomes of `count` copies of the recording at `base`, in each of which one of the `files`
    is damaged. One that hangs or crashes is left in the folder `kept`.
    """
    found, rng = Counter(), np.random.default_rng(seed)
    before = signal.signal(signal.SIGALRM, _too_long)
    try:
        for n in range(count):
            damaged = scratch / f"d{n}"
            shutil.copytree(base, damaged) if base.is_dir() else damaged.mkdir()
            file = files[int(rng.integers(len(files)))]
            relative = file.relative_to(base) if base.is_dir() else Path(file.name)
            (damaged / relative).write_bytes(mutated(file.read_bytes(), rng))
            path = damaged if base.is_dir() else damaged / relative
            signal.alarm(LONGEST)
            try:
                with less_memory():
                    found[become(format, path)] += 1
            except BaseException:
                shutil.copytree(damaged, kept, dirs_exist_ok=True)
                raise
            finally:
                signal.alarm(0)
            shutil.rmtree(damaged)
    finally:
        signal.signal(signal.SIGALRM, before)
    return found


@contextmanager
def less_memory() -> Iterator[None]:
    """Whoever asks for MOST_BYTES more than there are gets a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _too_long(number, frame):
    raise AssertionError(f"hangs: more than {LONGEST} s")
