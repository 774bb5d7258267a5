"""The folder of a run: what is written into it, and what is read back. Names load when they are
used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .inspection import inspect
    from .reader import Run, read_run
    from .record import RunRecord, read_record
    from .run_folder import RunFolder
    from .writer import Results, write_results

__all__ = [
    "Results",
    "Run",
    "RunFolder",
    "RunRecord",
    "inspect",
    "read_record",
    "read_run",
    "write_results",
]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "inspection": ["inspect"],
        "reader": ["Run", "read_run"],
        "record": ["RunRecord", "read_record"],
        "run_folder": ["RunFolder"],
        "writer": ["Results", "write_results"],
    },
)
