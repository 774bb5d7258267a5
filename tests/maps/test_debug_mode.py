"""Kernels under Taichi's debug mode, which checks bounds and overflow (N6, C19)."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

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

EVERYTHING_ELSE = """
import numpy as np, taichi_unifusion as uf
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings
from taichi_unifusion.rendering.preview import choose_views, draw_views
from taichi_unifusion.tracking import make_tracker
uf.init("cpu", debug=True)
config = uf.Config(
    device="cpu", window=2, surface=SurfaceSettings(voxel_size=0.1), color=PropertySettings(voxel_size=0.05)
)
room = list(uf.open_dataset("synthetic", frames=60, width=80, height=60)[:4])
pipeline = uf.Pipeline(config)
pipeline.run(room)
mesh = pipeline.extract_mesh(resolution=2)
far = [[500, -500, 3], [np.nan, 0, 1], [1e30, 0, 0]]
points = np.concatenate([mesh.vertices[:500], far]).astype(np.float32)
pipeline.surface.sdf(points)
pipeline.maps["color"].query(points)
tracker = make_tracker("rgbd")
verdicts = {tracker.track(frame).verdict for frame in room}
draw_views(mesh, choose_views(mesh, up=np.array([0.0, 0.0, 1.0]), size=(80, 60)))
one = uf.SurfaceMap(voxel_size=0.1)
cloud = uf.preprocess(room[0]).transformed(room[0].T_world_camera)
one.integrate(cloud)
one.remove(cloud)
border = np.eye(4)
for reach in (818.0, -818.0, 2000.0):  # the index ends at 819.2 m
    border[0, 3] = reach
    try:
        one.integrate(cloud.transformed(border))
    except uf.UniFusionError as error:
        print("refused", reach)
print(len(mesh.faces) > 1000, verdicts == {"tracked"}, len(one) > 0)
"""


def test_c19_N6_a_map_of_features_is_quiet_under_debug():
    """N6 as well: no index is out of bounds, and wanted wrap-around is no overflow."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "True" and int(done.stdout.split()[-2]) > 10
    assert "overflow" not in (done.stdout + done.stderr).lower()


@pytest.mark.skipif(
    "UNIFUSION_DEBUG_KERNELS" not in os.environ,
    reason="compiles every kernel anew for half a minute: make debug",
)
def test_N6_surface_colour_tracking_and_pictures_are_quiet_under_debug():
    done = subprocess.run(
        [sys.executable, "-c", EVERYTHING_ELSE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-3:] == ["True", "True", "True"] and "refused 2000.0" in done.stdout
    assert "overflow" not in (done.stdout + done.stderr).lower()
