"""Seconds of a map of features: integrating a frame, and asking it at many vertices;
`open_vocabulary.py speed`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.language import unit_length
from taichi_unifusion.language.embeddings import TextEmbeddings
from taichi_unifusion.language.questions import ask
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.results.tables import format_table
from taichi_unifusion.types import Mesh

FEATURES = 60, 80  # feature pixels of a frame
NAMES = 25  # texts of the encoder that plays: as many rivals has a query
REPEATS = 5  # of a query


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `speed`."""
    parser.add_argument("--channels", type=int, default=512)
    parser.add_argument(
        "--frames", type=int, default=24, help="of 640 x 480 pixels, around the synthetic room"
    )
    parser.add_argument("--vertices", type=int, default=500_000)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Integrate random features, then ask; print medians of wall and CPU seconds."""
    uf.init()
    rng = np.random.default_rng(0)
    clouds = []
    for frame in uf.open_dataset("synthetic", frames=options.frames):
        values = unit_length(rng.standard_normal((*FEATURES, options.channels), dtype=np.float32))
        cloud = uf.preprocess(frame.with_features("features", values))
        clouds.append(cloud.transformed(frame.T_world_camera))
    features = FeatureMap("features", options.channels)
    # the first compile
    steps = [seconds(lambda cloud=cloud: features.integrate(cloud)) for cloud in clouds][2:]
    points = np.resize(np.concatenate([cloud.points for cloud in clouds]), (options.vertices, 3))
    names = tuple(f"text {i}" for i in range(NAMES))
    encoder = TextEmbeddings(
        "random", names, unit_length(rng.standard_normal((NAMES, options.channels)))
    )
    texts, mesh = encoder.text_features(names), Mesh(points, np.empty((0, 3), np.int32))
    asked = {
        f"one text at {options.vertices:,} vertices": lambda: features.similarity(points, texts[0]),
        "the same as a query, against one rival and what names have in common": lambda: ask(
            features, mesh, encoder, names[:1], negatives=names[1:2]
        ),
        f"the same against {NAMES - 1} rivals": lambda: ask(
            features, mesh, encoder, names[:1], negatives=names[1:]
        ),
    }
    rows = [
        ["step", "wall s", "CPU s"],
        [
            f"integrate {options.channels} channels, a frame of {len(clouds[0]):,} points",
            *medians(steps),
        ],
    ]
    for name, work in asked.items():
        work()
        rows.append([name, *medians([seconds(work) for _ in range(REPEATS)])])
    print(
        format_table(rows)
        + f"\n{len(features):,} voxels, {features.memory_bytes / len(features):,.0f} bytes each"
    )


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Of the clock, and of the processor."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    runtime.synchronize()
    return time.perf_counter() - wall, time.process_time() - cpu


def medians(laps: list[tuple[float, float]]) -> list[str]:
    return [f"{median:.3f}" for median in np.median(laps, axis=0)]
