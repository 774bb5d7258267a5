"""Kernels of pictures; those of the method lie in `taichi_unifusion.kernels`."""

from ...runtime import import_taichi

import_taichi()
