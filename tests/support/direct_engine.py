"""An engine without other processes."""

from __future__ import annotations

from collections.abc import Callable


class Direct:
    """Does all work here; asks `spoil` before each piece, which may do what a lost worker does."""

    workers = 2

    def __init__(self, spoil: Callable[[Callable, tuple], None] = lambda work, arguments: None):
        self.spoil = spoil

    def map(self, work, arguments, on_done=lambda: None, stop=lambda: False):
        results = []
        for each in arguments:
            self.spoil(work, each)
            results.append(work(*each))
            on_done()
        return results
