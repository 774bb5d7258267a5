"""What is asked of a map of features: the relevance of texts, and the best of a list of names, at
the vertices of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..maps.by_tiles import Features
from ..networks.encoders import TextEncoder
from ..types import Mesh
from .prompts import LOGIT_SCALE, TEMPLATES, competitors, embed, relevance
from .regions import MIN_AREA, THRESHOLD, Region, find_regions

UNLABELLED = -1
POINTS_AT_ONCE = 500_000
SURE = 2.0  # standard deviations of noise by which a query must win


@dataclass(frozen=True)
class Answer:
    """What a query found."""

    text: str
    # (V,) 0..1, 0 where the map has no voxel; 0.5 is a draw with the strongest rival
    relevance: NDArray[np.float32]
    similarity: NDArray[np.float32]  # (V,) cosine
    regions: tuple[Region, ...]  # the strongest first

    @property
    def found(self) -> bool:
        """Whether the query wins anywhere."""
        return bool(self.regions)


def ask(
    features: Features,
    mesh: Mesh,
    encoder: TextEncoder,
    texts: Sequence[str],
    *,
    negatives: Sequence[str] = (),
    threshold: float = THRESHOLD,
    min_area: float = MIN_AREA,
    templates: Sequence[str] = TEMPLATES,
) -> list[Answer]:
    """Answers to texts, each against its rivals (see `competitors`) at the vertices of a mesh.

    Raises InputError where the encoder's vectors do not fit the map, or has none for a text.
    """
    queries = embed(encoder, texts, templates)
    rivals, competes = competitors(encoder, queries, negatives, templates)
    both = np.concatenate([queries, rivals])
    distances = np.where(competes, np.linalg.norm(queries[:, None] - rivals[None], axis=2), np.inf)
    parts = [
        _scores(features, mesh.vertices[first : first + POINTS_AT_ONCE], both, distances)
        for first in range(0, max(len(mesh.vertices), 1), POINTS_AT_ONCE)
    ]
    similarity, scores, plain = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    regions = [
        find_regions(mesh, column, extent=extent, threshold=threshold, min_area=min_area)
        for column, extent in zip(scores.T, plain.T, strict=True)
    ]
    return [
        Answer(text, scores[:, i], similarity[:, i], tuple(regions[i]))
        for i, text in enumerate(texts)
    ]


def _scores(
    features: Features, points: NDArray, both: NDArray, distances: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Similarity, relevance and relevance without a margin (N, n) of n queries, which come before their
    m rivals in `both`, at `distances` (n, m).

    The margin: rivals' similarities are raised by SURE standard deviations of noise, so that a query
    must win clearly and rarely seen surface rarely matches.
    """
    similarity, known = features.similarity(points, both, return_valid=True)
    margin = SURE * features.uncertainty(points)[:, None]
    count, scores, plain = len(distances), [], []
    for i, away in enumerate(distances):
        rivals = np.flatnonzero(np.isfinite(away))
        others = similarity[:, count + rivals]
        raised = others + margin * away[rivals].astype(np.float32)
        for found, rival in ((scores, raised), (plain, others)):
            strongest = rival.max(axis=1)
            found.append(np.where(known, relevance(similarity[:, i], strongest), np.float32(0)))
    return similarity[:, :count], np.stack(scores, axis=1), np.stack(plain, axis=1)


@dataclass(frozen=True)
class Segmentation:
    """The best of a list of names everywhere."""

    names: tuple[str, ...]
    labels: NDArray[np.int32]  # (N,) row of names, UNLABELLED where the map has no voxel
    confidence: NDArray[np.float32]  # (N,) 0..1, softmax of the best


def segment(
    features: Features,
    points: NDArray,
    encoder: TextEncoder,
    names: Sequence[str],
    *,
    templates: Sequence[str] = TEMPLATES,
) -> Segmentation:
    """The best name at points (N, 3) world [m]; raises InputError for fewer than two names, or as
    `ask`.
    """
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"segment: needs at least two names, each once, got {', '.join(names) or 'none'}"
        )
    similarity, known = features.similarity(
        points, embed(encoder, names, templates), return_valid=True
    )
    labels = similarity.argmax(axis=1).astype(np.int32)
    best = np.take_along_axis(similarity, labels[:, None].astype(np.int64), axis=1)
    confidence = 1 / np.exp(LOGIT_SCALE * (similarity - best)).sum(axis=1)
    return Segmentation(
        tuple(names),
        np.where(known, labels, UNLABELLED),
        np.where(known, confidence, 0).astype(np.float32),
    )
