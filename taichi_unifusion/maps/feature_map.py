"""FeatureMap: high-dimensional features of the surface, such as CLIP's, as a LIM (Sec. IV-D)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self, Unpack, overload

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import DeviceArray
from ..errors import FrameError, InputError, strict
from ..geometry.checks import as_numbers
from ..kernels import feature_query as decoding
from ..kernels import features as kernels
from ..kernels import ti
from ..kernels.cells import CELLS
from ..kernels.patches import Patches
from ..types import Frame, ImageView, PointCloud
from .base_map import BaseMap, Integration, check_cloud
from .binner import Binner, patches_of
from .encoder import check_points, to_device, window_masks, workers
from .encoding import position_encoding
from .kept_window import KeptCells, KeptFeatures
from .keywords import FeatureKeywords, settings_of, shows_keywords
from .local_lim import Binned
from .property_map import NEAREST_REACH
from .settings import MAX_FEATURE_CHANNELS, FeatureSettings, check_channels
from .voxel_data import VoxelData, feature_fields
from .voxel_grid import VoxelGrid

GPU_WORKERS = 1024
NODES = 17  # of the table of position features along an edge of the doubled voxel
MAX_FEATURE = 1e4  # above it half precision, which ends at 65,504, would lose sums
TEXTS_AT_ONCE = 64
CHANNELS_AT_ONCE = 32


@dataclass(frozen=True)
class _SeenPixels:
    """Which feature pixels a cloud's cells fall into."""

    pixels: NDArray[np.int32]  # (M,) of every cell, -1 where none
    seen: NDArray[np.int32]  # (h w,) points in every pixel
    weights: NDArray[np.float32]  # (B,) points of a block that have a pixel


@strict
class FeatureMap(BaseMap[FeatureSettings]):
    """A continuous field of feature vectors on the surface, fused from the feature image `name` of
    point clouds.

        features = FeatureMap("clip", channels=512)
        features.integrate(cloud)                             # cloud.features["clip"]: (h, w, 512)
        scores = features.similarity(mesh.vertices, texts)    # (V, n) cosines with texts (n, 512)

    A frame's features are never put on its points or pixels: a voxel takes sums over the few
    feature pixels that it sees. It keeps a mean and `encoder.rank` - 1 slopes, in the precision of
    the settings. Keywords are those of `FeatureSettings`.
    """

    kind = "latent"
    settings_type = FeatureSettings

    @shows_keywords(FeatureSettings)
    def __init__(
        self,
        name: str,
        channels: int,
        settings: FeatureSettings | None = None,
        **keywords: Unpack[FeatureKeywords],
    ) -> None:
        settings = settings_of(FeatureSettings, settings, dict(keywords), "FeatureMap")
        check_channels(f"feature map '{name}'", channels, MAX_FEATURE_CHANNELS)
        # the first eigenfunction is nearly constant: the mean replaces it, the other rank - 1 stay
        self.rank = settings.encoder.rank - 1
        super().__init__(name, channels, settings, VoxelGrid(feature_fields(channels, settings)))
        self.layout = kernels.FeatureLayout(self.rank, settings.precision == "int8")
        self.binner = Binner(self.grid, settings.voxel_size, 0, with_positions=True)
        encoding = position_encoding(settings.encoder)
        self._cell_features = to_device(encoding(encoding.nodes(2 * CELLS))[:, 1:])
        self._table = to_device(encoding.lattice(NODES)[:, 1:])
        self._window = window_masks(settings.margin)
        self._scratch = self._borrow_scratch()

    @classmethod
    def _empty(cls, name: str, channels: int, settings: FeatureSettings) -> Self:
        return cls(name, channels, settings)

    def _borrow_scratch(self) -> kernels.Scratch:
        """Scratch of the workers, one for all maps of a runtime."""
        live, q, entries = self.grid.runtime, self.rank, kernels.ENTRIES
        n = workers(live, GPU_WORKERS)
        room = _whole(self.channels, kernels.CHANNELS)

        def make() -> kernels.Scratch:
            return kernels.Scratch(
                ti.field(ti.f32, (n, 1 + q, entries)),
                ti.field(ti.i32, (n, entries)),
                ti.field(ti.f32, (n, kernels.CHANNELS, entries)),
                ti.field(ti.f32, (n, 1 + q, room)),
            )

        return live.arena.exact("features", make, (n, q, room))

    @property
    def _pools(self) -> Any:
        """The pools of the voxels as one argument of a kernel."""
        names = ("means", "slopes", "scales", "latents", "weights")
        arrays = dict(zip(kernels.FeaturePools.members, (self.grid[n] for n in names), strict=True))
        return kernels.FeaturePools(**arrays)

    def wants(self, cloud: PointCloud | Frame) -> bool:
        return self.name in cloud.features

    def integrate(self, cloud: PointCloud) -> Integration:
        """Fuse the features that a cloud's points see into the map; the cloud in world coordinates.

        Raises as `BaseMap.integrate`, and FrameError where no feature is finite; the map is then
        unchanged.
        """
        check_cloud("FeatureMap.integrate", cloud)
        features = self._features_of(cloud.features)
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        return self._integrate(patches_of(cloud, self.grid.runtime.device), features)

    def integrate_patches(self, patches: Patches) -> Integration:
        """Fuse the features that a frame's patches see into the map, as `integrate` does."""
        return self._integrate(patches, self._features_of(patches.features))

    def integrate_and_keep(
        self, patches: Patches, *, fuse: bool = True
    ) -> tuple[Integration, KeptFeatures]:
        """As `integrate_patches`; also what was fused, by value, which is what is kept of it. Without `fuse`
        it is kept alone.
        """
        runtime.check_alive(self.grid.runtime)
        binner = self.binner
        opened = binner.touch(binner.open(binner.shared()), patches)
        binner.add(opened, patches, [])
        cells = KeptCells.of(opened, binner, [])
        kept = KeptFeatures.of(self.name, cells, self._features_of(patches.features))
        binned = binner.close(opened, self.grid.runtime.arena)
        if not fuse:
            return Integration(patches.total, 0, len(self)), kept
        return self._fuse(binned, kept.image(), patches.total), kept

    def integrate_kept(self, kept: KeptFeatures, T: NDArray[np.float64] | None) -> None:
        """Fuse again what was kept, of points moved by T."""
        binned = kept.cells.binned(self.binner, self.binner.shared(), T)
        self._fuse(binned, kept.image(T), 0)

    def clear(self) -> None:
        """Forget all voxels."""
        self.flush()
        self.grid.clear()

    def _integrate(self, patches: Patches, features: ImageView) -> Integration:
        runtime.check_alive(self.grid.runtime)
        image = self._usable(features.values)  # first: it may raise
        return self._fuse(self.binner.bin(patches, []), features, patches.total, image)

    def _fuse(
        self,
        binned: Binned,
        features: ImageView,
        points: int,
        pixels: tuple[NDArray[np.float32], NDArray[np.uint8]] | None = None,
    ) -> Integration:
        image, usable = pixels or self._usable(features.values)
        starts = np.ascontiguousarray(binned.rows[:, 0])
        found = self._find_pixels(binned, starts, features, usable)
        if not found.seen.any():
            return Integration(points, 0, len(self))
        slots = np.empty(binned.count, np.int32)
        encoded = self.grid.claim(binned.count, binned.keys, found.weights, slots)
        kernels.fuse_features(
            self.layout,
            binned.keys,
            slots,
            binned.neighbors,
            binned.masks,
            self._window,
            starts,
            binned.cells,
            found.pixels,
            self._cell_features,
            image,
            float((found.seen > 0).sum() / found.seen.sum()),
            self._scratch,
            self._pools,
        )
        return Integration(points, encoded, len(self))

    def _features_of(self, images: Mapping[str, ImageView]) -> ImageView:
        features = images.get(self.name)
        if features is None:
            raise InputError(
                f"feature map '{self.name}': the cloud has no feature image '{self.name}', only "
                f"{', '.join(sorted(images)) or 'none'}"
            )
        if features.values.shape[2] != self.channels:
            raise InputError(
                f"feature map '{self.name}': expected {self.channels} channels, the feature image has "
                f"{features.values.shape[2]}; another network made it"
            )
        return features

    def _usable(self, values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The feature pixels as rows, filled up to whole vectors, and which of them are finite."""
        rows = values.reshape(-1, self.channels)
        usable = np.isfinite(rows @ np.ones(self.channels, np.float32))
        if not usable.any():
            raise FrameError(
                f"features '{self.name}': not one pixel is finite; the frame is left out"
            )
        if not usable.all() or self.channels % kernels.CHANNELS:
            filled = np.zeros((len(rows), _whole(self.channels, kernels.CHANNELS)), np.float32)
            filled[usable, : self.channels] = rows[usable]
            rows = filled
        largest = max(float(rows.max()), -float(rows.min()))
        if largest > MAX_FEATURE:
            raise FrameError(
                f"features '{self.name}': hold numbers up to {largest:.3g}; scale them to unit length"
            )
        return np.ascontiguousarray(rows), usable.astype(np.uint8)

    def _find_pixels(
        self,
        binned: Binned,
        starts: NDArray[np.int32],
        features: ImageView,
        usable: NDArray[np.uint8],
    ) -> _SeenPixels:
        found = _SeenPixels(
            np.empty(binned.cells.shape[0], np.int32),
            np.zeros(len(usable), np.int32),
            np.empty(binned.count, np.float32),
        )
        projection = features.camera.matrix @ features.T_camera_cloud[:3]
        kernels.find_pixels(
            binned.count,
            binned.keys,
            starts,
            binned.masks,
            binned.cells,
            self.voxel_size,
            projection.astype(np.float32),
            features.camera.width,
            usable,
            self.settings.min_points,
            found.seen,
            found.pixels,
            found.weights,
        )
        runtime.synchronize()
        return found

    @overload
    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: Literal[False] = False
    ) -> NDArray[np.float32]: ...

    @overload
    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: Literal[True]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...

    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: bool = False
    ) -> NDArray[np.float32] | tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Cosine (N, n) between the features at points (N, 3) world [m] and text embeddings (n, c);
        (N,) for a single (c,).

        Texts are multiplied onto the map first, so that a point costs n numbers, not c. The length
        of a feature is taken to be that of its voxel's mean. `return_valid` also gives where (N,) a
        voxel covers the point; elsewhere as `PropertyMap.query`. Raises InputError where the texts
        have another number of channels.
        """
        texts = np.atleast_2d(
            as_numbers(f"feature map '{self.name}': text embedding", text_embedding)
        )
        if texts.ndim != 2 or texts.shape[1] != self.channels:
            raise InputError(
                f"feature map '{self.name}': holds features of {self.channels} channels, the text "
                f"embedding has {texts.shape[-1]}; use the text encoder that belongs to the image features"
            )
        if not np.isfinite(texts).all() or not np.linalg.norm(texts, axis=1).all():
            raise InputError(f"feature map '{self.name}': a text embedding is zero or not finite")
        texts = texts / np.linalg.norm(texts, axis=1, keepdims=True)
        points, lengths = check_points(points), self._mean_lengths()
        scores, valid = np.zeros((len(points), len(texts)), np.float32), np.zeros(len(points), bool)
        for first in range(0, len(texts), TEXTS_AT_ONCE):
            part = texts[first : first + TEXTS_AT_ONCE]
            filled = np.zeros((_whole(len(part), decoding.DIRECTIONS), self.channels), np.float32)
            filled[: len(part)] = part
            products = self._products(len(part))
            if len(self):
                decoding.project_rows(len(self), *self._rows, filled, products)
                self._solve(products)
                products /= np.maximum(lengths, 1e-12)[:, None, None]
            values, valid = self._decode(points, products)
            scores[:, first : first + len(part)] = values[:, : len(part)]
        values = scores[:, 0] if np.ndim(text_embedding) == 1 else scores
        return (values, valid) if return_valid else values

    def uncertainty(self, points: NDArray) -> NDArray[np.float32]:
        """Standard deviation (N,) of the product of a feature's direction at points (N, 3) world
        [m] with a unit vector.

        Averaging w unit vectors keeps the common direction and shrinks independent noise: the
        shorter the mean, the larger the noise. Features that were not of unit length make it wrong.
        """
        n, lengths = len(self), self._mean_lengths()
        more = np.maximum(self.grid["weights"].to_numpy()[:n], 1 + 1e-3)
        agreeing = np.clip((lengths**2 - 1 / more) / (1 - 1 / more), 1e-3, 1)
        products = self._products(1)
        products[:n, 0, 0] = np.sqrt((1 - agreeing) / (agreeing * self.channels * more))
        return self._decode(check_points(points), products)[0][:, 0]

    @overload
    def query(
        self, points: NDArray, return_valid: Literal[False] = False
    ) -> NDArray[np.float32]: ...

    @overload
    def query(
        self, points: NDArray, return_valid: Literal[True]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...

    def query(
        self, points: NDArray, return_valid: bool = False
    ) -> NDArray[np.float32] | tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Features (N, c) float32 at points (N, 3) world [m]; otherwise as `PropertyMap.query`."""
        points = check_points(points)
        values = np.zeros((len(points), self.channels), np.float32)
        valid = np.zeros(len(points), bool)
        for first in range(0, self.channels, CHANNELS_AT_ONCE):
            count = min(CHANNELS_AT_ONCE, self.channels - first)
            products = self._products(count)
            if len(self):
                decoding.take_channels(len(self), *self._rows, first, products)
                self._solve(products)
            part, valid = self._decode(points, products)
            values[:, first : first + count] = part[:, :count]
        return (values, valid) if return_valid else values

    def _mean_lengths(self) -> NDArray[np.float32]:
        """Length (S,) of every voxel's mean."""
        lengths = np.ones(len(self), np.float32)
        if len(self):
            decoding.mean_lengths(len(self), self.grid["means"], lengths)
        return lengths

    @property
    def _rows(self) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Means, slopes and scales, as kernels take them."""
        return self.grid["means"], self.grid["slopes"], self.grid["scales"]

    def _products(self, count: int) -> NDArray[np.float32]:
        """Room (S, 1 + q, T) for the products of every voxel's mean and slopes with `count` texts,
        which are filled up to a multiple of DIRECTIONS.
        """
        runtime.check_alive(self.grid.runtime)
        texts = _whole(count, decoding.DIRECTIONS)
        return np.zeros((max(len(self), 1), 1 + self.rank, texts), np.float32)

    def _solve(self, products: NDArray[np.float32]) -> None:
        """Make the products, in place, constants and coefficients of the fields."""
        moments, weights, noise = self.grid["latents"], self.grid["weights"], self.settings.noise
        decoding.solve_rows(self.rank, len(self), moments, weights, noise, products)

    def _decode(
        self, points: NDArray[np.float32], products: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        values = np.zeros((len(points), products.shape[2]), np.float32)
        valid = np.zeros(len(points), np.uint8)
        if len(points) and len(self):
            decoding.query_products(
                self.rank,
                points,
                1.0 / self.voxel_size,
                self.grid.index,
                products,
                self._table,
                NODES,
                NEAREST_REACH,
                values,
                valid,
            )
        return values, valid.astype(bool)

    def fuse_voxels(self, data: VoxelData) -> None:
        """Exact, up to the rounding of what is kept."""
        n = len(data)
        if n:
            slots = np.empty(n, np.int32)
            self.grid.claim(n, data.keys, data.weights, slots)
            kernels.fuse_voxels(
                self.layout,
                data.keys,
                slots,
                data.fields["means"],
                data.fields["slopes"],
                data.fields["scales"],
                data.latents,
                data.weights,
                self._scratch,
                self._pools,
            )


def _whole(count: int, step: int) -> int:
    """The next multiple of a step."""
    return -(-count // step) * step
