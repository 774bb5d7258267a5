"""The steps of `gpu.sh`: what must hold on a GPU that never ran this package, a step a command. The
last line that a step prints is its verdict; it exits with 1 where the check failed.

    python benchmarks/gpu_checks.py cuda                  # exits with 2 where there is no CUDA
    python benchmarks/gpu_checks.py start --device cuda   # versions, and how long compiling takes
    python benchmarks/gpu_checks.py keys --device cuda    # a map built 50 times is the same map
    python benchmarks/gpu_checks.py maps --device cuda    # the CPU makes the same maps
    python benchmarks/gpu_checks.py pool --device cuda    # too large a map is an error, not the end
    python benchmarks/gpu_checks.py table --device cuda   # milliseconds beside the paper's Table VIII
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.errors import CapacityError, RuntimeStateError, UniFusionError
from taichi_unifusion.maps import FeatureMap

BUILDS, LIVE = 50, 4  # maps of `keys`, and how many of them live at once: the others reuse trees
# Of `maps`. Normals differ by rounding, so that a pixel at the edge of a limit is a point on one device alone.
KEY_SHARE, SDF_MM, COLOR = 1e-3, 1.0, 0.01  # voxels of one map only; at 99.9 % of the vertices
POOL_GB, FAR, LONE_POINTS = 1.0, 200.0, 20_000  # of `pool`: [m], points that share no index node
FRAMES, CHANNELS, FEATURES = 12, 512, (45, 80)  # of `table`, at 1280 x 720
PAPER_MS = {"surface": 100, "color": 38, "infrared": 45, "latent": 11}  # Table VIII, an RTX 3090
GOAL_MS = 10  # for all of them together


def start(device: str) -> str:
    """Versions, and the seconds of the first kernel and frame, without and with a cache on disk."""
    print(f"Python {platform.python_version()}, NumPy {np.__version__}, {platform.platform()}")
    if device == "cuda" and shutil.which("nvidia-smi"):
        fields = "name,driver_version,memory.total,compute_cap"
        subprocess.run(
            ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"], check=False
        )
    with tempfile.TemporaryDirectory() as folder:
        # the driver keeps compiled code too
        os.environ |= {"TI_OFFLINE_CACHE_FILE_PATH": folder, "CUDA_CACHE_PATH": f"{folder}/driver"}
        cold, warm = (child("first", device) for _ in range(2))
    return f"without a cache: {cold}; with one: {warm}"


def first(device: str) -> str:
    """Seconds of starting, of a first small kernel and of a first frame with mesh."""
    begin = time.perf_counter()
    uf.init(device)
    import taichi as ti

    started = time.perf_counter()
    field = ti.field(ti.f32, 1000)
    field.fill(1.0)
    runtime.synchronize()
    filled = time.perf_counter()
    uf.warm_up()
    runtime.synchronize()
    done = time.perf_counter()
    return (
        f"start {started - begin:.1f} s, first kernel {filled - started:.1f} s, "
        f"first frame {done - filled:.1f} s"
    )


def keys(device: str) -> str:
    """Builds the same map again and again: its voxels must be the same every time."""
    live = uf.init(device)
    clouds = [uf.preprocess(f).transformed(f.T_world_camera) for f in small_room()[:3]]
    reference, worst, kept = None, 0.0, deque(maxlen=LIVE)
    for n in range(BUILDS):
        surface = uf.SurfaceMap()
        for cloud in clouds:
            surface.integrate(cloud)
        kept.append(surface)
        voxels = surface.voxels()
        reference = voxels if reference is None else reference
        if not np.array_equal(voxels.keys, reference.keys):
            raise AssertionError(
                f"build {n}: {len(voxels)} voxels instead of {len(reference)}, "
                f"{len(duplicates(voxels.keys))} of them twice"
            )
        if not np.array_equal(voxels.weights, reference.weights):
            raise AssertionError(f"build {n}: voxels have other weights")
        worst = max(worst, float(np.abs(voxels.latents - reference.latents).max()))
    return (
        f"{BUILDS} builds on {live.trees} index trees: the same {len(reference)} voxels and weights, "
        f"latents within {worst:.1e}"
    )


def duplicates(voxels: np.ndarray) -> np.ndarray:
    """The voxels (N, 3) that occur more than once."""
    unique, count = np.unique(voxels, axis=0, return_counts=True)
    return unique[count > 1]


def small_room() -> uf.Dataset:
    return uf.open_dataset("synthetic", frames=60, width=320, height=240)


def maps(device: str) -> str:
    """Makes the maps of one recording on the CPU and on the device, and compares them."""
    with tempfile.TemporaryDirectory() as folder:
        folders = [Path(folder) / "expected", Path(folder) / "found"]
        for each, out in zip(("cpu", device), folders, strict=True):
            child("build", each, folder, str(out))  # the first one also renders the frames
        uf.init("cpu")
        (surface, color), (other_surface, other_color) = (
            [uf.load_map(out / kind) for kind in ("surface", "color")] for out in folders
        )
        ours, theirs = (set(map(tuple, m.voxels().keys)) for m in (surface, other_surface))
        alone = len(ours ^ theirs) / len(ours)
        points = surface.extract_mesh(4).vertices
        sdf = 1e3 * np.abs(surface.sdf(points)[0] - other_surface.sdf(points)[0])
        hue = np.abs(color.query(points) - other_color.query(points)).max(axis=1)
    sdf_most, hue_most = np.percentile(sdf, 99.9), np.percentile(hue, 99.9)
    verdict = (
        f"CPU against {device}: {100 * alone:.3f} % of {len(ours)} voxels in one map only (at most "
        f"{100 * KEY_SHARE:g}); at 99.9 % of {len(points)} vertices distance within {sdf_most:.4f} mm "
        f"(at most {SDF_MM:g}), colour within {hue_most:.5f} (at most {COLOR:g})"
    )
    if alone > KEY_SHARE or not sdf_most <= SDF_MM or not hue_most <= COLOR:
        raise AssertionError(verdict)
    return verdict


def build(device: str, folder: str, out: str) -> str:
    """The maps of a few frames, which are rendered once."""
    uf.init(device)
    path = Path(folder) / "frames.npz"
    if not path.exists():
        frames = list(small_room()[:20:2])
        np.savez(
            path,
            depth=[frame.depth for frame in frames],
            color=[frame.color for frame in frames],
            T=[frame.T_world_camera for frame in frames],
        )
    camera, kept = small_room()[0].camera, np.load(path)
    pipeline = uf.Pipeline(uf.Config(device=device))
    for depth, color, T in zip(kept["depth"], kept["color"], kept["T"], strict=True):
        pipeline.step(uf.Frame(depth, camera, color, T))
    pipeline.flush()
    Path(out).mkdir()
    for name, each in pipeline.maps.items():
        each.save(Path(out) / name)
    return f"{len(kept['depth'])} frames"


def pool(device: str) -> str:
    """Fills the pool of sparse voxels, in a process of its own: a dead one is the failure."""
    return child("exhaust", device)


def exhaust(device: str) -> str:
    """Integrates points far from each other, until the map says that it is full."""
    uf.init(device, device_memory_gb=POOL_GB)
    color, rng = uf.PropertyMap("color", 3), np.random.default_rng(0)
    for n in range(1000):
        points = rng.uniform(-FAR, FAR, (LONE_POINTS, 3)).astype(np.float32)
        values = {"color": np.ones_like(points)}
        try:
            color.integrate(uf.PointCloud(points, None, values))
        except CapacityError:
            runtime.synchronize()
            near = rng.uniform(-0.5, 0.5, (1000, 3)).astype(np.float32)
            color.query(near)  # raises where the device's context is dead
            runtime.synchronize()
            return (
                f"CapacityError after {(n + 1) * LONE_POINTS:,} lone points, and queries still work"
            )
    raise AssertionError("no CapacityError")


class RandomFeatures:
    """An image encoder that plays."""

    name = "random"

    def __init__(self) -> None:
        self.values = np.random.default_rng(0).standard_normal((*FEATURES, CHANNELS), np.float32)

    def image_features(self, frame: uf.Frame) -> np.ndarray:
        return self.values


def table(device: str, count: int = FRAMES, size: tuple[int, int] = (1280, 720)) -> str:
    """Milliseconds of a frame by map, and of all maps together, beside those of the paper."""
    uf.init(device)
    width, height = size
    room = uf.open_dataset("synthetic", frames=60, width=width, height=height)
    frames = [with_infrared(frame) for frame in room[:count]]
    rows = {**by_map(frames), "all, Pipeline.step": all_together(frames)}
    print("| map | ms a frame | paper, ms |\n| --- | ---: | ---: |")
    for name, ms in rows.items():
        paper = sum(PAPER_MS.values()) if name.startswith("all") else PAPER_MS.get(name, "-")
        print(f"| {name} | {ms:.1f} | {paper} |")
    found = ", ".join(f"{name} {ms:.1f}" for name, ms in rows.items())
    return f"ms a frame of {width}x{height}: {found} (goal {GOAL_MS})"


def with_infrared(frame: uf.Frame) -> uf.Frame:
    return frame.with_image("infrared", np.float32(frame.color).mean(axis=2) * 257)


def by_map(frames: Sequence[uf.Frame]) -> dict[str, float]:
    """Milliseconds of a frame: preprocessing, and every map given the cloud."""
    features = RandomFeatures().values
    alone = {
        "surface": uf.SurfaceMap(),
        "color": uf.PropertyMap("color", 3),
        "infrared": uf.PropertyMap("infrared", 1, voxel_size=0.1),
        "latent": FeatureMap("latent", CHANNELS),
    }
    laps: dict[str, list[float]] = {name: [] for name in ("preprocess", *alone)}
    for frame in frames:
        ms, cloud = timed(uf.preprocess, frame.with_features("latent", features))
        laps["preprocess"].append(ms)
        cloud = cloud.transformed(frame.T_world_camera)
        for name, each in alone.items():
            laps[name].append(timed(each.integrate, cloud)[0])
    return {name: float(np.mean(lap[2:])) for name, lap in laps.items()}  # without compiling


def all_together(frames: Sequence[uf.Frame]) -> float:
    """Milliseconds of a frame for surface, colour, infrared and features in one pipeline; making
    the images of infrared and features is left out, as in the paper. The first frames compile.
    """
    config = uf.Config(properties=("infrared",))
    pipeline = uf.Pipeline(config, encoder=RandomFeatures(), synchronize=False)
    for frame in frames[:2]:
        pipeline.step(frame)
    pipeline.flush()
    total = 0.0
    for frame in frames[2:]:
        ms, step = timed(pipeline.step, frame)
        total += ms - sum(
            spent for stage, spent in step.milliseconds.items() if stage.endswith(" image")
        )
    return (total + timed(pipeline.flush)[0]) / (len(frames) - 2)


def timed(work: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Milliseconds by the clock, the device's work included, and what was returned."""
    runtime.synchronize()
    begin = time.perf_counter()
    result = work(*arguments)
    runtime.synchronize()
    return 1e3 * (time.perf_counter() - begin), result


def child(step: str, device: str, *arguments: str) -> str:
    """The verdict of a step in a process of its own; raises AssertionError with the end of what it
    wrote where that failed or died.
    """
    command = [sys.executable, __file__, step, *arguments, "--device", device]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise AssertionError(
            f"{step} on {device} ended with {done.returncode}: {(done.stderr + done.stdout).strip()[-2000:]}"
        )
    return done.stdout.strip().splitlines()[-1]


STEPS = {each.__name__: each for each in (start, first, keys, maps, build, pool, exhaust, table)}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=("cuda", *STEPS))
    parser.add_argument("arguments", nargs="*", help="of the steps that others start")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    options = parser.parse_args()
    if options.step == "cuda":
        try:
            print(uf.init("cuda").description)
        except RuntimeStateError as error:
            print(error)
            return 2
        return 0
    try:
        print(STEPS[options.step](options.device, *options.arguments))
    except (AssertionError, UniFusionError) as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
