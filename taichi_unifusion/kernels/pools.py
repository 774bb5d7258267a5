"""Rows of pools and of other arrays, copied: all dimensions after the first are a row."""

import taichi as ti

from .arrays import Ints1


@ti.func
def copy_row(source: ti.template(), i: ti.i32, target: ti.template(), n: ti.i32):
    """Row i of `source` -> row n of `target`, of one to three dimensions."""
    if ti.static(len(source.shape) == 1):
        target[n] = source[i]
    elif ti.static(len(source.shape) == 2):
        for q in range(source.shape[1]):
            target[n, q] = source[i, q]
    else:
        for a in range(source.shape[1]):
            for c in range(source.shape[2]):
                target[n, a, c] = source[i, a, c]


@ti.kernel
def copy_rows(
    # in:
    count: ti.i32,
    rows: ti.types.ndarray(),  # (S, ...)
    # out:
    copies: ti.types.ndarray(),  # (S or more, ...) the first `count` rows
):
    for s in range(count):
        copy_row(rows, s, copies, s)


@ti.kernel
def gather_rows(
    # in:
    places: Ints1,  # (N,) rows to take
    rows: ti.types.ndarray(),  # (S, ...)
    # out:
    gathered: ti.types.ndarray(),  # (N, ...)
):
    for n in range(places.shape[0]):
        copy_row(rows, places[n], gathered, n)


@ti.kernel
def scatter_rows(
    # in:
    places: Ints1,  # (N,) rows to fill, each once
    rows: ti.types.ndarray(),  # (N, ...)
    # out:
    target: ti.types.ndarray(),  # (S, ...)
):
    for n in range(places.shape[0]):
        copy_row(rows, n, target, places[n])
