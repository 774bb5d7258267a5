"""Frames rendered from a textured scene: depth, colour and objects against ray casting, a Kinect's
noise, bad files.
"""

from __future__ import annotations

import numpy as np
import pytest
import reference_scene as reference

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.scene import SceneDataset, kinect_camera
from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.errors import DatasetError, InputError, PoseError
from taichi_unifusion.files.glb import write_glb
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.files.trajectories import write_trajectory
from taichi_unifusion.rendering.textured_scene import load_scene, mip_levels
from taichi_unifusion.types import Mesh, PinholeCamera, Trajectory

trimesh = pytest.importorskip("trimesh")
Image = pytest.importorskip("PIL.Image")

DEPTH_TOLERANCE = 2e-7  # relative: depth is float64 until it is stored as float32
COSINE_TOLERANCE = 1e-5  # float32 throughout
COLOR_TOLERANCE = 1.5  # of 255: float32 texture coordinates on steep texels, and rounding
EDGE_BAND = 1e-4  # barycentric: nearer to an edge either triangle may win
CAMERA = PinholeCamera(64, 48, 56.0, 56.0, 31.5, 23.5)
POSE = look_at((0.5, -2.6, 1.1), (0.1, 0.0, 0.1))


def checkers(height: int = 48, width: int = 64, square: int = 8) -> np.ndarray:
    """A checkerboard with a ramp over it, so that every place of it is known by its colour."""
    v, u = np.mgrid[:height, :width]
    board = (u // square + v // square) % 2
    return np.stack([60 + 120 * board, 40 + 3 * u, 40 + 3 * v], axis=-1).astype(np.uint8)


def quad(low, high, square: int = 8) -> trimesh.Trimesh:
    """A textured rectangle at y = 0 that faces -y, texture upright: its first row at the top (z =
    high).
    """
    (x0, z0), (x1, z1) = low, high
    vertices = [(x0, 0, z0), (x1, 0, z0), (x1, 0, z1), (x0, 0, z1)]
    return trimesh.Trimesh(
        vertices,
        [(0, 1, 2), (0, 2, 3)],
        process=False,
        visual=textured([(0, 0), (1, 0), (1, 1), (0, 1)], square),
    )


def textured(uv, square: int = 8):
    """Texture coordinates (v up, as trimesh has them) on the checkerboard."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(checkers(square=square))
    )
    return trimesh.visual.TextureVisuals(uv=np.array(uv, float), material=material)


def box_scene() -> trimesh.Scene:
    """A turned box with the texture repeated on every side, a floor coloured at its corners, and a
    plain grey roof edge on.
    """
    scene = trimesh.Scene()
    box = trimesh.creation.box((0.8, 0.6, 0.9))
    box.unmerge_vertices()
    uv = np.tile([(0, 0), (1.7, 0), (1.7, 1.3)], (12, 1))
    turn = trimesh.transformations.rotation_matrix(0.5, (0.2, 0.1, 1))
    scene.add_geometry(
        trimesh.Trimesh(box.vertices, box.faces, process=False, visual=textured(uv)),
        node_name="box",
        geom_name="box",
        transform=turn,
    )
    floor = trimesh.Trimesh(
        [(-2, -2, -0.6), (2, -2, -0.6), (2, 2, -0.6), (-2, 2, -0.6)],
        [(0, 1, 2), (0, 2, 3)],
        process=False,
        vertex_colors=[(255, 0, 0, 255), (0, 255, 0, 255), (0, 0, 255, 255), (90, 90, 90, 255)],
    )
    scene.add_geometry(floor, node_name="floor", geom_name="floor")
    roof = trimesh.Trimesh(
        [(0.4, -0.4, 0.7), (0.9, 0.4, 0.75), (0.4, 0.5, 0.6)], [(0, 1, 2)], process=False
    )
    scene.add_geometry(roof, node_name="roof", geom_name="roof")
    return scene


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "box.glb"
    box_scene().export(path)
    return path


@pytest.fixture(scope="module")
def scene(path):
    return load_scene(path)


@pytest.fixture(scope="module")
def trajectory():
    return Trajectory(
        np.arange(3) / 30,
        np.stack([look_at((0.5 + 0.1 * i, -2.6, 1.1), (0.1, 0.0, 0.1)) for i in range(3)]),
    )


def test_file_gives_objects_with_their_places_and_looks(scene):
    assert scene.object_names == ("box", "floor", "roof")
    assert np.bincount(scene.face_object).tolist() == [12, 2, 1]
    # one picture, kept once
    assert len(scene.textures) == 1 and scene.textures[0].shape == (48, 64, 3)
    assert set(scene.face_texture[scene.face_object == 0]) == {0} and set(
        scene.face_texture[scene.face_object > 0]
    ) == {-1}
    corner = scene.vertices[scene.faces[scene.face_object == 0]].reshape(-1, 3)
    assert np.linalg.norm(corner, axis=1).max() == pytest.approx(
        np.linalg.norm((0.4, 0.3, 0.45)), abs=1e-6
    )
    assert np.abs(corner[:, 0]).max() > 0.45  # turned


def test_read_surfaces_equals_ray_casting(scene):
    view = scene.render(CAMERA, POSE)
    depth, cosine, objects, margin = reference.read_surfaces(scene, CAMERA, POSE)
    sure = margin > EDGE_BAND
    assert sure.mean() > 0.95 and set(np.unique(objects[sure])) == {-1, 0, 1, 2}
    np.testing.assert_allclose(view.depth[sure], depth[sure], rtol=DEPTH_TOLERANCE)
    np.testing.assert_allclose(view.cosine[sure], cosine[sure], atol=COSINE_TOLERANCE)
    np.testing.assert_array_equal(view.object[sure], objects[sure])
    assert view.depth.tobytes() == scene.render_depth(CAMERA, POSE).tobytes()
    assert view.object.tobytes() == scene.render_objects(CAMERA, POSE).tobytes()


def test_shade_textured_equals_its_twin(scene):
    color, sure = reference.shade_textured(scene, CAMERA, POSE)
    assert sure.mean() > 0.9
    error = np.abs(scene.render(CAMERA, POSE).color - color)[sure]
    assert error.max() < COLOR_TOLERANCE, error.max()


def test_texture_is_upright_and_seen_at_its_own_resolution(tmp_path):
    """One texel a pixel: the picture comes back, under even light."""
    trimesh.Scene([quad((-0.32, -0.24), (0.32, 0.24))]).export(tmp_path / "quad.glb")
    camera = PinholeCamera(64, 48, 100.0, 100.0, 31.5, 23.5)
    view = load_scene(tmp_path / "quad.glb").render(camera, look_at((0, -1, 0), (0, 0, 0)))
    np.testing.assert_allclose(view.depth, 1, rtol=DEPTH_TOLERANCE)
    light = view.color.sum() / checkers().sum()
    assert 0.6 < light < 1
    error = np.abs(view.color - light * checkers()).max(axis=2)
    # pixels on the diagonal are the mean of two places, one in each triangle
    assert (error < COLOR_TOLERANCE).mean() > 0.97


def test_far_and_oblique_textures_are_means_not_noise(tmp_path):
    """From far off a checkerboard is its mean colour, whatever the direction: mip levels and taps
    sum to what is there.
    """
    trimesh.Scene([quad((-4, -3), (4, 3), square=2)]).export(tmp_path / "quad.glb")
    scene = load_scene(tmp_path / "quad.glb")
    camera = PinholeCamera(4, 4, 12.0, 12.0, 1.5, 1.5)
    for eye in ((0, -12, 0), (9, -8, 0), (0, -6, 10)):
        view = scene.render(camera, look_at(eye, (0, 0, 0)))
        red = view.color[1:3, 1:3, 0].astype(float)
        assert red.std() < 0.1 * red.mean()  # a square is red 60 or 180


def test_color_of_a_point_does_not_depend_on_where_from(tmp_path):
    trimesh.Scene([quad((-1, -0.75), (1, 0.75))]).export(tmp_path / "quad.glb")
    scene = load_scene(tmp_path / "quad.glb")
    camera = PinholeCamera(1, 1, 2000.0, 2000.0, 0.0, 0.0)
    rng = np.random.default_rng(2)
    for target in rng.uniform((-0.9, 0, -0.6), (0.9, 0, 0.6), (20, 3)):
        colors = [
            scene.render(camera, look_at(target + offset, target)).color[0, 0].astype(int)
            for offset in ((0.2, -1, 0.1), (-0.4, -0.7, -0.2))
        ]
        # the footprints differ by a fraction of a texel
        assert np.abs(colors[0] - colors[1]).max() <= 8


def test_both_sides_are_drawn(tmp_path):
    trimesh.Scene([quad((-1, -1), (1, 1))]).export(tmp_path / "quad.glb")
    scene = load_scene(tmp_path / "quad.glb")
    for y in (-1.5, 1.5):
        np.testing.assert_allclose(
            scene.render_depth(CAMERA, look_at((0, y, 0), (0, 0, 0)))[20:28, 24:40], 1.5, rtol=1e-6
        )


def test_mip_levels_keep_the_mean():
    levels = mip_levels(checkers(64, 64))
    assert [level.shape[0] for level in levels] == [64, 32, 16, 8, 4, 2, 1]
    for level in levels:
        # rounded at each level
        np.testing.assert_allclose(
            level.mean(axis=(0, 1)), checkers(64, 64).mean(axis=(0, 1)), atol=2
        )
    assert mip_levels(checkers(3, 10))[-1].shape == (1, 1, 3)


# The data set


def test_frames_are_pure_functions_of_index_and_seed(path, trajectory):
    frames = open_dataset("scene", path, trajectory=trajectory, camera=CAMERA)
    again = open_dataset("scene", path, trajectory=trajectory, camera=CAMERA)
    other = open_dataset("scene", path, trajectory=trajectory, camera=CAMERA, seed=1)
    _ = again[0]
    assert frames[2].depth.tobytes() == again[2].depth.tobytes() == again[::2][1].depth.tobytes()
    assert (
        frames[2].color.tobytes() == other[2].color.tobytes()
        and frames[2].depth.tobytes() != other[2].depth.tobytes()
    )
    np.testing.assert_array_equal(frames[1].T_world_camera, trajectory.T_world_camera[1])
    assert (frames[1].index, frames[1].timestamp, len(frames)) == (1, 1 / 30, 3)


def test_noise_is_a_kinects_and_can_be_left_out(path, trajectory):
    quiet = open_dataset(
        "scene", path, trajectory=trajectory, camera=kinect_camera(160, 120), noise=False
    )
    noisy = open_dataset("scene", path, trajectory=trajectory, camera=kinect_camera(160, 120))
    exact, read = quiet[0].depth, noisy[0].depth
    assert exact.tobytes() == quiet.exact_depth(0).tobytes() == noisy.exact_depth(0).tobytes()
    both = (read > 0) & (exact > 0)
    assert both.sum() > 0.7 * (exact > 0).sum() and both.sum() < (exact > 0).sum()
    error = np.abs(read - exact)[both]
    assert 0 < np.median(error) < 0.02 and (read[both] <= 5.5).all()
    np.testing.assert_allclose(read * 1000, np.round(read * 1000), atol=1e-3)


def test_what_lies_behind_nothing_is_read_as_nothing(path):
    """Rays that leave the scene neither give a reading nor hide the projector's light from what is
    beside them.
    """
    away = Trajectory(np.zeros(1), look_at((0, 0, 5), (0, 0.1, 9))[None])
    frames = open_dataset("scene", path, trajectory=away, camera=CAMERA)
    assert not frames[0].depth.any() and not frames.exact_depth(0).any()
    assert (frames.labels(0)[0] == -1).all()
    background = np.unique(frames[0].color.reshape(-1, 3), axis=0)
    assert len(background) == 1


def test_labels_name_classes_and_objects(path, trajectory):
    frames = open_dataset(
        "scene",
        path,
        trajectory=trajectory,
        camera=CAMERA,
        classes={"box": "furniture", "roof": "furniture"},
    )
    classes, objects = frames.labels(0)
    assert frames.class_names == ("floor", "furniture")
    seen = objects >= 0
    assert set(np.unique(objects[seen])) == {0, 1, 2} and not seen.all()
    np.testing.assert_array_equal(classes[seen], np.array([1, 0, 1])[objects[seen]])
    assert (classes[~seen] == -1).all()
    assert len(frames.ground_truth_mesh().faces) == 15


def test_trajectory_may_be_a_file(path, trajectory, tmp_path):
    write_trajectory(tmp_path / "poses.txt", trajectory)
    frames = open_dataset("scene", path, trajectory=tmp_path / "poses.txt", camera=CAMERA)
    assert np.abs(frames.T_world_camera - trajectory.T_world_camera).max() < 1e-6


def test_a_scene_needs_a_trajectory_and_poses_that_are_rigid(path, trajectory):
    with pytest.raises(InputError, match="--camera-path"):
        open_dataset("scene", path)
    with pytest.raises(DatasetError, match="no pose"):
        open_dataset("scene", path, trajectory=Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    with pytest.raises(InputError, match="option 'depth_scale' is unknown"):
        open_dataset("scene", path, trajectory=trajectory, depth_scale=1000.0)
    sheared = trajectory.T_world_camera.copy()
    sheared[1, 0, 1] += 0.3
    frames = SceneDataset(load_scene(path), Trajectory(trajectory.timestamps, sheared), CAMERA)
    assert frames[0].depth.any()
    with pytest.raises(PoseError, match="not a rotation"):
        _ = frames[1]


@pytest.mark.parametrize(
    "content",
    [b"", b"no scene", b"glTF\x02\x00\x00\x00\xff\xff\xff\xff"],
    ids=["empty", "text", "cut off"],
)
def test_a_damaged_file_is_said_to_be_one(content, tmp_path, trajectory):
    bad = tmp_path / "bad.glb"
    bad.write_bytes(content)
    with pytest.raises(DatasetError, match="bad.glb"):
        open_dataset("scene", bad, trajectory=trajectory)


def test_points_without_triangles_are_no_scene(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(DatasetError, match="no triangles"):
        load_scene(tmp_path / "points.ply")


def test_other_file_types_give_the_same_view(scene, tmp_path):
    """PLY keeps vertex colours, OBJ keeps the texture."""
    floor = box_scene().geometry["floor"]
    floor.export(tmp_path / "floor.ply")
    box = quad((-1, -0.75), (1, 0.75))
    box.export(tmp_path / "quad.obj")
    trimesh.Scene([box]).export(tmp_path / "quad.glb")
    pose = look_at((0.2, -2, 0.1), (0, 0, 0))
    np.testing.assert_array_equal(
        load_scene(tmp_path / "quad.obj").render(CAMERA, pose).color,
        load_scene(tmp_path / "quad.glb").render(CAMERA, pose).color,
    )
    np.testing.assert_array_equal(
        load_scene(tmp_path / "floor.ply").colors,
        floor.visual.vertex_colors[:, :3] / np.float32(255),
    )


def test_vertex_colors_of_gltf_are_linear_light(tmp_path):
    floor = box_scene().geometry["floor"]
    trimesh.Scene([floor]).export(tmp_path / "other.glb")
    np.testing.assert_allclose(
        load_scene(tmp_path / "other.glb").colors[3], trimesh.visual.color.linear_to_srgb(90 / 255)
    )


def test_our_own_glb_is_a_scene_in_the_world_of_its_map(tmp_path):
    floor = box_scene().geometry["floor"]
    colors = (floor.visual.vertex_colors[:, :3] / 255).astype(np.float32)
    mesh = Mesh(
        floor.vertices.astype(np.float32), floor.faces.astype(np.int32), None, {"color": colors}
    )
    up = np.eye(4)
    up[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    write_mesh(tmp_path / "colored.glb", mesh, T_up_world=up)
    scene = load_scene(tmp_path / "colored.glb")
    assert np.array_equal(scene.vertices, mesh.vertices)
    np.testing.assert_allclose(scene.colors, colors, atol=1e-6)
    assert scene.render(CAMERA, look_at((0.2, -2, 1), (0, 0, -0.6))).color.std() > 10
    texture = Texture(np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32), checkers())
    with open(tmp_path / "textured.glb", "wb") as file:
        write_glb(file, mesh, texture, T_up_world=up, image="png")
    scene = load_scene(tmp_path / "textured.glb")
    assert np.array_equal(scene.vertices, mesh.vertices)
    assert np.array_equal(scene.textures[0], checkers())
    np.testing.assert_allclose(scene.corners[0], texture.coordinates[[0, 1, 2]].ravel(), atol=1e-6)
