"""A map of image-text features against single frames and per-voxel averages, where the truth is
known: memory, speed, answers.

    python benchmarks/open_vocabulary.py house PATH/aws-small-house PATH/clip-text-embeddings --path living --every 12
    python benchmarks/open_vocabulary.py speed

Features are those of house_features.py: real CLIP text vectors of what is seen, 80 x 60 a frame,
blurred, with noise that makes a single frame right in about half of its pixels. The map is asked
with the same vectors at points of views that were not mapped. `speed` takes random features in the
synthetic room, and needs no data.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import feature_speed
import numpy as np
from house import PATHS, load_house
from house_features import NAMES, SINGLE_FRAME, HeldOut, HouseFeatures, find_noise, held_out_points
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.datasets.scene import SceneDataset
from taichi_unifusion.evaluation.segmentation import evaluate_segmentation
from taichi_unifusion.language.embeddings import TextEmbeddings, read_embeddings
from taichi_unifusion.language.questions import ask
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.results.tables import format_table
from taichi_unifusion.types import Mesh

AVERAGED = (0.2, 0.1, 0.07, 0.05)  # [m] voxels of the averages
DEPTH_MAX = 4.5  # [m] of the views that test points come from
PUBLISHED = "float32:20"  # precision and rank of the map that all others are compared with
COMPARED = 2000  # points at which whole features are compared
BASES = (32, 64, 128)  # directions of low-rank bases
# of walls, floors and doors: what else is there, no objects
STAND_INS = ("cornice", "doormat", "knocker")
MIN_POINTS = 30  # test points of an object that counts
MATCH = 0.25  # IoU of boxes above which a region is the object


class Averages:
    """The usual way: mean of all features that fell into a voxel, here of their products with the
    texts, which is the same.
    """

    def __init__(self, voxel_size: float) -> None:
        self.voxel_size, self.keys, self.sums = voxel_size, [], []

    def add(self, points: NDArray, products: NDArray) -> None:
        keys, place = np.unique(self._keys(points), return_inverse=True)
        sums = np.stack(
            [
                np.bincount(place, column, len(keys))
                for column in (*products.T, np.ones(len(points)))
            ],
            axis=1,
        )
        self.keys.append(keys)
        self.sums.append(sums.astype(np.float32))

    def labels(self, points: NDArray) -> NDArray[np.int64]:
        keys, place = np.unique(np.concatenate(self.keys), return_inverse=True)
        sums = np.zeros((len(keys), self.sums[0].shape[1]))
        np.add.at(sums, place, np.concatenate(self.sums))
        wanted = self._keys(points)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[at] == wanted, sums[at, :-1].argmax(axis=1), -1)

    def _keys(self, points: NDArray) -> NDArray[np.int64]:
        i, j, k = (np.floor(points / self.voxel_size).astype(np.int64) + (1 << 15)).T
        return (i << 32) + (j << 16) + k


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    house = commands.add_parser("house", help="memory and answers, where the truth is known")
    house.add_argument("house", type=Path, help="folder with house.glb and objects.json")
    house.add_argument("embeddings", type=Path, help="folder with LVIS's CLIP vectors")
    house.add_argument("--path", default="living", choices=PATHS)
    house.add_argument("--every", type=int, default=12)
    house.add_argument("--seed", type=int, default=0, help="of the features' noise")
    house.add_argument(
        "--right",
        type=float,
        default=SINGLE_FRAME,
        help="share of pixels in which a single frame is right",
    )
    house.add_argument(
        "--variants",
        nargs="*",
        default=["float16:5", "int8:6"],
        help="PRECISION:RANK of maps beside ours",
    )
    house.add_argument(
        "--out",
        type=Path,
        help="folder for the results of the run, to be asked by `unifusion query`",
    )
    house.set_defaults(run=run)
    feature_speed.add_options(commands.add_parser("speed", help="seconds a frame and a query"))
    options = parser.parse_args()
    options.run(options)


def run(options: argparse.Namespace) -> None:
    """Map the frames, then print all tables."""
    uf.init()
    frames = load_house(options.house, options.path)
    encoder = read_embeddings(
        options.embeddings / "lvis_v1_clip_a+cname.npy",
        names=options.embeddings / "lvis_v1_train_cat_info.json",
    )
    names = sorted(set(NAMES.values()))
    texts = encoder.text_features(names)
    rows = np.array([names.index(NAMES[name]) for name in frames.class_names])
    mapped = range(0, len(frames), options.every)
    clean = HouseFeatures(frames, texts, rows, 0.0, options.seed)
    features = clean.with_noise(find_noise(clean, mapped[::8], options.right), options.seed)
    print(
        f"{options.path}, {len(mapped)} frames, noise {features.noise:.3f} by coordinate: a single frame is right in "
        f"{features.right(mapped[::4]):.1%} of its pixels, without noise in {clean.right(mapped[::4]):.1%}\n",
        flush=True,
    )
    pipeline = uf.Pipeline(uf.Config(), encoder=features)
    loaded = [frames[index] for index in mapped]
    result = pipeline.run(loaded)
    variants = {name: make_map(name, texts.shape[1]) for name in (PUBLISHED, *options.variants)}
    averages = [Averages(voxel_size) for voxel_size in AVERAGED]
    for frame in loaded:
        frame = frame.with_features("features", features.image_features(frame))
        cloud = uf.preprocess(frame).transformed(frame.T_world_camera)
        for variant in variants.values():
            variant.integrate(cloud)
        for average in averages:
            average.add(cloud.points, seen_products(cloud, texts))
    test = held_out_points(
        frames, features, range(mapped.step // 2, len(frames), mapped.step * 2), DEPTH_MAX
    )
    known = pipeline.maps["features"].similarity(test.points, texts[0], return_valid=True)[1]
    test = HeldOut(test.points[known], test.labels[known], test.objects[known])
    print(
        table_of_answers(pipeline.maps["features"], averages, test, texts, names), "\n", flush=True
    )
    if options.out:
        from taichi_unifusion.results.writer import write_results

        write_results(options.out, pipeline, result)
    print(
        table_of_memory(pipeline.maps["features"], variants, test, texts, names), "\n", flush=True
    )
    print(
        table_of_queries(
            pipeline.maps["features"], pipeline.extract_mesh(), encoder, test, frames, names
        ),
        flush=True,
    )


def make_map(name: str, channels: int) -> FeatureMap:
    """An empty map of PRECISION:RANK."""
    precision, rank = name.split(":")
    return FeatureMap(
        "features", channels, encoder=EncoderSettings(rank=int(rank)), precision=precision
    )


def seen_products(cloud: uf.PointCloud, texts: NDArray) -> NDArray[np.float32]:
    """Products (N, n) of every point's own feature pixel with the texts."""
    image = cloud.features["features"]
    P = image.camera.matrix @ image.T_camera_cloud[:3]
    h = cloud.points @ P[:, :3].T + P[:, 3]
    u, v = np.rint(h[:, :2] / h[:, 2:]).astype(int).T
    return (image.values @ texts.T)[
        np.clip(v, 0, image.camera.height - 1), np.clip(u, 0, image.camera.width - 1)
    ]


def table_of_answers(
    features: FeatureMap, averages: list[Averages], test: HeldOut, texts: NDArray, names: list[str]
) -> str:
    """Accuracy and mean IoU of the best name at the test points."""
    methods = {
        f"map of features, {100 * features.voxel_size:g} cm": features.similarity(
            test.points, texts
        ).argmax(axis=1),
        **{
            f"averages, {100 * average.voxel_size:g} cm": average.labels(test.points)
            for average in averages
        },
    }
    rows = [[f"at {len(test.points):,} points", "accuracy %", "mean accuracy %", "mIoU %"]]
    for method, labels in methods.items():
        score = evaluate_segmentation(labels, test.labels, names=dict(enumerate(names)))
        values = score.overall_accuracy, score.mean_accuracy, score.mean_iou
        rows.append([method, *(f"{100 * value:.1f}" for value in values)])
    return format_table(rows)


def table_of_memory(
    ours: FeatureMap,
    variants: dict[str, FeatureMap],
    test: HeldOut,
    texts: NDArray,
    names: list[str],
) -> str:
    """Bytes, files and answers beside those of the map as published; and of ours in a basis of few
    directions.
    """
    channels, full = ours.channels, variants[PUBLISHED]
    points = test.points[:: max(len(test.points) // COMPARED, 1)]
    wanted, decoded = full.query(points), ours.query(points)
    header = [
        "a voxel keeps",
        "bytes",
        "of published",
        "MB",
        "file MB",
        "cosine mean",
        "cosine 1 %",
        "mIoU %",
    ]
    settings, table = ours.settings, []

    def add(name: str, size: float, stored: str, found: NDArray, scores: NDArray) -> None:
        cosines = (found * wanted).sum(axis=1) / (
            np.linalg.norm(found, axis=1) * np.linalg.norm(wanted, axis=1)
        )
        score = evaluate_segmentation(
            scores.argmax(axis=1), test.labels, names=dict(enumerate(names))
        )
        table.append(
            [
                name,
                f"{size:,.0f}",
                f"1/{full.settings.encoder.rank * channels * 4 / size:.1f}",
                f"{size * len(full) / 1e6:.1f}",
                stored,
                f"{cosines.mean():.4f}",
                f"{np.percentile(cosines, 1):.4f}",
                f"{100 * score.mean_iou:.1f}",
            ]
        )

    for variant in (*variants.values(), ours):
        rank, precision = variant.settings.encoder.rank, variant.settings.precision
        add(
            f"{rank} x {channels} {precision}{' (ours)' * (variant is ours)}",
            variant.memory_bytes / len(variant),
            f"{file_bytes(variant) / 1e6:.1f}",
            variant.query(points),
            variant.similarity(test.points, texts),
        )
    for k in BASES:
        basis, per_channel = strongest_directions(ours, k), ours.memory_bytes / len(ours) / channels
        projected = texts @ basis @ basis.T
        add(
            f"{settings.encoder.rank} x {k} {settings.precision}, basis of the means",
            per_channel * k + 4 * k * channels / len(ours),
            "-",
            decoded @ basis @ basis.T,
            ours.similarity(test.points, projected) * np.linalg.norm(projected, axis=1),
        )
    return (
        format_table([header, *table])
        + f"\n{len(ours):,} voxels; cosine with the features of the first"
    )


def strongest_directions(features: FeatureMap, k: int) -> NDArray[np.float32]:
    """(c, k) principal directions of the voxels' means by weight: what an online basis could at
    best have learned.
    """
    voxels = features.voxels()
    means, weights = voxels.fields["means"].astype(np.float32), voxels.weights
    return np.linalg.eigh((means * weights[:, None]).T @ means)[1][:, -k:].astype(np.float32)


def file_bytes(features: FeatureMap) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.safetensors"
        features.save(path)
        return path.stat().st_size


def table_of_queries(
    features: FeatureMap,
    mesh: Mesh,
    encoder: TextEmbeddings,
    test: HeldOut,
    frames: SceneDataset,
    names: list[str],
) -> str:
    """Every object's name is asked: which of its points answer, which others do, and whether a
    region's box is the object's.
    """
    asked = [
        name
        for i, name in enumerate(names)
        if name not in STAND_INS and (test.labels == i).sum() >= MIN_POINTS
    ]
    answers = {
        answer.text: answer for answer in ask(features, mesh, encoder, asked, negatives=STAND_INS)
    }
    absent = [
        name
        for i, name in enumerate(names)
        if name not in STAND_INS and not (test.labels == i).any()
    ]
    rows = [["query", "objects", "boxes found", "points found %", "points right %", "regions"]]
    at_points = {
        answer.text: answer
        for answer in ask(
            features,
            Mesh(test.points, np.empty((0, 3), np.int32)),
            encoder,
            asked,
            negatives=STAND_INS,
        )
    }
    boxes_found = boxes = 0
    for name in asked:
        true = test.labels == names.index(name)
        wins = at_points[name].relevance >= 0.5
        objects = [
            true_box
            for item in np.unique(test.objects[true])
            if (true_box := box_of(test.points[test.objects == item])) is not None
        ]
        hit = sum(
            any(box_iou(box, region.box) >= MATCH for region in answers[name].regions)
            for box in objects
        )
        boxes, boxes_found = boxes + len(objects), boxes_found + hit
        rows.append(
            [
                name,
                str(len(objects)),
                str(hit),
                f"{100 * wins[true].mean():.0f}",
                f"{100 * (wins & true).sum() / max(wins.sum(), 1):.0f}",
                str(len(answers[name].regions)),
            ]
        )
    quiet = [
        each
        for each in (ask(features, mesh, encoder, absent, negatives=STAND_INS) if absent else ())
        if not each.found
    ]
    return (
        format_table(rows)
        + f"\n{boxes_found} of {boxes} objects have a region with a box IoU of at least {MATCH}; "
        f"{len(quiet)} of {len(absent)} names of things that are not here find nothing"
    )


def box_of(points: NDArray) -> NDArray | None:
    """(2, 3) corners of an object's visible points; None for too few."""
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) >= MIN_POINTS else None


def box_iou(a: NDArray, b: NDArray, thickness: float = 0.05) -> float:
    """IoU of two boxes (2, 3), each at least `thickness` [m] thick."""
    a, b = (
        np.stack([box.mean(axis=0) - size / 2, box.mean(axis=0) + size / 2])
        for box in (a, b)
        for size in [np.maximum(box[1] - box[0], thickness)]
    )
    both = np.prod(np.maximum(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0))
    return float(both / (np.prod(a[1] - a[0]) + np.prod(b[1] - b[0]) - both))


if __name__ == "__main__":
    main()
