"""Taichi kernels: plain functions, no state; a kernel writes only what its signature shows under `#
out:`.

Whoever outside needs Taichi takes it from here, so that it is imported in one way.
"""

from ..runtime import import_taichi

import_taichi()

import taichi as ti  # noqa: E402 - after what it reads from the environment is there

__all__ = ["ti"]
