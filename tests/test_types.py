"""Values that travel through the pipeline: what they compute of themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from meshes import scattered

from taichi_unifusion import Frame, PinholeCamera, PointCloud
from taichi_unifusion.errors import InputError, PoseError
from taichi_unifusion.types import ImageView, Trajectory

CAMERA = PinholeCamera(65, 48, 60.0, 61.0, 31.7, 24.2)


def test_rays_are_what_project_undoes():
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.rays()
    assert rays.shape == (48, 65, 3) and (rays[..., 2] == 1).all()
    np.testing.assert_allclose(CAMERA.project(2.5 * rays), np.stack([u, v], -1), atol=1e-12)
    np.testing.assert_array_equal(CAMERA.rays(u[3], v[3]), rays[3])
    homogeneous = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA.matrix).T
    np.testing.assert_allclose(rays, homogeneous, atol=1e-12)


def test_what_is_not_in_front_of_the_camera_has_no_pixel():
    assert np.isnan(CAMERA.project(np.array([[0, 0, -1.0], [0.1, 0, 0]]))).all()


def test_look_up_reads_the_pixel_that_a_point_falls_in():
    image = np.arange(48 * 65).reshape(48, 65)
    v, u = np.array([0, 47, 20, 20, 20]), np.array([0, 64, 10, 65, 10])
    points = CAMERA.rays(u + 0.4, v - 0.4) * np.array([1, 2, 0.05, 1, -1])[:, None]
    values, inside = CAMERA.look_up(image, points, nearest=0.1)
    assert inside.tolist() == [True, True, False, False, False]  # too near, beside, behind
    assert values.tolist() == [image[0, 0], image[47, 64]]


def test_shrunk_cuts_off_what_fills_no_block():
    whole = PinholeCamera(64, 48, 60.0, 61.0, 31.7, 24.2)
    assert CAMERA.shrunk(2).size == (32, 24)
    np.testing.assert_allclose(CAMERA.shrunk(2).intrinsics, whole.resized(32, 24).intrinsics)
    # the middle of the first block of 2 x 2 pixels
    np.testing.assert_allclose(
        CAMERA.shrunk(2).rays()[0, 0], CAMERA.rays(np.array(0.5), np.array(0.5))
    )


def test_a_cloud_takes_what_belongs_to_its_points():
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    view = ImageView(np.ones((48, 65), np.float32), CAMERA)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    cloud = PointCloud(points, normals, {"heat": points[:, :1]}, view, {"clip": view})
    for rows in (np.array([3, 1]), np.array([False, True, False, True])):
        taken, wanted = cloud.take(rows), points[rows]
        np.testing.assert_array_equal(taken.points, wanted)
        np.testing.assert_array_equal(taken.normals, normals[rows])
        np.testing.assert_array_equal(taken.attributes["heat"], wanted[:, :1])
        assert taken.view is view and taken.features["clip"] is view
    assert len(replace(cloud, normals=None).take(np.array([0]))) == 1


def test_a_view_must_be_a_depth_image():
    points, features = np.zeros((1, 3), np.float32), np.ones((48, 65, 2), np.float32)
    with pytest.raises(InputError, match="depth image"):
        PointCloud(points, view=ImageView(features, CAMERA))


def test_frames_are_called_by_name_or_number():
    depth = np.ones((48, 65), np.float32)
    assert Frame(depth, CAMERA, index=7).label == "frame 7"
    assert Frame(depth, CAMERA, name="depth/7.png").label == "depth/7.png"


def test_a_frame_without_a_pose_says_which_it_is():
    depth = np.ones((48, 65), np.float32)
    with pytest.raises(PoseError, match="depth/7.png: there is no pose"):
        Frame(depth, CAMERA, name="depth/7.png").require_pose()
    assert Frame(depth, CAMERA, T_world_camera=np.eye(4)).require_pose().shape == (4, 4)


def test_numbers_stand_in_for_time_stamps_that_are_missing():
    poses = [np.eye(4), np.eye(4)]
    assert Trajectory.of([0.5, 0.75], [3, 4], poses).timestamps.tolist() == [0.5, 0.75]
    assert Trajectory.of([0.5, None], [3, 4], poses).timestamps.tolist() == [3, 4]
    assert len(Trajectory.of([], [], [])) == 0


def test_a_part_of_a_mesh_has_its_faces_and_the_vertices_of_these():
    mesh = scattered(color=3)
    kept = np.arange(len(mesh.faces)) % 3 == 0
    part, rows = mesh.part(kept)
    assert len(rows) == 3 * kept.sum() and (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(part.vertices[part.faces], mesh.vertices[mesh.faces[kept]])
    for mine, whole in (
        (part.normals, mesh.normals),
        (part.attributes["color"], mesh.attributes["color"]),
    ):
        np.testing.assert_array_equal(mine, whole[rows])
    nothing, _ = mesh.part(np.zeros(len(mesh.faces), bool))
    assert nothing.vertices.shape == nothing.faces.shape == (0, 3)


def test_c17_normals_of_another_length_are_refused():
    points, up = np.zeros((3, 3), np.float32), np.float32([[0, 0, 1]] * 3)
    assert PointCloud(points, up).normals is not None
    assert PointCloud(points, np.float32(up.astype(np.float16) * 1.001)).normals is not None
    for factor in (5, 0.5, 0):
        normals = up.copy()
        normals[1] *= factor
        with pytest.raises(InputError, match=f"unit length, that of point 1 has {factor}"):
            PointCloud(points, normals)
    up[2] = np.nan  # a point without a normal: it is left out when it is fused
    assert len(PointCloud(points, up)) == 3


@pytest.mark.parametrize(("cx", "cy"), [(0, 0), (640, 480), (0, 480)])
def test_images_of_another_size_have_a_camera_wherever_the_principal_point_is(cx, cy):
    """At the border of the image it moves up to a pixel outside of a smaller or larger one."""
    camera = PinholeCamera(640, 480, 500.0, 510.0, cx, cy)
    corner = np.array([0.1, -0.2, 1.0])
    for other in (camera.resized(80, 60), camera.resized(5120, 3840), camera.shrunk(7)):
        scale = other.fx / camera.fx
        expected = scale * (camera.project(corner) + 0.5) - 0.5
        np.testing.assert_allclose(other.project(corner), expected, rtol=1e-9)
    assert camera.resized(640, 480) == camera and hash(camera.resized(640, 480)) == hash(camera)
    with pytest.raises(InputError, match="cannot become 0x0"):
        camera.shrunk(1000)
