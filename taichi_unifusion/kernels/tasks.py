"""How loops are shared out: Taichi cuts a loop on the CPU into chunks of at least 512 iterations, so
that a loop over few large tasks would run on one thread.
"""

import taichi as ti


def worker_stride() -> int:
    """Loop iterations a task: all but the first of them do nothing."""
    return 512 if ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64) else 1


def small_stride() -> int:
    """The same, where there are thousands of tasks: some of them make a chunk."""
    return 16 if ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64) else 1
