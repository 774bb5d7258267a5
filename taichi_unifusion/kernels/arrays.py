"""Types of the arrays that kernels take, and how a row of one is read."""

import taichi as ti

from .layout import LANES

Lanes = ti.types.vector(LANES, ti.f32)
Floats1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
Floats2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
Floats3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
Lanes3 = ti.types.ndarray(dtype=Lanes, ndim=3)
Ints1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
Ints2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
Sums3 = ti.types.ndarray(dtype=ti.i64, ndim=3)
Longs2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
Doubles2 = ti.types.ndarray(dtype=ti.f64, ndim=2)
Shorts2 = ti.types.ndarray(dtype=ti.u16, ndim=2)
Shorts3 = ti.types.ndarray(dtype=ti.u16, ndim=3)
Masks2 = ti.types.ndarray(dtype=ti.u32, ndim=2)
Votes2 = ti.types.ndarray(dtype=ti.i8, ndim=2)
Bytes1 = ti.types.ndarray(dtype=ti.u8, ndim=1)
Bytes2 = ti.types.ndarray(dtype=ti.u8, ndim=2)
Bytes3 = ti.types.ndarray(dtype=ti.u8, ndim=3)
Rows2 = ti.types.ndarray(ndim=2)  # of any type


@ti.func
def row3(array: ti.template(), i: ti.i32):
    """Row i of an (N, 3) array as a vector."""
    return ti.Vector([array[i, 0], array[i, 1], array[i, 2]])
