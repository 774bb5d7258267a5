"""A map against the oracle's voxels."""

from __future__ import annotations

import numpy as np
import reference

# relative to the largest entry of F: float32 features (2e-5), amplified by solving with noise d of
# 0.3 and more
LATENT = 3e-4


def assert_equal_maps(
    target, twin: dict[tuple, reference.Voxel], latent_tolerance: float = LATENT
) -> None:
    """The map holds exactly the oracle's voxels."""
    data = target.voxels()
    assert list(map(tuple, data.keys.tolist())) == sorted(twin)
    np.testing.assert_array_equal(data.weights, [twin[key].w for key in sorted(twin)])
    np.testing.assert_array_equal(
        reference.unpack_masks(data.masks), [twin[key].mask for key in sorted(twin)]
    )
    F = np.array([twin[key].F for key in sorted(twin)])
    np.testing.assert_allclose(data.latents, F, atol=latent_tolerance * np.abs(F).max())


def encoder_of(settings) -> reference.Encoder:
    e = settings.encoder
    return reference.Encoder(e.rank, e.anchors, e.length_scale, e.seed)


def in_voxels(cloud, settings) -> np.ndarray:
    """Positions [voxels] as the kernels compute them, so that no point changes its cell."""
    return (cloud.points * np.float32(1 / settings.voxel_size)).astype(float)
