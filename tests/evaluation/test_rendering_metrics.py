"""Rendering metrics against cases with known answers, Open3D's ray casting and scikit-image's PSNR
and SSIM.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from meshes import CAMERA, at, joined, mesh_of, open3d_scene, random_rigid, random_soup, rectangle
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from taichi_unifusion import Frame, PinholeCamera, open_dataset
from taichi_unifusion.errors import InputError, PoseError
from taichi_unifusion.evaluation import evaluate_rendering
from taichi_unifusion.evaluation.rendering import psnr, render_frame, ssim
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.types import Mesh

ROUNDING = 1e-4  # [cm] depth is float32
SAME_DEPTH = 1e-4  # relative to Open3D's float32 rays
SILHOUETTE = 0.01  # share of pixels whose ray passes so near an edge that two libraries may differ
SAME_SSIM = 1e-6
LEVEL = 0.5 / 255  # rounding of an 8-bit colour
SHAPE = CAMERA.height, CAMERA.width
WALL = rectangle((-3, -3), (3, 3), 2.0, color=(0.2, 0.4, 0.6))
GREY = np.full((*SHAPE, 3), 102, np.uint8)  # 0.4


def frame_of(depth, color=GREY, T_world_camera=None, **more) -> Frame:
    depth = np.full(SHAPE, depth, np.float32) if np.isscalar(depth) else depth.astype(np.float32)
    return Frame(
        depth, CAMERA, color, at(0, 0, 0) if T_world_camera is None else T_world_camera, **more
    )


# --- Casting --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mesh", "T_world_camera"),
    [
        (random_soup(400, 1, slivers=False), random_rigid(2)),
        (random_soup(4000, 3, 0.05, slivers=False), at(0, 0, -2)),
        (WALL, at(0.3, 0.2, 3.0) @ np.diag([-1, 1, -1, 1.0])),
    ],
    ids=["soup around the camera", "crumbs", "from behind"],
)
def test_rays_hit_what_open3ds_hit(mesh, T_world_camera):
    o3d = pytest.importorskip("open3d")
    camera = PinholeCamera(160, 120, 90.0, 85.0, 70.3, 61.7)
    caster = RayCaster(
        mesh.with_attribute("color", np.random.default_rng(0).uniform(size=(len(mesh.vertices), 3)))
    )
    hits = caster.cast(camera, T_world_camera)
    v, u = np.mgrid[:120, :160]
    directions = (
        np.stack([(u - 70.3) / 90, (v - 61.7) / 85, np.ones((120, 160))], axis=-1)
        @ T_world_camera[:3, :3].T
    )
    rays = np.concatenate(
        [np.broadcast_to(T_world_camera[:3, 3], directions.shape), directions], axis=-1
    )
    known = {
        name: value.numpy()
        for name, value in open3d_scene(mesh)
        .cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        .items()
    }
    same = hits.hit == np.isfinite(known["t_hit"])
    near = np.isclose(hits.depth, known["t_hit"], rtol=SAME_DEPTH)  # inf is close to inf
    assert same.mean() > 1 - SILHOUETTE and near.mean() > 1 - SILHOUETTE and hits.hit.mean() > 0.1
    both = hits.hit & near & (hits.triangle == known["primitive_ids"].astype(np.int64))
    assert both[hits.hit & near].mean() > 1 - SILHOUETTE
    s, t = known["primitive_uvs"][both].T
    corners = caster.mesh.attributes["color"][mesh.faces[hits.triangle[both]]]
    expected = (
        (1 - s - t)[:, None] * corners[:, 0]
        + s[:, None] * corners[:, 1]
        + t[:, None] * corners[:, 2]
    )
    difference = np.abs(caster.interpolate(hits, both, caster.mesh.attributes["color"]) - expected)
    # slivers: float32 against float64
    assert np.quantile(difference, 0.99) < 1e-2 and np.median(difference) < 1e-4
    at_depth = rays[both][:, :3] + rays[both][:, 3:] * known["t_hit"][both][:, None]
    np.testing.assert_allclose(hits.points(both), at_depth, atol=1e-3)


def test_casting_gives_the_depth_of_a_plane_at_every_pixel():
    tilted = mesh_of(
        [(x, y, 2 + 0.5 * x) for x in (-3, 3) for y in (-3, 3)], [(0, 1, 2), (1, 3, 2)]
    )
    hits = RayCaster(tilted).cast(CAMERA, at(0, 0, 0))
    slope = (np.arange(64) - 31.5) / 40
    np.testing.assert_allclose(hits.depth, np.tile(2 / (1 - 0.5 * slope), (48, 1)), rtol=1e-6)
    x, _, z = hits.points(hits.hit).T
    np.testing.assert_allclose(z, 2 + 0.5 * x, rtol=1e-5)


def test_the_synthetic_room_is_seen_as_its_renderer_sees_it():
    room = open_dataset("synthetic", frames=12, width=160, height=120, noise=False)
    result = evaluate_rendering(room.ground_truth_mesh(), [room[3]], depth_max=10)
    assert (
        result.coverage == 1
        and result.depth_median_cm < 0.01
        and result.depth_within > 1 - SILHOUETTE
    )


# --- Known answers --------------------------------------------------------------------------------------------------


def test_a_constant_offset_is_read_off():
    result = evaluate_rendering(WALL, [frame_of(2.03, index=7), frame_of(1.99, index=9)])
    assert [score.index for score in result.frames] == [7, 9]
    assert [score.depth_l1_cm for score in result.frames] == pytest.approx([3, 1], abs=ROUNDING)
    assert (result.depth_l1_cm, result.depth_median_cm) == pytest.approx((2, 2), abs=ROUNDING)
    assert (result.coverage, result.depth_within) == (1, 0.5)
    error = np.array([0.2, 0.4, 0.6]) - 0.4
    assert result.psnr_db == pytest.approx(-10 * np.log10((error**2).mean()), abs=1e-3)


def test_mean_and_median_are_told_apart():
    depth = np.full(SHAPE, 2.0)
    depth[:, :16] = 2.4
    result = evaluate_rendering(WALL, [frame_of(depth)])
    assert (result.depth_l1_cm, result.depth_median_cm) == pytest.approx((10, 0), abs=ROUNDING)
    assert result.depth_within == 0.75


def test_what_is_not_hit_lowers_coverage_alone():
    half = rectangle((-3, -3), (0, 3), 2.0, color=(0.4, 0.4, 0.4))
    result = evaluate_rendering(half, [frame_of(2.01)])
    assert (result.coverage, result.depth_within, result.frames[0].readings) == (0.5, 0.5, 64 * 48)
    assert result.depth_l1_cm == pytest.approx(1, abs=ROUNDING)
    assert result.psnr_db > 60 and result.ssim == pytest.approx(1, abs=1e-3)
    depth = np.full(SHAPE, 2.0)
    depth[:, :16] = 0  # of the readings left, two thirds are not hit
    assert evaluate_rendering(half, [frame_of(depth)]).coverage == pytest.approx(1 / 3)


def test_F2_only_readings_in_range_are_compared():
    depth = np.full(SHAPE, 2.0)
    depth[0], depth[1], depth[2], depth[3], depth[4], depth[5] = 0, np.nan, np.inf, -1, 5.5, 0.05
    result = evaluate_rendering(WALL, [frame_of(depth)])
    assert result.frames[0].readings == 42 * 64 and result.depth_l1_cm == pytest.approx(
        0, abs=ROUNDING
    )
    assert evaluate_rendering(WALL, [frame_of(depth)], depth_max=6).frames[0].readings == 43 * 64
    assert evaluate_rendering(WALL, [frame_of(depth)], depth_min=0.0).frames[0].readings == 43 * 64


def test_colour_is_asked_for_at_the_points_that_are_hit():
    """A colour field in world coordinates, seen by a moved camera; values outside [0, 1] are
    clipped.
    """

    def field(points):
        return np.stack(
            [0.5 + 0.2 * points[:, 0], 0.5 + 0.2 * points[:, 1], 10 * points[:, 2]], axis=1
        )

    camera = at(0.4, -0.2, 0.5)
    x, y = (np.arange(64) - 31.5) / 40 * 1.5 + 0.4, (np.arange(48) - 23.5) / 40 * 1.5 - 0.2
    known = np.stack([*np.meshgrid(0.5 + 0.2 * x, 0.5 + 0.2 * y), np.ones(SHAPE)], axis=-1)
    taken = np.rint(255 * known).astype(np.uint8)
    rendered = render_frame(RayCaster(WALL), frame_of(1.5, taken, camera), field)
    np.testing.assert_allclose(rendered.color, known, atol=1e-5)
    result = evaluate_rendering(WALL, [frame_of(1.5, taken, camera)], color=field)
    assert result.psnr_db > -20 * np.log10(LEVEL) and result.ssim > 0.999
    # the wall's own colour
    assert evaluate_rendering(WALL, [frame_of(1.5, taken, camera)]).psnr_db < 15


def test_without_colour_there_is_no_psnr():
    plain = mesh_of(WALL.vertices, WALL.faces)
    for mesh, frame in ((plain, frame_of(2.0)), (WALL, frame_of(2.0, None))):
        result = evaluate_rendering(mesh, [frame])
        assert (result.psnr_db, result.ssim) == (None, None) and result.coverage == 1


def test_a_mesh_that_no_ray_meets_is_refused():
    away = frame_of(2.0, T_world_camera=at(0, 0, 4))
    with pytest.raises(InputError, match="no ray of 2 frames meets the mesh"):
        evaluate_rendering(WALL, [away, away])


def test_frames_without_anything_to_compare_are_left_out_of_the_means():
    # looks away from the wall: nothing hit, all readings missed
    away = frame_of(2.0, T_world_camera=at(0, 0, 4))
    result = evaluate_rendering(WALL, [frame_of(2.01), away, frame_of(0.0)])
    assert [score.coverage for score in result.frames] == [1, 0, None]
    assert (
        result.frames[1].depth_l1_cm,
        result.frames[1].psnr_db,
        result.frames[1].depth_within,
    ) == (None, None, 0)
    assert (
        result.depth_l1_cm == pytest.approx(1, abs=ROUNDING)
        and result.coverage == result.depth_within == 0.5
    )


def test_the_nearest_of_several_surfaces_is_seen():
    near = rectangle((-3, -3), (3, 3), 1.0, color=(1, 0, 0))
    assert evaluate_rendering(
        joined(WALL, near, WALL), [frame_of(1.0)]
    ).depth_l1_cm == pytest.approx(0, abs=ROUNDING)


# --- PSNR and SSIM --------------------------------------------------------------------------------------------------


@pytest.fixture
def pictures():
    rng = np.random.default_rng(0)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(60, 80, 3)), axis=0), axis=1)
    image = np.clip(0.5 + 0.3 * smooth / np.abs(smooth).max(), 0, 1)
    return image, np.clip(image + rng.normal(0, 0.05, image.shape), 0, 1)


WINDOW = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 1.0,
    "channel_axis": 2,
}


def test_full_images_are_judged_as_scikit_image_judges_them(pictures):
    a, b = pictures
    everywhere = np.ones(a.shape[:2], bool)
    assert psnr(a, b, everywhere) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1.0))
    assert ssim(a, b, everywhere) == pytest.approx(
        structural_similarity(a, b, **WINDOW), abs=SAME_SSIM
    )
    assert ssim(a, a, everywhere) == pytest.approx(1) and psnr(a, a, everywhere) == np.inf


def test_ssim_far_from_holes_is_scikit_images(pictures):
    a, b = pictures
    mask = np.zeros(a.shape[:2], bool)
    # the means are over 10..34 on both sides; its own windows reach 5 pixels farther
    mask[5:-5, 5:40] = True
    known = structural_similarity(a, b, full=True, **WINDOW)[1]
    inner = mask.copy()
    inner[:, :10] = inner[:, 35:] = inner[:10] = inner[-10:] = False

    def part(kept):
        values = np.array([ssim_at(a, b, mask, v, u) for v, u in np.argwhere(kept)])
        return values

    np.testing.assert_allclose(part(inner)[::25], known[inner].mean(axis=1)[::25], atol=SAME_SSIM)
    assert ssim(a, b, mask) == pytest.approx(part(mask).mean(), abs=SAME_SSIM)


def ssim_at(a, b, mask, v, u) -> float:
    """SSIM of the window around one pixel, from its definition, over the pixels of the mask."""
    rows, columns = np.mgrid[v - 5 : v + 6, u - 5 : u + 6]
    weights = np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / (2 * 1.5**2)) * mask[rows, columns]
    weights = (weights / weights.sum())[..., None]
    x, y = a[rows, columns], b[rows, columns]
    mean_x, mean_y = (weights * x).sum(axis=(0, 1)), (weights * y).sum(axis=(0, 1))
    var_x, var_y = (
        (weights * (x - mean_x) ** 2).sum(axis=(0, 1)),
        (weights * (y - mean_y) ** 2).sum(axis=(0, 1)),
    )
    covariance = (weights * (x - mean_x) * (y - mean_y)).sum(axis=(0, 1))
    return float(
        np.mean(
            (2 * mean_x * mean_y + 1e-4)
            * (2 * covariance + 9e-4)
            / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))
        )
    )


def test_what_a_hole_holds_plays_no_part(pictures):
    a, b = pictures
    mask = np.random.default_rng(1).random(a.shape[:2]) > 0.3
    other = np.where(mask[..., None], a, 0.9)
    assert ssim(a, b, mask) == pytest.approx(ssim(other, b, mask), abs=SAME_SSIM) and psnr(
        a, b, mask
    ) == psnr(other, b, mask)
    assert ssim(a, b, mask) == pytest.approx(ssim(b, a, mask), abs=SAME_SSIM)


def test_a_mask_at_the_border_alone_leaves_nothing(pictures):
    mask = np.zeros(pictures[0].shape[:2], bool)
    mask[:5] = True
    assert ssim(*pictures, mask) is None


# --- Bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mesh", "frames", "options", "error", "told"),
    [
        (mesh_of([], []), [frame_of(2.0)], {}, InputError, "reconstruction: has no triangles"),
        (WALL, [], {}, InputError, "no frames to compare"),
        (
            WALL,
            [frame_of(0.0), frame_of(9.0)],
            {},
            InputError,
            "none of 2 frames has a depth reading in 0.1..5 m",
        ),
        (WALL, [frame_of(2.0)], {"depth_max": 0.05}, InputError, "depth_min < depth_max"),
        (
            WALL,
            [Frame(np.ones(SHAPE, np.float32), CAMERA, name="lost.png")],
            {},
            PoseError,
            "lost.png: there is no pose",
        ),
        (
            WALL,
            [frame_of(2.0)],
            {"color": lambda points: points[:, :1]},
            InputError,
            r"colours must be \(N, 3\)",
        ),
    ],
)
def test_bad_input_is_told_in_one_sentence(mesh, frames, options, error, told):
    with pytest.raises(error, match=told):
        evaluate_rendering(mesh, frames, **options)


def test_results_are_values():
    with pytest.raises(dataclasses.FrozenInstanceError):
        evaluate_rendering(WALL, [frame_of(2.0)]).coverage = 1


# --- Textures -------------------------------------------------------------------------------------------------------


def test_a_texture_is_what_the_camera_sees():
    # a wall that fills the image, whose texture is the frame itself
    color = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [CAMERA.width, CAMERA.height] - 0.5
    rays = CAMERA.rays(*corners.T)
    mesh = Mesh((2 * rays).astype(np.float32), np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    places = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    frame = frame_of(2.0, color)
    result = evaluate_rendering(mesh, [frame], texture=Texture(places, color))
    assert result.coverage == 1 and result.psnr_db > 45
    turned = Texture(places[[1, 2, 3, 0]], color)
    assert evaluate_rendering(mesh, [frame], texture=turned).psnr_db < 15
