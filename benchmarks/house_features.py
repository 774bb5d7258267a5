"""Features of the rendered house that are right and noisy by design, and points on its surface with
their true names.

A pixel's feature is the real CLIP text vector of the class seen there, averaged over a feature
pixel and its neighbours, so that borders are blurred, plus white noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.datasets.scene import SceneDataset
from taichi_unifusion.language import unit_length

FEATURE_PIXEL = 8  # depth pixels along the edge of a feature pixel
BLUR = 1.0  # [feature pixels] standard deviation
SINGLE_FRAME = 0.5  # accuracy that the noise is made for, if nothing else is asked
THIN = 0.03  # [m] one test point in a cube of this edge
# class of the house -> its nearest name in LVIS, which has none for walls, floors and doors: these
# take stand-ins
NAMES = {
    "AirconditionerA": "air conditioner",
    "AirconditionerB": "air conditioner",
    "BalconyTable": "table",
    "Bed": "bed",
    "Board": "blackboard",
    "Carpet": "runner",
    "ChairA": "chair",
    "ChairD": "chair",
    "Chandelier": "chandelier",
    "CoffeeTable": "coffee table",
    "CookingBench": "stove",
    "Curtain": "curtain",
    "Dumbbell": "dumbbell",
    "DeskPortraitA": "painting",
    "DeskPortraitB": "painting",
    "DeskPortraitC": "painting",
    "DeskPortraitD": "painting",
    "Door": "knocker",
    "FitnessEquipment": "barbell",
    "FloorB": "doormat",
    "FoldingDoor": "knocker",
    "Handle": "doorknob",
    "HouseWallB": "cornice",
    "KitchenCabinet": "cupboard",
    "KitchenTable": "kitchen table",
    "KitchenUtensils": "cooking utensil",
    "LightC": "lamp",
    "NightStand": "drawer",
    "PortraitA": "painting",
    "PortraitB": "painting",
    "PortraitC": "painting",
    "PortraitD": "painting",
    "PortraitE": "painting",
    "Rangehood": "vent",
    "ReadingDesk": "desk",
    "Refrigerator": "refrigerator",
    "RoomWall": "cornice",
    "RoomWindow": "window box",
    "SeasoningBox": "condiment",
    "SecurityCamera": "webcam",
    "ShoeRack": "shoe",
    "SofaC": "sofa",
    "TV": "television set",
    "TVCabinet": "cabinet",
    "Tablet": "monitor (computer equipment) computer monitor",
    "Tableware": "dish",
    "Trash": "trash can",
    "Vase": "vase",
    "Wardrobe": "wardrobe",
}


@cache
def rendered_labels(
    frames: SceneDataset, index: int
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Classes and objects (H, W) of a frame; rendering costs more than keeping them."""
    classes, objects = frames.labels(index)
    return classes.astype(np.int16), objects.astype(np.int16)


class HouseFeatures:
    """An image encoder that knows what it sees, and forgets half of it: see above."""

    def __init__(
        self,
        frames: SceneDataset,
        texts: NDArray[np.float32],
        name_of_class: NDArray[np.int64],
        noise: float,
        seed: int,
    ) -> None:
        self.name = "house"
        self.frames, self.texts, self.name_of_class, self.noise, self.seed = (
            frames,
            texts,
            name_of_class,
            noise,
            seed,
        )

    def with_noise(self, noise: float, seed: int) -> HouseFeatures:
        """The same with another noise."""
        return HouseFeatures(self.frames, self.texts, self.name_of_class, noise, seed)

    def labels(self, index: int) -> NDArray[np.int64]:
        """Row of the name (H, W) at every pixel, -1 where nothing is."""
        classes = rendered_labels(self.frames, index)[0]
        return np.where(classes >= 0, self.name_of_class[classes], -1)

    def image_features(self, frame: uf.Frame) -> NDArray[np.float32]:
        """(60, 80, c), unit length."""
        labels = self.labels(frame.index)
        height, width = (side // FEATURE_PIXEL for side in labels.shape)
        mixture = np.zeros((height, width, len(self.texts)), np.float32)
        for name in np.unique(labels[labels >= 0]):
            share = (labels == name).astype(np.float32)
            share = share.reshape(height, FEATURE_PIXEL, width, FEATURE_PIXEL).mean(axis=(1, 3))
            mixture[..., name] = cv2.GaussianBlur(share, (0, 0), BLUR)
        mixture /= np.maximum(mixture.sum(axis=2, keepdims=True), 1e-6)
        rng = np.random.default_rng((self.seed, frame.index))
        clean = mixture @ self.texts
        return unit_length(clean + self.noise * rng.standard_normal(clean.shape, dtype=np.float32))

    def right(self, indices: range) -> float:
        """Share of pixels whose own feature is nearest to their class."""
        shares = []
        for index in indices:
            labels = self.labels(index)
            frame = uf.Frame(np.zeros(labels.shape, np.float32), self.frames.camera, index=index)
            best = (self.image_features(frame) @ self.texts.T).argmax(axis=2)
            best = best.repeat(FEATURE_PIXEL, axis=0).repeat(FEATURE_PIXEL, axis=1)
            shares.append((best == labels)[labels >= 0].mean())
        return float(np.mean(shares))


def find_noise(features: HouseFeatures, indices: range, wanted: float = SINGLE_FRAME) -> float:
    """The noise, by coordinate, at which a single frame is right in a share `wanted` of its pixels;
    of a seed of its own.
    """
    low, high = 0.0, 1.0
    for _ in range(7):
        middle = (low + high) / 2
        right = features.with_noise(middle, seed=12345).right(indices)
        low, high = (middle, high) if right > wanted else (low, middle)
    return (low + high) / 2


@dataclass(frozen=True)
class HeldOut:
    """Points on exact surfaces of views that were not mapped."""

    points: NDArray[np.float32]  # (N, 3) world [m]
    labels: NDArray[np.int64]  # (N,) row of the name
    objects: NDArray[np.int64]  # (N,) row of frames.scene.object_names


def held_out_points(
    frames: SceneDataset, features: HouseFeatures, indices: range, depth_max: float
) -> HeldOut:
    """One in every cube of THIN, of what the views `indices` see within `depth_max` [m]."""
    rays = frames.camera.rays()
    found = np.empty((0, 5))
    for index in indices:
        depth, labels, objects = (
            frames.exact_depth(index),
            features.labels(index),
            rendered_labels(frames, index)[1],
        )
        kept = (depth > 0.4) & (depth < depth_max) & (labels >= 0)
        T = frames.T_world_camera[index]
        points = (rays[kept] * depth[kept][:, None]) @ T[:3, :3].T + T[:3, 3]
        found = np.concatenate([found, np.column_stack([points, labels[kept], objects[kept]])])
        found = found[
            np.unique(np.floor(found[:, :3] / THIN).astype(np.int64), axis=0, return_index=True)[1]
        ]
    return HeldOut(
        found[:, :3].astype(np.float32), found[:, 3].astype(np.int64), found[:, 4].astype(np.int64)
    )
