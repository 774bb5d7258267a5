"""Places of tiles: a tile is a cube of 64 voxels an edge, and its place a triple or one number."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import compress, product

import numpy as np
from numpy.typing import NDArray

from ..files.tiles import Tile

TILE = 64  # voxels along an edge of a tile
CODE_BITS, CODE_OFFSET = 12, 1 << 11  # a tile's place as one number; 16,384 voxels are 256 tiles


def key_codes(keys: NDArray[np.int32]) -> NDArray[np.int64]:
    """The tile (N,) of every voxel (N, 3), as a number."""
    tiles = (keys // TILE).astype(np.int64) + CODE_OFFSET
    return tiles[:, 0] << 2 * CODE_BITS | tiles[:, 1] << CODE_BITS | tiles[:, 2]


def place_codes(voxels: NDArray) -> NDArray[np.int64]:
    """The tile (N,) of places (N, 3) in voxels, any tile for those that are not numbers."""
    most = (CODE_OFFSET - 1) * TILE
    return key_codes(np.floor(np.clip(np.nan_to_num(voxels), -most, most)).astype(np.int32))


def codes_between(low: NDArray[np.int64], high: NDArray[np.int64]) -> Iterator[int]:
    """The tiles (N,) of the low and high corners of boxes that are smaller than a tile, and those
    between; some come more than once.
    """
    # no axis is more than one tile farther: three bits; few boxes differ
    axes = (2 * CODE_BITS, CODE_BITS, 0)
    bits = sum((high - low >> shift & 1) << n for n, shift in enumerate(axes))
    for box in np.unique(low << 3 | bits).tolist():
        farther = [1 << shift for n, shift in enumerate(axes) if box >> n & 1]
        for chosen in product((0, 1), repeat=len(farther)):
            yield (box >> 3) + sum(compress(farther, chosen))


def code_of(tile: Tile) -> int:
    """The number of a tile."""
    i, j, k = (each + CODE_OFFSET for each in tile)
    return i << 2 * CODE_BITS | j << CODE_BITS | k


def tile_of(code: int) -> Tile:
    """The place of a tile."""
    last = (1 << CODE_BITS) - 1
    i, j, k = (int(code) >> shift & last for shift in (2 * CODE_BITS, CODE_BITS, 0))
    return i - CODE_OFFSET, j - CODE_OFFSET, k - CODE_OFFSET


def tiles_around(codes: Iterable[int]) -> Iterator[int]:
    """Codes of tiles and of the 26 beside each; some come more than once."""
    for code in codes:
        i, j, k = tile_of(code)
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                for dk in (-1, 0, 1):
                    yield code_of((i + di, j + dj, k + dk))


def rows_by_tile(codes: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Every tile among the codes (N,), and the rows that have it."""
    order = np.argsort(codes, kind="stable")
    found, first = np.unique(codes[order], return_index=True)
    for n, code in enumerate(found.tolist()):
        yield code, order[first[n] : first[n + 1] if n + 1 < len(first) else None]
