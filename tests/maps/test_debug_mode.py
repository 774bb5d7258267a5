"""Kernels under Taichi's debug mode, which checks bounds and overflow (N6, C19)."""

from __future__ import annotations

import subprocess
import sys

CODE = """
import numpy as np, taichi_unifusion as uf
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.types import ImageView, PinholeCamera
uf.init("cpu", debug=True)
rng = np.random.default_rng(0)
camera = PinholeCamera(12, 9, 10.0, 10.0, 5.5, 4.0)
view = ImageView(rng.normal(size=(9, 12, 16)).astype(np.float32), camera, np.eye(4))
points = rng.uniform(-0.3, 0.3, (2000, 3)).astype(np.float32) + np.float32([0, 0, 1])
features = FeatureMap("clip", 16)
for _ in range(2):
    features.integrate(uf.PointCloud(points, None, {}, features={"clip": view}))
print(len(features), np.isfinite(features.query(points)).all())
"""


def test_c19_N6_a_map_of_features_is_quiet_under_debug():
    """N6 as well: no index is out of bounds, and wanted wrap-around is no overflow."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "True" and int(done.stdout.split()[-2]) > 10
    assert "overflow" not in (done.stdout + done.stderr).lower()
