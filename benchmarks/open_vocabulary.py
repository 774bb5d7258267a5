"""A map of image-text features against single frames and per-voxel averages, where the truth is known: memory, speed, answers.

    python benchmarks/open_vocabulary.py PATH/aws-small-house PATH/clip-text-embeddings --path living --every 12

Features are those of house_features.py: real CLIP text vectors of what is seen, 80 x 60 a frame, blurred, with noise that makes
a single frame right in about half of its pixels. The map is asked with the same vectors at points of views that
were not mapped.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from house import PATHS, load_house
from house_features import NAMES, HeldOut, HouseFeatures, find_noise, held_out_points
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.datasets.scene import SceneDataset
from taichi_unifusion.encoding import EncoderSettings
from taichi_unifusion.evaluation.segmentation import evaluate_segmentation
from taichi_unifusion.language.embeddings import TextEmbeddings, read_embeddings
from taichi_unifusion.language.questions import ask
from taichi_unifusion.maps import LatentMap
from taichi_unifusion.run_log import RunResult
from taichi_unifusion.terminal import format_table
from taichi_unifusion.types import Mesh

AVERAGED = (0.2, 0.1, 0.07, 0.05)  # [m] voxels of the averages
DEPTH_MAX = 4.5              # [m] of the views that test points come from
FULL_RANK = 20               # eigenpairs of the map as published
COMPARED = 2000              # points at which whole features are compared
BASES = (32, 64, 128)        # directions of low-rank bases
STAND_INS = ("cornice", "doormat", "knocker")  # of walls, floors and doors: what else is there, no objects
MIN_POINTS = 30              # test points of an object that counts
MATCH = 0.25                 # IoU of boxes above which a region is the object
VERTICES = 500_000           # of the timed query


class Averages:
    """The usual way: mean of all features that fell into a voxel, here of their products with the texts, which is the same."""

    def __init__(self, voxel_size: float) -> None:
        self.voxel_size, self.keys, self.sums = voxel_size, [], []

    def add(self, points: NDArray, products: NDArray) -> None:
        keys, place = np.unique(self._keys(points), return_inverse=True)
        sums = np.stack([np.bincount(place, column, len(keys)) for column in (*products.T, np.ones(len(points)))], axis=1)
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house", type=Path, help="folder with house.glb and objects.json")
    parser.add_argument("embeddings", type=Path, help="folder with LVIS's CLIP vectors")
    parser.add_argument("--path", default="living", choices=PATHS)
    parser.add_argument("--every", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0, help="of the features' noise")
    parser.add_argument("--out", type=Path, help="folder for the results of the run, to be asked by `unifusion query`")
    run(parser.parse_args())


def run(options: argparse.Namespace) -> None:
    """Map the frames, then print all tables."""
    uf.init()
    frames = load_house(options.house, options.path)
    encoder = read_embeddings(options.embeddings / "lvis_v1_clip_a+cname.npy",
                              names=options.embeddings / "lvis_v1_train_cat_info.json")
    names = sorted(set(NAMES.values()))
    texts = encoder.text_features(names)
    rows = np.array([names.index(NAMES[name]) for name in frames.class_names])
    mapped = range(0, len(frames), options.every)
    clean = HouseFeatures(frames, texts, rows, 0.0, options.seed)
    features = clean.with_noise(find_noise(clean, mapped[::8]), options.seed)
    print(f"{options.path}, {len(mapped)} frames, noise {features.noise:.3f} by coordinate: a single frame is right in "
          f"{features.right(mapped[::4]):.1%} of its pixels, without noise in {clean.right(mapped[::4]):.1%}\n", flush=True)
    pipeline = uf.Pipeline(uf.Config(), encoder=features)
    loaded = [frames[index] for index in mapped]
    result = pipeline.run(loaded)
    full = LatentMap("features", texts.shape[1], encoder=EncoderSettings(rank=FULL_RANK))
    averages, again, cpu_seconds = [Averages(voxel_size) for voxel_size in AVERAGED], LatentMap("features", texts.shape[1]), []
    for frame in loaded:
        frame = frame.with_features("features", features.image_features(frame))
        cloud = uf.preprocess(frame).transformed(frame.T_world_camera)
        full.integrate(cloud)
        started = time.process_time()
        again.integrate(cloud)
        runtime.synchronize()
        cpu_seconds.append(time.process_time() - started)
        for average in averages:
            average.add(cloud.points, seen_products(cloud, texts))
    test = held_out_points(frames, features, range(mapped.step // 2, len(frames), mapped.step * 2), DEPTH_MAX)
    known = pipeline.features.similarity(test.points, texts[0], return_valid=True)[1]
    test = HeldOut(test.points[known], test.labels[known], test.objects[known])
    print(table_of_answers(pipeline.features, averages, test, texts, names), "\n", flush=True)
    if options.out:
        from taichi_unifusion.results import write_results

        write_results(options.out, pipeline, result)
    print(table_of_memory(pipeline.features, full, test, texts, names), "\n", flush=True)
    mesh = pipeline.extract_mesh()
    print(table_of_speed(result, cpu_seconds, pipeline.features, mesh, encoder), "\n", flush=True)
    print(table_of_queries(pipeline.features, mesh, encoder, test, frames, names), flush=True)


def seen_products(cloud: uf.PointCloud, texts: NDArray) -> NDArray[np.float32]:
    """Products (N, n) of every point's own feature pixel with the texts."""
    image = cloud.features["features"]
    P = image.camera.matrix @ image.T_camera_cloud[:3]
    h = cloud.points @ P[:, :3].T + P[:, 3]
    u, v = np.rint(h[:, :2] / h[:, 2:]).astype(int).T
    return (image.values @ texts.T)[np.clip(v, 0, image.camera.height - 1), np.clip(u, 0, image.camera.width - 1)]


def table_of_answers(features: LatentMap, averages: list[Averages], test: HeldOut, texts: NDArray, names: list[str]) -> str:
    """Accuracy and mean IoU of the best name at the test points."""
    methods = {f"map of features, {100 * features.voxel_size:g} cm": features.similarity(test.points, texts).argmax(axis=1),
               **{f"averages, {100 * average.voxel_size:g} cm": average.labels(test.points) for average in averages}}
    rows = [[f"at {len(test.points):,} points", "accuracy %", "mean accuracy %", "mIoU %"]]
    for method, labels in methods.items():
        score = evaluate_segmentation(labels, test.labels, names=dict(enumerate(names)))
        values = score.overall_accuracy, score.mean_accuracy, score.mean_iou
        rows.append([method, *(f"{100 * value:.1f}" for value in values)])
    return format_table(rows)


def table_of_memory(features: LatentMap, full: LatentMap, test: HeldOut, texts: NDArray, names: list[str]) -> str:
    """Bytes, files and answers beside those of all eigenpairs, and of the same rows in a low-rank basis."""
    channels = features.channels
    step = max(len(test.points) // COMPARED, 1)
    wanted = full.query(test.points[::step])
    rows = [["map", "bytes a voxel", "of published", "MB", "file MB", "cosine mean", "cosine 1 %", "mIoU %"],
            [f"as published: {FULL_RANK} x {channels} float32", f"{FULL_RANK * channels * 4:,}", "1", "", "", "", "", ""]]
    variants = {f"{FULL_RANK} x {channels} float16": (full, full.memory_bytes),
                f"{features.settings.encoder.rank} x {channels} float16 (ours)": (features, features.memory_bytes)}
    for k in BASES:
        smaller = len(features) * features.settings.encoder.rank * (channels - k) * 2
        variants[f"{features.settings.encoder.rank} x {k}, basis of the means"] = (
            in_basis(features, k), features.memory_bytes - smaller + 4 * k * channels)
    for name, (variant, size) in variants.items():
        found = variant.query(test.points[::step])
        cosines = (found * wanted).sum(axis=1) / (np.linalg.norm(found, axis=1) * np.linalg.norm(wanted, axis=1))
        labels = variant.similarity(test.points, texts).argmax(axis=1)
        score = evaluate_segmentation(labels, test.labels, names=dict(enumerate(names)))
        stored = file_bytes(variant) if "basis" not in name else 0
        rows.append([name, f"{size / len(variant):,.0f}", f"1/{FULL_RANK * channels * 4 * len(variant) / size:.1f}",
                     f"{size / 1e6:.1f}", f"{stored / 1e6:.1f}" if stored else "-", f"{cosines.mean():.4f}",
                     f"{np.percentile(cosines, 1):.4f}", f"{100 * score.mean_iou:.1f}"])
    return format_table(rows) + f"\n{len(features):,} voxels; cosine with the {FULL_RANK} x {channels} map's features"


def in_basis(features: LatentMap, k: int) -> LatentMap:
    """The map with its rows projected onto the k strongest directions of its voxels' means, weighted."""
    data, rows = features._grid.export(), features._export_rows()
    means = rows[:, 0].astype(np.float32)
    basis = np.linalg.eigh((means * data.weights[:, None]).T @ means)[1][:, -k:].astype(np.float32)
    projected = LatentMap(features.name, features.channels, features.settings)
    projected._fuse_voxels(data, ((rows.astype(np.float32) @ basis) @ basis.T).astype(np.float16))
    return projected


def file_bytes(features: LatentMap) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.safetensors"
        features.save(path)
        return path.stat().st_size


def table_of_speed(result: RunResult, cpu_seconds: list[float], features: LatentMap, mesh: Mesh,
                   encoder: TextEmbeddings) -> str:
    """Milliseconds a frame of the features' part, and of queries at many vertices; the first, which compiles, left out."""
    times = [step.milliseconds["features"] for step in result.steps[1:]]
    points = np.resize(mesh.vertices, (VERTICES, 3))
    many = Mesh(points, np.empty((0, 3), np.int32))
    text = encoder.text_features(["sofa"])
    rows = [["step", "wall s", "CPU s"],
            [f"integrate {features.channels} channels, median of {len(times)} frames", f"{np.median(times) / 1e3:.3f}",
             f"{np.median(cpu_seconds[1:]):.3f}"]]
    for name, work in {f"similarity of 1 text at {VERTICES:,} vertices": lambda: features.similarity(points, text),
                       "the same with all its rivals and regions": lambda: ask(features, many, encoder, ["sofa"])}.items():
        work()
        walls, cpus = [], []
        for _ in range(5):
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            walls.append(time.perf_counter() - wall)
            cpus.append(time.process_time() - cpu)
        rows.append([name, f"{np.median(walls):.2f}", f"{np.median(cpus):.2f}"])
    return format_table(rows)


def table_of_queries(features: LatentMap, mesh: Mesh, encoder: TextEmbeddings, test: HeldOut, frames: SceneDataset,
                     names: list[str]) -> str:
    """Every object's name is asked: which of its points answer, which others do, and whether a region's box is the object's."""
    asked = [name for i, name in enumerate(names) if name not in STAND_INS and (test.labels == i).sum() >= MIN_POINTS]
    answers = {answer.text: answer for answer in ask(features, mesh, encoder, asked, negatives=STAND_INS)}
    absent = [name for i, name in enumerate(names) if name not in STAND_INS and not (test.labels == i).any()]
    rows = [["query", "objects", "boxes found", "points found %", "points right %", "regions"]]
    at_points = {answer.text: answer for answer in ask(features, Mesh(test.points, np.empty((0, 3), np.int32)), encoder, asked,
                                                          negatives=STAND_INS)}
    boxes_found = boxes = 0
    for name in asked:
        true = test.labels == names.index(name)
        wins = at_points[name].relevance >= 0.5
        objects = [true_box for item in np.unique(test.objects[true])
                   if (true_box := box_of(test.points[test.objects == item])) is not None]
        hit = sum(any(box_iou(box, region.box) >= MATCH for region in answers[name].regions) for box in objects)
        boxes, boxes_found = boxes + len(objects), boxes_found + hit
        rows.append([name, str(len(objects)), str(hit), f"{100 * wins[true].mean():.0f}",
                     f"{100 * (wins & true).sum() / max(wins.sum(), 1):.0f}", str(len(answers[name].regions))])
    quiet = [each for each in (ask(features, mesh, encoder, absent, negatives=STAND_INS) if absent else ()) if not each.found]
    return (format_table(rows) + f"\n{boxes_found} of {boxes} objects have a region with a box IoU of at least {MATCH}; "
            f"{len(quiet)} of {len(absent)} names of things that are not here find nothing")


def box_of(points: NDArray) -> NDArray | None:
    """(2, 3) corners of an object's visible points; None for too few."""
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) >= MIN_POINTS else None


def box_iou(a: NDArray, b: NDArray, thickness: float = 0.05) -> float:
    """IoU of two boxes (2, 3), each at least `thickness` [m] thick."""
    a, b = (np.stack([box.mean(axis=0) - size / 2, box.mean(axis=0) + size / 2])
            for box in (a, b) for size in [np.maximum(box[1] - box[0], thickness)])
    both = np.prod(np.maximum(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0))
    return float(both / (np.prod(a[1] - a[0]) + np.prod(b[1] - b[0]) - both))


if __name__ == "__main__":
    main()
