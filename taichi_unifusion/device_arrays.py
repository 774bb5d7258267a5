"""Arrays on the device: how they are made, and those that are used again and again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .errors import RuntimeStateError

# A ti.Ndarray, or a NumPy array where a kernel is given one: Taichi has no types for a checker.
DeviceArray = Any


def grown(room: int, needed: int) -> int:
    """Room for `needed` rows where there is `room`: it doubles, so that growing stays cheap."""
    return room if needed <= room else max(2 * room, needed)


class Arena:
    """Device arrays that are used again and again, so that a frame allocates nothing.

    What is borrowed is on loan for one turn: it may be overwritten as soon as the next turn begins.
    New arrays are zero; old ones are as their last user left them.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple, Any] = {}
        self._asked: dict[tuple, int] = {}  # rows that somebody wanted last, of those that may grow
        self._turn = 0

    def borrow(self, name: str, dtype: Any, shape: tuple[int, ...]) -> DeviceArray:
        """A device array of at least `shape[0]` rows of shape `shape[1:]`, for the use `name`."""
        import taichi as ti

        key = (name, str(dtype), shape[1:])
        known = self._arrays.get(key)
        if known is None or known.shape[0] < shape[0]:
            rows = grown(known.shape[0] if known is not None else shape[0], shape[0])
            self._arrays[key] = ti.ndarray(dtype, (rows, *shape[1:]))
        self._asked[key] = shape[0]
        return self._arrays[key]

    def grow_ahead(self) -> None:
        """Make more room where two thirds of it were asked for, while nothing is on loan: whoever asks
        for more then does not wait for it.
        """
        import taichi as ti

        for key, asked in self._asked.items():
            array = self._arrays[key]
            if 3 * asked > 2 * array.shape[0]:
                self._arrays[key] = ti.ndarray(array.dtype, (2 * array.shape[0], *array.shape[1:]))

    def exact(self, name: str, make: Callable[[], Any], shape: tuple[int, ...]) -> Any:
        """What `make` makes, once for every use `name` and shape."""
        key = (name, shape)
        if key not in self._arrays:
            self._arrays[key] = make()
        return self._arrays[key]

    def next_turn(self) -> Loan:
        """Begin a turn: all loans of earlier turns are over."""
        self._turn += 1
        return Loan(self, self._turn)

    def is_over(self, turn: int) -> bool:
        """Whether what was borrowed in `turn` may have been overwritten."""
        return turn != self._turn


@dataclass(frozen=True)
class Loan:
    """What was borrowed in one turn of an arena."""

    arena: Arena
    turn: int

    def check(self) -> None:
        """Raise RuntimeStateError where it is over."""
        if self.arena.is_over(self.turn):
            raise RuntimeStateError(
                "this local LIM is no longer there: another cloud was encoded since; fuse it "
                "before that, or keep local.copy()"
            )
