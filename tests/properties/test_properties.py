"""Properties of a frame (f_im): each as it should be, by name and as a function of one's own."""

from __future__ import annotations

import dataclasses
from itertools import product

import cv2
import numpy as np
import pytest
from dataset_writers import make_samples, write_folder, write_image, write_scannet

from taichi_unifusion import Frame, PinholeCamera
from taichi_unifusion.config import Config
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FrameError, InputError
from taichi_unifusion.maps.settings import PropertySettings
from taichi_unifusion.properties import PROPERTIES, Look, SurfaceProperty, make_property
from taichi_unifusion.rendering.legend import HEIGHT, draw_legend, property_mesh
from taichi_unifusion.rendering.look import COLORMAPS, color_table, colorize, shown_range
from taichi_unifusion.types import Mesh

CAMERA = PinholeCamera(120, 90, 100.0, 100.0, 59.5, 44.5)
ROUNDED = 1e-5  # float32
FLAT = 1e-3  # [1 - cosine] and [1/m] of normals of an exact plane
CURVED = 0.1  # relative, of a ball's curvature from normals that are fitted to windows
# relative spread of the steps of lightness along a colour map that calls itself uniform
EVEN = 0.35
SETTINGS = PropertySettings(voxel_size=0.1)


def frame_of(color=None, depth=None, **more) -> Frame:
    depth = np.full((90, 120), 2.0, np.float32) if depth is None else depth
    return Frame(depth, CAMERA, color, np.eye(4), name="shot-000017.depth.png", **more)


def infrared_frame(units) -> Frame:
    return frame_of().with_image("infrared", np.broadcast_to(np.float32(units), (90, 120)))


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    """A soft texture."""
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(90, 120, 3)), None, 2)
    return np.uint8(125 + 35 * np.clip(grain / grain.std(), -1, 1))


# ---- Infrared ----


def test_infrared_is_a_rising_curve_that_can_be_undone():
    units = np.linspace(0, 65535, 90 * 120).reshape(90, 120)
    values = make_property("infrared").image(infrared_frame(units))[..., 0]
    assert (
        values.min() == 0
        and abs(values.max() - 1) < ROUNDED
        and (np.diff(values.ravel()) > 0).all()
    )
    np.testing.assert_allclose(
        100 * ((1 + 655.35) ** values.astype(float) - 1), units, rtol=1e-4, atol=1e-2
    )


def test_infrared_does_not_depend_on_the_rest_of_the_picture():
    """A bright thing that comes into view changes no other pixel: frames agree, and maps can be
    merged.
    """
    units = np.full((90, 120), 500.0)
    before = make_property("infrared").image(infrared_frame(units))
    units[:20, :20] = 65535
    after = make_property("infrared").image(infrared_frame(units))
    np.testing.assert_array_equal(before[20:], after[20:])
    assert before[0, 0, 0] < after[0, 0, 0]


def test_infrared_between_limits_is_linear_and_clipped():
    units = np.linspace(0, 4000, 90 * 120).reshape(90, 120)
    values = make_property("infrared=linear,low=1000,high=3000").image(infrared_frame(units))[
        ..., 0
    ]
    np.testing.assert_allclose(values, np.clip((units - 1000) / 2000, 0, 1), atol=ROUNDED)


def test_a_frame_without_infrared_is_said():
    with pytest.raises(
        FrameError,
        match="property 'infrared', shot-000017.depth.png: the recording has no infrared",
    ):
        make_property("infrared").image(frame_of())


@pytest.mark.parametrize("bits", [8, 16])
def test_infrared_beside_a_recording_is_read(tmp_path, bits):
    """folder and scannet: 8 and 16 bits on one scale, resampled to depth, and a frame may lack it."""
    full = 2**bits - 1
    units = (
        np.array([[0, full // 2, full]], np.uint8 if bits == 8 else np.uint16)
        .repeat(12, axis=0)
        .repeat(6, axis=1)[:, :16]
    )
    for write, name, at in (
        (write_folder, "folder", "infrared/{:06d}.png"),
        (write_scannet, "scannet", "infrared/{}.png"),
    ):
        folder = write(tmp_path / name, make_samples(2))
        write_image(
            folder / at.format(1), cv2.resize(units, (32, 24), interpolation=cv2.INTER_NEAREST)
        )
        first, second = open_dataset(name, folder)
        assert "infrared" not in first.images and second.images["infrared"].shape == (12, 16, 1)
        read = second.images["infrared"]
        assert (
            read.min() == 0
            and read.max() == 65535
            and np.isclose(np.median(read), 65535 * (full // 2) / full)
        )


def test_infrared_that_is_no_grey_picture_costs_its_frame(tmp_path):
    folder = write_folder(tmp_path / "folder", make_samples(1))
    write_image(folder / "infrared" / "000000.png", np.zeros((12, 16, 3), np.uint8))
    with pytest.raises(
        FrameError, match="infrared must be one channel of 8 or 16 bits, got 3 of uint8"
    ):
        open_dataset("folder", folder)[0]


# ---- Saliency and style without weights ----


@pytest.mark.parametrize(
    "color", [(250, 40, 30), (125, 125, 240)], ids=["bright", "of equal lightness"]
)
def test_saliency_finds_the_odd_thing_out(noise, color):
    noise = noise.copy()
    noise[36:48, 70:85] = color
    values = make_property("saliency").image(frame_of(noise))[..., 0]
    assert values.shape == (90, 120) and values.min() >= 0 and values.max() == 1
    inside, outside = values[36:48, 70:85].mean(), np.delete(values, np.s_[20:60], axis=0).mean()
    assert inside > 3 * outside
    v, u = np.unravel_index(values.argmax(), values.shape)
    assert 33 <= v < 51 and 67 <= u < 88


def test_saliency_of_nothing_is_a_number():
    values = make_property("saliency").image(frame_of(np.full((90, 120, 3), 77, np.uint8)))
    assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1


@pytest.mark.parametrize(
    "text", ["style", "style=opencv", "style=sketch", "style=sketch,color=true"]
)
def test_style_is_a_picture_and_leaves_a_flat_one_flat(noise, text):
    made = make_property(text)
    values = made.image(frame_of(noise))
    assert (
        values.shape == (90, 120, 3)
        and values.min() >= 0
        and values.max() <= 1
        and values.std() > 0.005
    )
    flat = made.image(frame_of(np.full((90, 120, 3), 128, np.uint8)))
    assert np.ptp(flat.reshape(-1, 3), axis=0).max() <= 2.01 / 255, "no pattern of its own"


@pytest.mark.parametrize("color", [(200, 30, 30), (255, 255, 255), (10, 10, 90)])
def test_painting_keeps_a_colour_flat_or_not(noise, color):
    """Red stays red although OpenCV has blue first, and a flat area, such as a window that is too
    bright, is not black.
    """
    half = noise.copy()
    half[:, 60:] = color
    for picture, method in product(
        (half, np.broadcast_to(np.uint8(color), noise.shape)), ("painting", "opencv")
    ):
        values = make_property(f"style={method}").image(frame_of(picture))
        assert np.abs(values[10:-10, 75:-5] - np.float32(color) / 255).max() < 5 / 255


@pytest.mark.parametrize("text", ["saliency", "style", "style=sketch"])
def test_what_is_made_from_colour_says_where_there_is_none(text):
    with pytest.raises(FrameError, match="there is no colour image to make it from"):
        make_property(text).image(frame_of())


# ---- Properties of depth ----


def rays() -> np.ndarray:
    v, u = np.indices((90, 120))
    return np.dstack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((90, 120))])


def test_normals_are_in_the_world_and_planes_do_not_bend():
    # in the camera frame, towards the camera
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    depth = np.float32(2 * normal[2] / (rays() @ normal))
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.4, -0.7, 0.2]))[0]
    frame = dataclasses.replace(frame_of(depth=depth), T_world_camera=T)
    values = make_property("normal").image(frame)
    known = np.isfinite(values).all(axis=2)
    assert known.mean() > 0.8 and (1 - values[known] @ (T[:3, :3] @ normal)).max() < FLAT
    bend = make_property("curvature").image(frame)
    assert np.isfinite(bend).mean() > 0.5 and np.nanmax(np.abs(bend)) < 20 * FLAT
    with pytest.raises(FrameError, match="a direction in the world needs the frame's pose"):
        make_property("normal").image(dataclasses.replace(frame, T_world_camera=None))


@pytest.mark.parametrize("side", [1, -1], ids=["ball", "bowl"])
def test_curvature_of_a_sphere_is_one_by_its_radius(side):
    radius, direction = 0.8, rays() / np.linalg.norm(rays(), axis=2, keepdims=True)
    center = np.array([0, 0, 2.0])
    along = direction @ center
    inside = along**2 - center @ center + radius**2
    # the near side of a ball, the far side of a bowl
    distance = along - side * np.sqrt(np.maximum(inside, 0))
    depth = np.where(inside > 0, distance * direction[..., 2], 0).astype(np.float32)
    bend = make_property("curvature,radius=4").image(frame_of(depth=depth))[..., 0]
    assert np.isfinite(bend).sum() > 300
    assert abs(np.nanmedian(bend) - side / radius) < CURVED / radius


# ---- Images from a folder ----


def test_images_are_found_by_name_or_number(tmp_path, noise):
    values = np.random.default_rng(1).normal(size=(90, 120, 5)).astype(np.float32)
    np.save(tmp_path / "17.npy", values)
    np.save(tmp_path / "18.npy", values + 1)
    made = make_property(f"images={tmp_path},name=heat")
    assert (made.name, made.channels) == ("heat", 5)
    np.testing.assert_array_equal(made.image(frame_of()), values)  # shot-000017.depth.png
    np.testing.assert_array_equal(
        made.image(dataclasses.replace(frame_of(), name="a/18.png")), values + 1
    )
    np.testing.assert_array_equal(
        made.image(dataclasses.replace(frame_of(), name="", index=18)), values + 1
    )
    with pytest.raises(FrameError, match="holds no image of that name or number"):
        made.image(dataclasses.replace(frame_of(), name="a/19.png"))
    np.save(tmp_path / "18.npy", values[:50])
    with pytest.raises(
        FrameError, match=r"18.npy: is \(50, 120, 5\), but the frame needs \(90, 120, 5\)"
    ):
        made.image(dataclasses.replace(frame_of(), name="18"))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pictures_are_fractions_and_rgb(tmp_path, noise, dtype):
    full = np.iinfo(dtype).max
    picture = (noise.astype(float) / 255 * full).astype(dtype)
    write_image(tmp_path / "shot-000017.png", picture)  # the writer takes RGB
    values = make_property(f"images={tmp_path}").image(frame_of())
    np.testing.assert_allclose(values, picture / full, atol=ROUNDED)


def test_a_folder_without_images_is_said(tmp_path):
    with pytest.raises(InputError, match=r"no \*.npy, \*.png, \*.jpg, \*.jpeg here"):
        make_property(f"images={tmp_path}")


# ---- Properties as text ----


def test_text_names_method_options_and_settings_of_the_map():
    base = PropertySettings(voxel_size=0.3, noise=2.0)
    made = make_property(
        "style=sketch,color=true,name=drawing,voxel_size=0.05,blend=false,min_points=9,prior=zero",
        base,
    )
    assert made.name == "drawing" and made.channels == 3
    assert made.settings == dataclasses.replace(
        base, voxel_size=0.05, blend=False, min_points=9, prior="zero"
    )
    assert make_property("saliency").settings == Config().property_map
    assert make_property("saliency").make_map().voxel_size == 0.1
    assert make_property("saliency,voxel_size=0.2").settings.voxel_size == 0.2
    assert make_property("saliency=voxel_size=0.2").settings.voxel_size == 0.2


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "salience",
            "property 'salience' is unknown \\(did you mean 'saliency'\\?\\); properties: infrared, saliency",
        ),
        ("", "property '' is unknown"),
        (
            "style=skech",
            "method 'skech' is unknown \\(did you mean 'sketch'\\?\\); methods: painting, opencv, sketch, onnx",
        ),
        (
            "style=sketch,colour=true",
            "option 'colour' is unknown \\(did you mean 'color'\\?\\); options: .*voxel_size",
        ),
        ("style=sketch,color=maybe", "color: expected true or false, got 'maybe'"),
        ("style=sketch,color=true,color=true", "'color=true' is given twice"),
        ("style=sketch,color", "'color' is no option=value"),
        ("style=sketch:x.onnx", "'style=sketch' takes no file"),
        ("style=sketch,shade=0.5", "shade must lie in 0..0.1, got 0.5"),
        ("style,smoothness=0", "smoothness must lie above 0"),
        ("style,contours=-1", "contours must not be negative"),
        ("style,detail=2", "detail must lie above 0 and at most at 1, got 2"),
        ("saliency=onnx", "give the file, as in saliency=onnx:FILE"),
        ("images", "give the file, as in images=folder:FILE"),
        ("infrared=linear,low=5,high=1", "low must be below high"),
        ("infrared=linear,low=much", "low: expected a number, got 'much'"),
        ("infrared=linear,low=nan", "low: expected a number, got 'nan'"),
        ("curvature,radius=0.5", "radius: expected a whole number, got '0.5'"),
        ("curvature,radius=0", "radius must lie in 1..50 pixels"),
        ("saliency,voxel_size=0", "voxel_size: must lie in"),
        ("saliency,prior=none", "prior: 'none' is unknown, choose one of mean, zero"),
        (
            "saliency,name=color",
            "property 'color': a name has letters, digits, _ and -, and is none of surface, color",
        ),
        ("saliency,name=../x", "property '../x': a name has letters"),
    ],
)
def test_text_that_is_wrong_says_what_is_right(text, told):
    with pytest.raises(InputError, match=told):
        make_property(text)


def test_a_folder_that_is_not_there_is_said():
    with pytest.raises(ValueError, match="nowhere: no such folder"):
        make_property("images=nowhere")


def test_every_method_can_be_made(tmp_path):
    """The registry names what exists; the networks have tests of their own."""
    np.save(tmp_path / "0.npy", np.zeros((2, 2)))
    for name, methods in PROPERTIES.items():
        for method in methods:
            if method != "onnx":
                text = f"{name}={method}:{tmp_path}" if name == "images" else f"{name}={method}"
                assert isinstance(make_property(text), SurfaceProperty)


# ---- A function of one's own ----


def test_a_function_is_checked_at_every_frame():
    def told(function, error, match, channels=1):
        with pytest.raises(error, match=match):
            SurfaceProperty("own", channels, function).image(frame_of())

    np.testing.assert_array_equal(
        SurfaceProperty("own", 1, lambda frame: frame.depth > 1).image(frame_of()),
        np.ones((90, 120, 1), np.float32),
    )
    told(
        lambda frame: frame.depth[1:],
        InputError,
        r"must return numbers of shape \(90, 120, 1\), got \(89, 120, 1\) float32",
    )
    told(
        lambda frame: frame.depth,
        InputError,
        r"shape \(90, 120, 3\), got \(90, 120, 1\)",
        channels=3,
    )
    told(lambda frame: "no", InputError, "must return numbers")
    told(
        lambda frame: frame.depth.no,
        InputError,
        "own', shot.*: its function failed with AttributeError: .*'no'",
    )
    told(lambda frame: frame.depth * np.nan, FrameError, "all values are NaN or infinite")
    partly = SurfaceProperty(
        "own", 1, lambda frame: np.where(np.arange(120) < 60, np.nan, frame.depth)
    ).image(frame_of())
    assert np.isnan(partly[:, :60]).all() and (partly[:, 60:] == 2).all()


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"name": "a b"}, "a name has letters"),
        ({"name": "mesh"}, "is none of"),
        ({"channels": 0}, "channels must be at least 1"),
    ],
)
def test_a_property_is_checked_when_it_is_made(values, told):
    with pytest.raises(InputError, match=told):
        SurfaceProperty(
            **{"name": "own", "channels": 1, "function": lambda frame: frame.depth, **values}
        )


# ---- Colours ----


@pytest.mark.parametrize("name", COLORMAPS)
def test_colour_maps_are_even(name):
    """Lightness rises by equal steps over every colour map, to the middle and down again over the
    diverging one.
    """
    table = color_table(name)
    assert table.shape == (256, 3) and table.min() >= 0 and table.max() <= 1
    lightness = cv2.cvtColor(table[None], cv2.COLOR_RGB2Lab)[0, :, 0].astype(float)
    steps = np.diff(lightness[::16])
    if name == "diverging":
        assert np.abs(lightness - lightness[::-1]).max() < 2
        steps = np.abs(steps)
    assert (steps > 0).all() and steps.std() < EVEN * steps.mean()


def test_colours_follow_the_range():
    values = np.float32([[-1], [0], [0.5], [1], [2]])
    colors = colorize(values, "viridis", 0, 1)
    np.testing.assert_allclose(
        colors[[0, 1, 3, 4]], color_table("viridis")[[0, 0, 255, 255]], atol=ROUNDED
    )
    np.testing.assert_allclose(
        colorize(np.float32([[-1, 0, 1]]), "viridis", -1, 1), [[0, 0.5, 1]], atol=ROUNDED
    )
    np.testing.assert_array_equal(colorize(np.float32([[np.nan]]), "gray", 0, 1), [[0, 0, 0]])


def test_the_range_is_stated_or_where_most_values_lie():
    values = np.float32([*np.linspace(2, 3, 1000), 99])[:, None]
    assert shown_range(values, Look(range=(0, 7))) == (0, 7)
    low, high = shown_range(values, Look(range=None))
    assert 2 <= low < 2.05 and 2.9 < high < 3.05
    low, high = shown_range(values - 2.9, Look("diverging", None))
    assert low == -high < 0
    assert shown_range(np.full((9, 1), 5.0), Look(range=None)) == (4.5, 5.5)
    with pytest.raises(InputError, match="range: must rise"):
        Look(range=(1, 1))
    with pytest.raises(InputError, match="colormap: 'jet' is unknown, choose one of viridis"):
        Look("jet")


def test_a_mesh_in_the_colours_of_a_property_keeps_its_values():
    triangle = Mesh(
        np.eye(3, dtype=np.float32),
        np.int32([[0, 1, 2]]),
        None,
        {"color": np.zeros((3, 3), np.float32), "heat": np.float32([[0], [1], [2]])},
    )
    shown = property_mesh(triangle, "heat", Look("inferno", (0, 2)))
    np.testing.assert_array_equal(shown.attributes["heat"], triangle.attributes["heat"])
    np.testing.assert_allclose(
        shown.attributes["color"], color_table("inferno")[[0, 127, 255]], atol=0.01
    )
    many = triangle.with_attribute("many", np.zeros((3, 7)))
    assert set(property_mesh(many, "many", Look()).attributes) == {"many"}


@pytest.mark.parametrize("channels", [1, 3])
def test_a_legend_shows_the_colours(channels):
    legend = draw_legend(600, "heat", Look("viridis", None, "heat [K]"), 1, 3, channels)
    assert legend.shape == (HEIGHT, 600, 3) and legend.dtype == np.uint8 and (legend < 200).any()
    if channels == 1:
        bar = legend[47, 150:450] / 255
        np.testing.assert_allclose(bar[[0, -1]], color_table("viridis")[[0, -1]], atol=0.01)
