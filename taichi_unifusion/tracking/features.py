"""ORB features with depth: they recognise a place seen before and say roughly where the camera is
in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Frame, PinholeCamera

FEATURES = 800
LEAST_WIDTH = 320  # [px] smaller images are enlarged: a corner's surroundings are 31 pixels wide
RATIO = 0.8  # best against second-best distance of a match
REPROJECTION = 6.0  # [px] largest error of a match that supports a pose
MIN_MATCHES = 12  # that must support a pose
RANSAC_ITERATIONS = 300
# strongest features used to find similar keyframes: of the frame, and of each keyframe
QUERY_FEATURES, STORED_FEATURES = 200, 300


@dataclass(frozen=True, eq=False)
class Features:
    """Corners of a frame that have a depth, strongest first; pixels are those of the image, maybe
    enlarged, that they were found in.
    """

    descriptors: NDArray[np.uint8]  # (N, 32)
    pixels: NDArray[np.float32]  # (N, 2) u, v
    points: NDArray[np.float32]  # (N, 3) camera [m]
    camera: PinholeCamera  # of that image

    def __len__(self) -> int:
        return len(self.descriptors)


def extract_features(frame: Frame, depth_min: float, depth_max: float) -> Features:
    """ORB features of a frame at pixels with a reading in range; none where it has no colour."""
    scale = -(-LEAST_WIDTH // frame.camera.width)
    camera = frame.camera.resized(scale * frame.camera.width, scale * frame.camera.height)
    empty = Features(
        np.empty((0, 32), np.uint8),
        np.empty((0, 2), np.float32),
        np.empty((0, 3), np.float32),
        camera,
    )
    if frame.color is None:
        return empty
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    if scale > 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    corners, descriptors = cv2.ORB.create(FEATURES, fastThreshold=10).detectAndCompute(gray, None)
    if not corners:
        return empty
    pixels = np.array([corner.pt for corner in corners], np.float32)
    at = (
        np.rint((pixels + 0.5) / scale - 0.5)
        .astype(int)
        .clip(0, (frame.camera.width - 1, frame.camera.height - 1))
    )
    z = frame.depth[at[:, 1], at[:, 0]]
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(z) & (z >= depth_min) & (z <= depth_max)
    order = np.argsort([-corner.response for corner in corners], kind="stable")
    order = order[seen[order]]
    points = camera.rays(*pixels[order].T) * z[order, None]
    return Features(
        np.asarray(descriptors[order], np.uint8), pixels[order], points.astype(np.float32), camera
    )


def most_similar(query: Features, others: Sequence[Features], count: int) -> list[int]:
    """Numbers of the `count` of `others` in which most of the query's strongest features have their
    nearest neighbour.
    """
    sizes = [min(len(other), STORED_FEATURES) for other in others]
    if not len(query) or not sum(sizes):
        return []
    stacked = np.vstack([other.descriptors[:STORED_FEATURES] for other in others])
    owner = np.repeat(np.arange(len(others)), sizes)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING).match(query.descriptors[:QUERY_FEATURES], stacked)
    votes = np.bincount(owner[[match.trainIdx for match in matches]], minlength=len(others))
    best = np.argsort(-votes, kind="stable")[:count]
    return [int(k) for k in best if votes[k] > 0]


def locate(query: Features, other: Features) -> NDArray[np.float64] | None:
    """T_other_query from matched features by perspective-n-point RANSAC, or None where too few of
    them agree.
    """
    if min(len(query), len(other)) < MIN_MATCHES:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(query.descriptors, other.descriptors, k=2)
    good = [
        pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance
    ]
    if len(good) < MIN_MATCHES:
        return None
    points = np.array([other.points[match.trainIdx] for match in good], np.float64)
    pixels = np.array([query.pixels[match.queryIdx] for match in good], np.float64)
    cv2.setRNGSeed(0)  # the same frames give the same pose
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        query.camera.matrix,
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=REPROJECTION,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < MIN_MATCHES:
        return None
    T_query_other = np.eye(4)
    T_query_other[:3, :3], T_query_other[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    R = T_query_other[:3, :3]
    T_other_query = np.eye(4)
    T_other_query[:3, :3], T_other_query[:3, 3] = R.T, -R.T @ T_query_other[:3, 3]
    return T_other_query if np.isfinite(T_other_query).all() else None
