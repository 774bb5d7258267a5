"""Runs that end as by kill -9, in the process of the test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


class Killed(BaseException):
    """Ends a run as kill -9 does: nobody catches it."""


@contextmanager
def killed_at(patch: pytest.MonkeyPatch, owner: object, name: str, call: int) -> Iterator[None]:
    """What runs here dies when a function of `owner` is called for the so manieth time."""
    real, calls = getattr(owner, name), []

    def dying(*arguments, **options):
        calls.append(1)
        if len(calls) == call:
            raise Killed
        return real(*arguments, **options)

    with patch.context() as here:
        here.setattr(owner, name, dying)
        with pytest.raises(Killed):
            yield
