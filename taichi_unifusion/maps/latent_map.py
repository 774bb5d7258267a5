"""LatentMap: high-dimensional features of the surface, such as CLIP's, as a LIM (Sec. IV-D)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from .. import runtime
from ..errors import FrameError, InputError
from ..kernels import fusion, regression
from ..kernels import latent as kernels
from ..kernels import latent_query as decoding
from ..kernels.voxels import CELLS
from ..types import ImageView, PointCloud
from .base_map import BaseMap, Integration
from .encoding import position_encoding
from .feature_rows import FeatureRows, RowData
from .frame_blocks import FrameBlocks
from .property_map import NEAREST_REACH
from .regressor import CPU_STRIDE, CPU_WORKERS, GPU_STRIDE, _to_device, _window_masks
from .settings import LatentSettings
from .voxel_grid import VoxelData, VoxelGrid

GPU_WORKERS = 1024
NODES = 17  # of the table of position features along an edge of the doubled voxel
MAX_FEATURE = 1e4  # above it half precision, which ends at 65,504, would lose sums
TEXTS_AT_ONCE = 64
CHANNELS_AT_ONCE = 32


class LatentMap(BaseMap):
    """A continuous field of feature vectors on the surface, fused from the feature image `name` of
    point clouds.

        features = LatentMap("clip", channels=512)
        features.integrate(cloud)                              # cloud.features["clip"]: ImageView, (h, w, 512)
        scores = features.similarity(mesh.vertices, texts)     # (V, n) cosines with texts (n, 512)

    A frame's features are never put on its points or pixels: a voxel takes sums over the few
    feature pixels that it sees. It keeps a mean and `encoder.rank` - 1 slopes, in the precision of
    the settings. Keywords are those of `LatentSettings`.
    """

    kind = "latent"
    settings_type = LatentSettings

    def __init__(
        self, name: str, channels: int, settings: LatentSettings | None = None, **overrides
    ) -> None:
        settings = dataclasses.replace(settings or LatentSettings(), **overrides)
        if channels < 1:
            raise InputError(f"latent map '{name}': channels must be at least 1, got {channels}")
        self.name, self.channels, self.settings = name, channels, settings
        # the mean stands for the first eigenpair, which is nearly constant
        self._rank = rank = settings.encoder.rank - 1
        self._grid = VoxelGrid(rank + rank * (rank + 1) // 2, 1)  # the moments, and weights
        self._cells = FrameBlocks(self._grid, 0, with_positions=True)
        self._rows = FeatureRows(rank, channels, settings.precision)
        encoding = position_encoding(settings.encoder)
        self._cell_features = _to_device(encoding(encoding.nodes(2 * CELLS))[:, 1:])
        axis = np.linspace(-0.5, 0.5, NODES)
        self._table = _to_device(
            encoding(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3))[
                :, 1:
            ]
        )
        self._window = ti.ndarray(ti.u32, (27, 2))
        self._window.from_numpy(_window_masks(settings.margin))
        self._neighbors = ti.ndarray(ti.i32, (1, 27))
        on_cpu = self._grid.runtime.device == "cpu"
        self._workers, self._stride = (
            (CPU_WORKERS, CPU_STRIDE) if on_cpu else (GPU_WORKERS, GPU_STRIDE)
        )
        self._scratch = self._shared_scratch()

    @classmethod
    def _restore(cls, name: str, channels: int, settings: LatentSettings) -> LatentMap:
        return cls(name, channels, settings)

    def _shared_scratch(self) -> tuple:
        """Scratch for the workers, one for all maps of a runtime: factors, places, feature tiles,
        and what a frame adds.
        """
        scratch = self._grid.runtime.scratch
        room = _whole(self.channels, kernels.CHANNELS)
        key = "latent", self._workers, self._rank, room
        if key not in scratch:
            scratch[key] = (
                ti.field(ti.f32, (self._workers, 1 + self._rank, kernels.ENTRIES)),
                ti.field(ti.i32, (self._workers, kernels.ENTRIES)),
                ti.field(ti.f32, (self._workers, kernels.CHANNELS, kernels.ENTRIES)),
                ti.field(ti.f32, (self._workers, 1 + self._rank, room)),
            )
        return scratch[key]

    @property
    def memory_bytes(self) -> int:
        """Bytes of the voxels and their index."""
        return self._grid.memory_bytes + len(self) * self._rows.bytes_per_voxel

    def integrate(self, cloud: PointCloud) -> Integration:
        """Fuse the features that a cloud's points see into the map; the cloud in world coordinates.

        Raises as `BaseMap.integrate`, and FrameError where no feature is finite; the map is then
        unchanged.
        """
        runtime.check_alive(self._grid.runtime)
        features = self._features_of(cloud)
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        image, usable = self._usable(features.values)
        blocks = self._cells
        blocks.touch(cloud.points, self.voxel_size)
        blocks.bin(cloud.points, [], self.voxel_size)
        blocks.compact(1)
        pixels, seen, weights = self._find_pixels(blocks, features, usable)
        if not seen.any():
            return Integration(len(cloud), 0, len(self))
        slots = np.empty(blocks.count, np.int32)
        encoded = self._grid.claim(blocks.count, blocks.keys, weights, slots)
        self._rows.reserve(self._grid.capacity, len(self))
        if blocks.count > self._neighbors.shape[0]:
            self._neighbors = ti.ndarray(ti.i32, (blocks.count * 5 // 4, 27))
        regression.find_neighbors(
            self._grid.stamp,
            self._grid.block,
            blocks.frame,
            blocks.count,
            blocks.keys,
            self._neighbors,
        )
        kernels.fuse_features(
            self._rank,
            self._rows.bits8,
            blocks.count,
            blocks.keys,
            slots,
            self._neighbors,
            blocks.masks,
            self._window,
            blocks.starts,
            blocks.cells,
            pixels,
            self._cell_features,
            image,
            float((seen > 0).sum() / seen.sum()),
            self._workers,
            self._stride,
            *self._scratch,
            *self._rows.pools,
            self._grid.latents,
            self._grid.weights,
        )
        return Integration(len(cloud), encoded, len(self))

    def remove(self, cloud: PointCloud) -> Integration:
        """Raises InputError: after rounding a frame cannot be taken out again without a trace."""
        raise InputError(
            f"latent map '{self.name}': frames cannot be taken out of a map of features; make it anew"
        )

    def _features_of(self, cloud: PointCloud) -> ImageView:
        features = cloud.features.get(self.name)
        if features is None:
            raise InputError(
                f"latent map '{self.name}': the cloud has no feature image '{self.name}', only "
                f"{', '.join(sorted(cloud.features)) or 'none'}"
            )
        if features.values.shape[2] != self.channels:
            raise InputError(
                f"latent map '{self.name}': expected {self.channels} channels, the feature image has "
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
        self, blocks: FrameBlocks, features: ImageView, usable: NDArray[np.uint8]
    ) -> tuple:
        """Feature pixel of every cell (M,), points in every pixel (h w,), and the blocks' points
        that have one (B,).
        """
        pixels, seen = np.empty(blocks.cells.shape[0], np.int32), np.zeros(len(usable), np.int32)
        weights = np.empty(blocks.count, np.float32)
        projection = (features.camera.matrix @ features.T_camera_cloud[:3]).astype(np.float32)
        kernels.find_pixels(
            blocks.count,
            blocks.keys,
            blocks.starts,
            blocks.masks,
            blocks.cells,
            self.voxel_size,
            projection,
            features.camera.width,
            usable,
            self.settings.min_points,
            pixels,
            seen,
            weights,
        )
        runtime.synchronize()
        return pixels, seen, weights

    def similarity(self, points: NDArray, text_embedding: NDArray, return_valid: bool = False):
        """Cosine (N, n) between the features at points (N, 3) world [m] and text embeddings (n, c);
        (N,) for a single (c,).

        Texts are multiplied onto the map first, so that a point costs n numbers, not c. The length
        of a feature is taken to be that of its voxel's mean. `return_valid` also gives where (N,) a
        voxel covers the point; elsewhere as `PropertyMap.query`. Raises InputError where the texts
        have another number of channels.
        """
        texts = np.ascontiguousarray(np.atleast_2d(text_embedding), dtype=np.float32)
        if texts.ndim != 2 or texts.shape[1] != self.channels:
            raise InputError(
                f"latent map '{self.name}': holds features of {self.channels} channels, the text embedding has "
                f"{texts.shape[-1]}; use the text encoder that belongs to the image features"
            )
        if not np.isfinite(texts).all() or not np.linalg.norm(texts, axis=1).all():
            raise InputError(f"latent map '{self.name}': a text embedding is zero or not finite")
        texts = texts / np.linalg.norm(texts, axis=1, keepdims=True)
        scores, valid, lengths = [], None, self._mean_lengths()
        for first in range(0, len(texts), TEXTS_AT_ONCE):
            part = texts[first : first + TEXTS_AT_ONCE]
            filled = np.zeros((_whole(len(part), decoding.DIRECTIONS), self.channels), np.float32)
            filled[: len(part)] = part
            products = self._solved(
                lambda out: decoding.project_rows(len(self), *self._rows.pools, filled, out),
                len(part),
            )
            values, valid = self._decode(
                points, products / np.maximum(lengths, 1e-12)[:, None, None]
            )
            scores.append(values[:, : len(part)])
        values = np.concatenate(scores, axis=1)
        values = values[:, 0] if np.ndim(text_embedding) == 1 else values
        return (values, valid) if return_valid else values

    def uncertainty(self, points: NDArray) -> NDArray[np.float32]:
        """Standard deviation (N,) of the product of a feature's direction at points (N, 3) world
        [m] with a unit vector.

        From how much of the length of unit features is left in their mean over w feature pixels:
        what agrees stays, white noise shrinks. Features that were not of unit length make it wrong.
        """
        n, lengths = len(self), self._mean_lengths()
        more = np.maximum(self._grid.weights.to_numpy()[:n], 1 + 1e-3)
        agreeing = np.clip((lengths**2 - 1 / more) / (1 - 1 / more), 1e-3, 1)
        products = np.zeros((max(n, 1), 1 + self._rank, decoding.DIRECTIONS), np.float32)
        products[:n, 0, 0] = np.sqrt((1 - agreeing) / (agreeing * self.channels * more))
        return self._decode(points, products)[0][:, 0]

    def query(self, points: NDArray, return_valid: bool = False):
        """Features (N, c) float32 at points (N, 3) world [m]; otherwise as `PropertyMap.query`."""
        values, valid = (
            np.zeros((len(points), self.channels), np.float32),
            np.zeros(len(points), bool),
        )
        for first in range(0, self.channels, CHANNELS_AT_ONCE):
            count = min(CHANNELS_AT_ONCE, self.channels - first)
            products = self._solved(
                lambda out: decoding.take_channels(len(self), *self._rows.pools, first, out), count
            )
            part, valid = self._decode(points, products)
            values[:, first : first + count] = part[:, :count]
        return (values, valid) if return_valid else values

    def _mean_lengths(self) -> NDArray[np.float32]:
        """Length (S,) of every voxel's mean."""
        lengths = np.ones(len(self), np.float32)
        if len(self):
            decoding.mean_lengths(len(self), self._rows.means, lengths)
        return lengths

    def _solved(self, fill, count: int) -> NDArray[np.float32]:
        """Constants and coefficients (S, 1 + q, count) of the fields whose products with the rows
        `fill` writes.

        The count is filled up to a multiple of DIRECTIONS.
        """
        runtime.check_alive(self._grid.runtime)
        products = np.zeros(
            (max(len(self), 1), 1 + self._rank, _whole(count, decoding.DIRECTIONS)), np.float32
        )
        if len(self):
            fill(products)
            decoding.solve_rows(
                self._rank,
                len(self),
                self._grid.latents,
                self._grid.weights,
                self.settings.noise,
                products,
            )
        return products

    def _decode(
        self, points: NDArray, products: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        points = np.ascontiguousarray(points, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"query: points must be (N, 3), got {points.shape}")
        values, valid = (
            np.zeros((len(points), products.shape[2]), np.float32),
            np.zeros(len(points), np.uint8),
        )
        if len(points) and len(self):
            decoding.query_products(
                self._rank,
                points,
                1.0 / self.voxel_size,
                self._grid.slot,
                products,
                self._table,
                NODES,
                NEAREST_REACH,
                values,
                valid,
            )
        return values, valid.astype(bool)

    def merge(self, other: LatentMap) -> None:
        """Fuse another map of the same settings into this one: exact, up to the rounding of what is
        kept.
        """
        self._check_mergeable(other)
        data, rows = other._grid.export(), other._export_rows()
        n = len(data.keys)
        if n:
            slots = np.empty(n, np.int32)
            self._grid.claim(n, data.keys, data.weights, slots)
            self._rows.reserve(self._grid.capacity, len(self))
            kernels.fuse_voxels(
                self._rank,
                self._rows.bits8,
                n,
                data.keys,
                slots,
                rows.means,
                rows.slopes,
                rows.scales,
                data.latents,
                data.weights,
                self._workers,
                self._stride,
                self._scratch[-1],
                *self._rows.pools,
                self._grid.latents,
                self._grid.weights,
            )

    def _export_rows(self) -> RowData:
        """In the order of `VoxelGrid.export`."""
        return self._rows.export(np.lexsort(self._grid.voxel_keys().T[::-1]).astype(np.int32))

    def _tensors(self) -> dict[str, NDArray]:
        return {**super()._tensors(), **vars(self._export_rows())}

    def _restore_tensors(self, path: str | Path, tensors: dict[str, NDArray]) -> None:
        data = VoxelData(*(tensors.get(key) for key in ("keys", "latents", "weights", "masks")))
        self._check_data(path, data)
        rows = RowData(*(tensors.get(key) for key in ("means", "slopes", "scales")))
        self._rows.check(path, len(data.keys), rows)
        if len(data.keys):
            slots = np.empty(len(data.keys), np.int32)
            self._grid.claim(len(data.keys), data.keys, data.weights, slots)
            fusion.fuse(
                self._grid.rows,
                1,
                0,
                len(slots),
                slots,
                data.latents,
                data.weights,
                data.masks,
                1.0,
                self._grid.latents,
                self._grid.weights,
                self._grid.masks,
            )
            self._rows.reserve(self._grid.capacity, len(self))
            self._rows.fill(slots, rows)

    def _observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        return cloud.points

    def _encode_cells(self, cloud: PointCloud) -> FrameBlocks:
        raise NotImplementedError

    _encode_points = _encode_cells


def _whole(count: int, step: int) -> int:
    """The next multiple of a step."""
    return -(-count // step) * step
