"""Every kernel of the method has a slow twin, and none is left untested."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

MODULES = [
    "encoding",
    "voxels",
    "cells",
    "regression",
    "fusion",
    "visibility",
    "query",
    "marching_cubes",
    "images",
]
# Bookkeeping with no twin but a dict or a sum, in the tests named here.
BOOKKEEPING = {
    "claim_slots": "test_voxels",
    "gather_voxels": "test_voxels",
    "copy_voxels": "test_voxels",
    "copy_rows": "test_voxels",
    "gather_rows": "test_voxels",
    "find_slots": "test_voxels",
    "release_slots": "test_voxels",
    "count_leaves": "test_voxels",
    "count_vertices": "test_meshing",
}
TWINS = {
    name
    for path in (Path(__file__).parents[1] / "support").glob("reference*.py")
    for name in vars(import_module(path.stem))
}


@pytest.mark.parametrize("module", MODULES)
def test_every_kernel_has_a_twin_of_its_name(module):
    loaded = import_module(f"taichi_unifusion.kernels.{module}")
    kernels = {
        name for name, value in vars(loaded).items() if getattr(value, "_is_wrapped_kernel", False)
    }
    assert kernels
    assert {name for name in kernels if name not in TWINS and name not in BOOKKEEPING} == set()
