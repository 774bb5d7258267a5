"""Taichi kernels: plain functions, no state; a kernel writes only what its signature shows under `#
out:`.
"""

from ..runtime import import_taichi

import_taichi()
