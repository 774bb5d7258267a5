"""What people get wrong in Python, each told in one sentence that says what is right."""

from __future__ import annotations

import dataclasses
import inspect
from typing import get_type_hints

import numpy as np
import pytest
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.datasets import Dataset
from taichi_unifusion.errors import InputError, UniFusionError
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.maps.keywords import FeatureKeywords, PropertyKeywords, SurfaceKeywords
from taichi_unifusion.maps.settings import FeatureSettings, PropertySettings, SurfaceSettings

CAMERA = uf.PinholeCamera(16, 12, 15.0, 15.0, 7.5, 5.5)
DEPTH = np.full((12, 16), 1.0, np.float32)
FRAME = uf.Frame(DEPTH, CAMERA, np.zeros((12, 16, 3), np.uint8), np.eye(4))
POINTS = np.zeros((3, 3), np.float32)


@pytest.fixture(scope="module", autouse=True)
def runtime():
    uf.init(DEVICE)


WRONG = {
    "a dict in Config": (
        lambda: uf.Config(surface={"voxel_size": 0.02}),
        "surface: expected SurfaceSettings",
    ),
    "a dict as Config": (lambda: uf.Pipeline({"threads": 1}), "expected Config"),
    "a path as Config": (lambda: uf.Pipeline("config.yaml"), "load_config reads a file"),
    "text as a size": (
        lambda: uf.Config(voxel_size="0.05"),
        "voxel_size: expected a number, got '0.05'",
    ),
    "text as a number": (lambda: uf.Config(window="10"), "window: expected a whole number"),
    "a fraction of frames": (
        lambda: uf.Config(window=2.5),
        "window: expected a whole number, got 2.5",
    ),
    "a list of formats": (
        lambda: uf.Config(mesh=dataclasses.replace(uf.Config().mesh, formats=["ply"])),
        "formats: expected a tuple",
    ),
    "a name for many": (lambda: uf.Config(properties="saliency"), "properties: expected a tuple"),
    "an unknown setting": (
        lambda: uf.Config(voxelsize=0.05),
        "no 'voxelsize' .did you mean 'voxel_size'",
    ),
    "true as a number": (
        lambda: uf.Config(threads=True),
        "threads: expected a whole number, got True",
    ),
    "an unknown detail": (lambda: uf.Config(detail="high"), "detail: 'high' is unknown"),
    "text as a map's size": (
        lambda: uf.SurfaceMap(voxel_size="5 cm"),
        "voxel_size: expected a number",
    ),
    "a size in its place": (
        lambda: uf.SurfaceMap(0.05),
        r"expected SurfaceSettings.*voxel_size=0.05",
    ),
    "an unknown keyword": (
        lambda: uf.SurfaceMap(voxel_siz=0.05),
        "SurfaceMap: there is no 'voxel_siz' .did you mean 'voxel_size'",
    ),
    "another map's keyword": (
        lambda: uf.PropertyMap("x", 1, carve=True),
        "PropertyMap: there is no 'carve'",
    ),
    "another map's settings": (
        lambda: uf.SurfaceMap(PropertySettings()),
        "expected SurfaceSettings",
    ),
    "a size of nothing": (lambda: uf.SurfaceMap(voxel_size=-0.05), "voxel_size: must lie in"),
    "a frame for a cloud": (
        lambda: uf.SurfaceMap().integrate(FRAME),
        "expected a PointCloud, got a Frame",
    ),
    "an array for a cloud": (lambda: uf.SurfaceMap().integrate(POINTS), "expected a PointCloud"),
    "a cloud for a frame": (lambda: uf.Pipeline().step(uf.PointCloud(POINTS)), "expected a Frame"),
    "a cloud to preprocess": (lambda: uf.preprocess(uf.PointCloud(POINTS)), "expected a Frame"),
    "a list for an array": (lambda: uf.PointCloud([[0, 0, 0]]), "must be a NumPy array, got list"),
    "a list for depth": (lambda: uf.Frame([[1.0]], CAMERA), "depth must be a NumPy array"),
    "a matrix for a camera": (lambda: uf.Frame(DEPTH, np.eye(3)), "camera must be a PinholeCamera"),
    "millimetres": (
        lambda: uf.preprocess(uf.Frame(1000 * DEPTH, CAMERA)),
        "must be in metres, but its median is 1000: divide",
    ),
    "whole millimetres": (lambda: uf.Frame(np.uint16(1000 * DEPTH), CAMERA), "float32 in metres"),
    "a cloud without normals": (
        lambda: uf.SurfaceMap().integrate(uf.PointCloud(POINTS)),
        "no normals",
    ),
    "a box of one corner": (
        lambda: uf.SurfaceMap().extract_mesh(bounds=(0, 0, 0)),
        "expected two corners",
    ),
    "a box turned round": (
        lambda: uf.SurfaceMap().extract_mesh(bounds=((1, 1, 1), (0, 0, 0))),
        "first corner must be below",
    ),
}


def empty_mesh() -> uf.Mesh:
    return uf.Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def room() -> Dataset:
    return uf.open_dataset("synthetic", frames=2, width=32, height=24)


# What a caller hands over where something else belongs; PoseError and FrameError tell of frames.
WRONG_VALUES = {
    "one frame to run": (lambda: uf.Pipeline().run(FRAME), r"got one Frame: give \[frame\]"),
    "a path to run": (lambda: uf.Pipeline().run("recording"), "expected a sequence of frames"),
    "a generator to run": (lambda: uf.Pipeline().run(f for f in [FRAME]), "expected a sequence"),
    "arrays to run": (lambda: uf.Pipeline().run([DEPTH, DEPTH]), "expected Frame"),
    "a name for a property": (
        lambda: uf.Pipeline(properties=["saliency"]),
        "expected SurfaceProperty.*Config.properties=",
    ),
    "a name for an encoder": (
        lambda: uf.Pipeline(encoder="clip"),
        "with a name and image_features",
    ),
    "a number for a map": (lambda: uf.Pipeline(maps={"surface": 3}), "maps: 'surface': expected"),
    "a setting of Config": (lambda: uf.Pipeline(voxel_size=0.05), "there is no 'voxel_size'"),
    "a dict for settings": (
        lambda: uf.preprocess(FRAME, {"depth_max": 3}),
        "expected PreprocessSettings",
    ),
    "centimetres": (lambda: uf.Config(voxel_size=5), "must lie in 0.0001..2 metres"),
    "millimetres for voxels": (
        lambda: uf.SurfaceMap(voxel_size=50),
        "must lie in 0.0001..2 metres",
    ),
    "an unknown device": (lambda: uf.Config(device="gpu"), "device: 'gpu' is unknown"),
    "text as threads": (lambda: uf.init(DEVICE, threads="4"), "threads: expected a whole number"),
    "no channels": (lambda: uf.PropertyMap("x"), "missing a required argument: 'channels'"),
    "text as channels": (lambda: uf.PropertyMap("x", "3"), "channels: expected a whole number"),
    "half a channel": (lambda: uf.PropertyMap("x", 1.5), "channels: expected a whole number"),
    "text as points": (lambda: uf.SurfaceMap().sdf("here"), "points: expected an array of numbers"),
    "a mesh as points": (lambda: uf.SurfaceMap().sdf(empty_mesh()), "points: expected an array"),
    "a size as resolution": (
        lambda: uf.SurfaceMap().extract_mesh(0.01),
        "resolution: expected a whole number",
    ),
    "text as blocks": (lambda: uf.SurfaceMap().extract_mesh(blocks="all"), "blocks: expected"),
    "a path to merge": (lambda: uf.SurfaceMap().merge("map"), "merge: expected BaseMap.*load_map"),
    "no path to load": (lambda: uf.load_map(None), "load_map: expected text or a Path"),
    "no path to save": (lambda: uf.SurfaceMap().save(None), "save: expected text or a Path"),
    "no path for a mesh": (lambda: empty_mesh().save(None), "mesh file: expected text or a Path"),
    "a dict to load": (
        lambda: uf.load_config({"window": 1}),
        "load_config: expected text or a Path",
    ),
    "a number for a path": (lambda: uf.open_dataset("7scenes", 3), "expected text or a Path"),
    "text as frames": (
        lambda: uf.open_dataset("synthetic", frames="two"),
        "option 'frames': expected a whole number",
    ),
    "a word for a frame": (lambda: room()["first"], "by a whole number or a slice"),
    "text as a width": (
        lambda: uf.PinholeCamera("16", 12, 15.0, 15.0, 7.5, 5.5),
        "width: expected",
    ),
    "a camera without focus": (
        lambda: uf.PinholeCamera(16, 12, None, 15.0, 7.5, 5.5),
        "fx: expected a number",
    ),
    "distortion": (
        lambda: uf.PinholeCamera(16, 12, 15.0, 15.0, 7.5, 5.5, [0.1]),
        "too many positional arguments",
    ),
    "no depth": (lambda: uf.Frame(None, CAMERA), "depth must be a NumPy array, got NoneType"),
    "a name for a pose": (
        lambda: uf.Frame(DEPTH, CAMERA, T_world_camera="identity"),
        "T_world_camera: expected an array of numbers",
    ),
    "a ragged pose": (
        lambda: uf.Frame(DEPTH, CAMERA, T_world_camera=[[1, 0], [0]]),
        "T_world_camera: expected an array",
    ),
    "images in a list": (lambda: uf.Frame(DEPTH, CAMERA, images=[DEPTH]), "expected a dictionary"),
    "text as an image": (lambda: FRAME.with_image("x", "abc"), "image 'x': expected an array"),
    "text as features": (lambda: FRAME.with_features("f", "x"), "features 'f': expected an array"),
    "an array as attributes": (
        lambda: uf.PointCloud(POINTS, None, POINTS),
        "attributes and features: expected a dictionary",
    ),
    "a frame as a view": (lambda: uf.PointCloud(POINTS, view=FRAME), "view: expected ImageView"),
    "text as a transform": (
        lambda: uf.PointCloud(POINTS).transformed("left"),
        "T_b_a: expected an array",
    ),
    "lists for a mesh": (
        lambda: uf.Mesh([[0, 0, 0]], [[0, 0, 0]]),
        "vertices must be a NumPy array",
    ),
    "faces of fractions": (
        lambda: uf.Mesh(POINTS, np.array([[0, 1, 2.5]])),
        "faces must be whole numbers",
    ),
    "a rotation for a mesh": (lambda: empty_mesh().transformed(np.eye(3)), "expected a 4x4 matrix"),
    "lists for a trajectory": (
        lambda: uf.Trajectory([0.0], [np.eye(4)]),
        "timestamps must be a NumPy array",
    ),
}


@pytest.mark.parametrize("name", WRONG_VALUES)
def test_a_wrong_value_is_one_sentence(name):
    use, told = WRONG_VALUES[name]
    with pytest.raises(UniFusionError, match=told) as raised:
        use()
    assert isinstance(raised.value, ValueError)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_is_one_sentence(name):
    use, told = WRONG[name]
    kind = UniFusionError if name.endswith(("depth", "camera", "whole millimetres")) else InputError
    with pytest.raises(kind, match=told) as raised:
        use()
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


def test_numbers_of_numpy_are_numbers():
    assert uf.SurfaceMap(voxel_size=np.float32(0.25)).voxel_size == 0.25
    assert uf.Config(window=np.int64(3)).window == 3


@pytest.mark.parametrize(
    ("made", "settings", "keywords"),
    [
        (uf.SurfaceMap, SurfaceSettings, SurfaceKeywords),
        (uf.PropertyMap, PropertySettings, PropertyKeywords),
        (FeatureMap, FeatureSettings, FeatureKeywords),
    ],
)
def test_keywords_of_a_map_are_its_settings_for_editors_and_notebooks(made, settings, keywords):
    assert get_type_hints(keywords) == get_type_hints(settings)
    shown = inspect.signature(made).parameters
    assert {field.name for field in dataclasses.fields(settings)} <= set(shown)
    assert shown["voxel_size"].kind is inspect.Parameter.KEYWORD_ONLY


def test_reprs_are_short():
    surface = uf.SurfaceMap(voxel_size=0.05)
    for value in (FRAME, uf.PointCloud(POINTS), surface, uf.Pipeline(), surface.extract_mesh()):
        assert len(repr(value)) < 120 and "array" not in repr(value), repr(value)
    assert (
        "16x12" in repr(FRAME)
        and "5 cm" in repr(surface)
        and "3 points" in repr(uf.PointCloud(POINTS))
    )
