"""Kernels of pictures; those of the method lie in `taichi_unifusion.kernels`."""
