"""Properties on the surface: what goes in comes out, everywhere that is valid."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import cloud_of, rectangle, sphere

from taichi_unifusion import PropertyMap
from taichi_unifusion.errors import InputError

CONSTANT = 1e-3  # a constant must come back everywhere, rims included: the prior mean carries it
LINEAR = 0.02  # of a property that runs from 0 to 1 over 0.8 m, in 2 cm voxels
RGB = np.array([0.9, 0.15, 0.6])


def colored(cloud, values):
    return cloud_of(cloud.points, cloud.normals, rgb=np.broadcast_to(values, (len(cloud), 3)))


@pytest.fixture(scope="module")
def target() -> PropertyMap:
    """A ball of one colour, and 2 m beside it a plane whose colour runs with x and y."""
    plane = rectangle((2, 0, 0), (0.4, 0, 0), (0, 0.4, 0.1), 0.004)
    ramp = np.column_stack(
        [
            (plane.points[:, 0] - 1.6) / 0.8,
            (plane.points[:, 1] + 0.4) / 0.8,
            np.full(len(plane), 0.5),
        ]
    )
    color = PropertyMap("rgb", 3)
    color.integrate(colored(sphere(0.2, 0.004), RGB))
    color.integrate(colored(plane, ramp))
    return color


def test_a_constant_comes_back_everywhere_valid(target):
    # near and far from the data, rims of voxels included
    points = np.random.default_rng(1).uniform(-0.26, 0.26, (40_000, 3))
    values, valid = target.query(points, return_valid=True)
    assert 0.1 < valid.mean() < 0.8
    assert np.abs(values[valid] - RGB).max() < CONSTANT
    beyond = values[~valid]  # the nearest voxel's value, or 0 farther away
    assert ((np.abs(beyond - RGB).max(axis=1) < CONSTANT) | (beyond == 0).all(axis=1)).all() and (
        beyond == 0
    ).any()


def test_a_constant_comes_back_on_the_lattice_of_voxel_centres(target):
    """Exactly representable rims: points at voxel centres and on voxel faces, where tents of
    neighbours vanish.
    """
    n = np.arange(-26, 27) * 0.5
    lattice = np.stack(np.meshgrid(n, n, n, indexing="ij"), axis=-1).reshape(-1, 3) * np.float32(
        0.02
    )
    values, valid = target.query(lattice, return_valid=True)
    assert valid.any() and np.abs(values[valid] - RGB).max() < CONSTANT


@pytest.mark.parametrize("blend", [True, False])
@pytest.mark.parametrize("fusion", ["mean", "information"])
@pytest.mark.parametrize("sampling", ["cells", "points"])
def test_a_constant_comes_back_of_several_frames_in_every_mode(sampling, fusion, blend):
    """Two frames that overlap in part, one of them thin: voxels hold one point or hundreds, of one
    frame or of both.
    """
    color = PropertyMap("rgb", 3, voxel_size=0.04, sampling=sampling, fusion=fusion, blend=blend)
    color.integrate(colored(rectangle((0, 0, 0), (0.3, 0, 0.1), (0, 0.3, 0), 0.01), RGB))
    color.integrate(colored(rectangle((0.2, 0.1, 0), (0.3, 0, 0), (0, 0.3, 0), 0.03), RGB))
    points = np.random.default_rng(2).uniform((-0.4, -0.4, -0.2), (0.6, 0.5, 0.2), (20_000, 3))
    values, valid = color.query(points, return_valid=True)
    assert 0.05 < valid.mean() < 0.9
    assert np.abs(values[valid] - RGB).max() < CONSTANT


def test_a_linear_property_comes_back_on_the_surface(target):
    plane = rectangle((2, 0, 0), (0.39, 0, 0), (0, 0.39, 0.0975), 0.01)
    values, valid = target.query(plane.points, return_valid=True)
    wanted = np.column_stack(
        [
            (plane.points[:, 0] - 1.6) / 0.8,
            (plane.points[:, 1] + 0.4) / 0.8,
            np.full(len(plane), 0.5),
        ]
    )
    assert valid.all() and np.abs(values - wanted).max() < LINEAR


def test_the_zero_prior_darkens_what_the_mean_prior_keeps():
    """As published: with few points a voxel the field falls back to black."""
    patch = colored(rectangle((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), 0.01), RGB)
    zero = PropertyMap("rgb", 3, prior="zero", blend=False)
    zero.integrate(patch)
    values, valid = zero.query(patch.points, return_valid=True)
    assert (
        valid.mean() > 0.9
        and (values[valid].min(axis=0) > 0).all()
        and (values[valid].min(axis=0) < 0.9 * RGB).all()
    )


def test_the_attribute_must_be_there_and_fit(target):
    cloud = sphere(0.1, 0.05)
    with pytest.raises(
        InputError, match="property map 'rgb': the cloud has no attribute 'rgb', only none"
    ):
        target.integrate(cloud)
    with pytest.raises(InputError, match="expected 3 channels, the cloud has 2"):
        target.integrate(cloud_of(cloud.points, cloud.normals, rgb=np.zeros((len(cloud), 2))))
    with pytest.raises(InputError, match="channels must lie in 1..64, got 0"):
        PropertyMap("rgb", 0)
    with pytest.raises(InputError, match="^prior: 'none' is unknown, choose one of mean, zero"):
        PropertyMap("rgb", 3, prior="none")


def test_a_value_that_is_no_number_is_refused_or_left_out_never_spread():
    """One NaN among the values of a frame must not reach any other point."""
    cloud = colored(rectangle((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), 0.004), RGB)
    cloud.attributes["rgb"][500, 1] = np.nan
    color = PropertyMap("rgb", 3)
    try:
        color.integrate(cloud)
    except InputError:
        assert len(color) == 0
    else:
        values, valid = color.query(cloud.points, return_valid=True)
        assert valid.mean() > 0.9 and np.abs(values[valid] - RGB).max() < CONSTANT
