"""A map that follows its trajectory: drift is put into the poses of the house, a loop takes most of
it out again, and four maps are compared: drifted, followed, fused at the corrected poses, and fused at
the true poses.

    python benchmarks/loops.py --data ../shared/data --paths living --drifts 0.05
    python benchmarks/loops.py --data ../shared/data --paths tour --drifts tracked     what our own tracker drifts by
    python benchmarks/loops.py --cycles 1000            no data: a window goes and comes back so often
    python benchmarks/loops.py --cost 7scenes redkitchen --end 150    what following adds to mapping a video
    python benchmarks/loops.py --kept synthetic kitchen     what keeping and moving does to a map; bytes

Prints tables. Needs the extra open3d for the rate of double surfaces.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from house import PATHS, load_house
from numpy.typing import NDArray
from quality import DATA
from quality_scenes import DEPTH_RANGE, SCENES, Scene, house

import taichi_unifusion as uf
from taichi_unifusion.config import Config
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.evaluation import Viewpoints, evaluate_rendering, evaluate_surface
from taichi_unifusion.files.record_file import pack
from taichi_unifusion.geometry import se3
from taichi_unifusion.maps import BaseMap
from taichi_unifusion.maps.voxel_data import VoxelData
from taichi_unifusion.maps.window_store import WindowStore, to_record
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.tracking import TrackingSettings, make_tracker
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.types import Frame, Mesh

WIGGLE = 0.2  # of the drift, across its direction, that no loop knows of
TURN = np.radians(0.3) / 0.05  # [rad/m] of drift
BEHIND = 0.10  # [m] a second surface this near behind the first is a double one
SKIN = 0.004  # [m] behind a hit from where on the ray is looked at again
SHOWN = 100  # cycles between two looks at the maps
WARM = 25  # frames of a run that compiles
STRIDE = 4  # pixels between the rays that ask for double surfaces


@dataclass(frozen=True)
class Trajectories:
    """Poses (N, 4, 4) of the frames."""

    true: NDArray[np.float64]
    drifted: NDArray[np.float64]
    corrected: NDArray[np.float64]  # after the loop at the end: what it says is spread evenly


def with_drift(true: NDArray[np.float64], drift: float) -> Trajectories:
    """Poses that drift by so many metres until the last frame."""
    share = np.linspace(0, 1, len(true))
    along, across = np.array([0.8, 0.36, 0.48]), np.array([-0.6, 0.48, 0.64])
    wiggle = WIGGLE * np.sin(3 * np.pi * share)
    twist = np.zeros((len(true), 6))
    twist[:, :3] = drift * (share[:, None] * along + wiggle[:, None] * across)
    twist[:, 5] = TURN * drift * share
    at = np.tile(np.eye(4), (len(true), 1, 1))
    at[:, :3, 3] = true[:, :3, 3]  # turns are about the camera: else they would move it by metres
    error = at @ se3.exp(twist) @ se3.inverse(at)
    drifted = se3.normalized(error @ true)
    end = se3.log(se3.inverse(at[-1]) @ error[-1] @ at[-1])
    undone = at @ se3.exp(-share[:, None] * end) @ se3.inverse(at)
    return Trajectories(true, drifted, se3.normalized(undone @ drifted))


def tracked(path: str, data: Path, frames: Sequence[Frame]) -> Trajectories:
    """Poses that our tracker finds without loops, and with them, from all frames of a path."""
    recording = load_house(data / "aws-small-house", path)
    true = np.array([frame.require_pose() for frame in frames])
    found = []
    for loops in (False, True):
        tracker = RgbdTracker(TrackingSettings(loops=loops))
        for i in range(len(recording)):
            tracker.track(replace(recording[i], T_world_camera=None))
        tracker.finish()
        poses = tracker.current_poses().by_frame
        T = np.array([poses[frame.index] for frame in frames])
        found.append(se3.normalized(true[0] @ se3.inverse(T[0]) @ T))
    return Trajectories(true, *found)


def aligned(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Poses (N, 4, 4) after all frames were aligned to those before, held near where they are."""
    tracker = make_tracker("internal")
    for frame in frames:
        tracker.track(frame)
    tracker.finish()
    poses = tracker.current_poses().by_frame
    return np.array([poses[frame.index] for frame in frames])


def at_poses(frames: Sequence[Frame], poses: NDArray[np.float64]) -> list[Frame]:
    return [replace(frame, T_world_camera=T) for frame, T in zip(frames, poses, strict=True)]


@dataclass(frozen=True)
class Run:
    """A map, and what it took."""

    pipeline: Pipeline
    seconds: float  # of processor time
    details: dict[str, float]


def fuse(frames: Sequence[Frame], keep: WindowStore | None) -> Run:
    """Frames as they are."""
    pipeline = Pipeline(Config(), keep=keep)
    for frame in frames[:2]:  # the first compile
        pipeline.step(frame)
    started = time.process_time()  # of all threads, packing too: bears other work on the machine
    for frame in frames[2:]:
        pipeline.step(frame)
    pipeline.flush()
    if isinstance(keep, WindowStore):
        assert keep.nbytes  # waits for what is packed
    return Run(pipeline, time.process_time() - started, {})


def follow(run: Run, frames: Sequence[Frame], corrected: NDArray[np.float64]) -> Run:
    """The map after the loop, whose windows went where they belong."""
    follower, store = run.pipeline.follower, run.pipeline.fusion.keep
    assert follower is not None and isinstance(store, WindowStore)
    follower.follow({frame.index: T for frame, T in zip(frames, corrected, strict=True)})
    started = time.process_time()
    done = follower.finish(alone=True)
    spent = time.process_time() - started
    follower.settle()  # once more, for its time
    settled = time.process_time() - started - spent
    moving = (spent - settled) / max(done.moves + done.anew, 1)
    window = run.seconds / max(len(store), 1)
    details = {
        "windows": len(store),
        "moved": done.moved,
        "anew": done.anew,
        "ms_a_move": 1e3 * moving,
        "ms_a_window": 1e3 * window,
        "move_to_window": moving / window,
        "settle_to_window": settled / max(len(store), 1) / window,
        "total_to_without": (run.seconds + spent) / run.seconds,
        "kb_a_window": store.nbytes / max(len(store), 1) / 1e3,
    }
    return Run(run.pipeline, run.seconds + spent, details)


def double_rate(mesh: Mesh, frames: Sequence[Frame]) -> float:
    """Share of rays that meet a second surface within BEHIND of the first."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))
    double = hits = 0
    for frame in frames:
        T, camera = frame.require_pose(), frame.camera
        v, u = np.mgrid[0 : camera.height : STRIDE, 0 : camera.width : STRIDE].reshape(2, -1)
        rays = camera.rays(u, v)
        rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ T[:3, :3].T
        first = _cast(scene, np.broadcast_to(T[:3, 3], rays.shape), rays)
        hit = np.isfinite(first)
        inside = T[:3, 3] + rays[hit] * (first[hit, None] + SKIN)
        double += int((_cast(scene, inside, rays[hit]) < BEHIND - SKIN).sum())
        hits += int(hit.sum())
    return double / max(hits, 1)


def _cast(scene, origins: NDArray, rays: NDArray) -> NDArray[np.float32]:
    import open3d as o3d

    both = np.hstack([origins, rays]).astype(np.float32)
    return scene.cast_rays(o3d.core.Tensor(both))["t_hit"].numpy()


def measure(run: Run, scene: Scene, poses: NDArray, true: NDArray) -> dict[str, float | None]:
    """One row of the table."""
    mesh = run.pipeline.extract_mesh()
    near, far = DEPTH_RANGE
    views = Viewpoints(scene.frames[0].camera, true, near, far)
    assert scene.ground_truth is not None
    surface = evaluate_surface(mesh, scene.ground_truth, views=views)
    f1 = {score.threshold: score.f1 for score in surface.scores}
    color = run.pipeline.properties["color"].query
    seen = evaluate_rendering(mesh, scene.held_out, color=color, depth_min=near, depth_max=far)
    ate = np.sqrt(((poses[:, :3, 3] - true[:, :3, 3]) ** 2).sum(axis=1).mean())
    return {
        "ate_cm": 100 * float(ate),
        "f1_1cm": 100 * f1[0.01],
        "f1_2.5cm": 100 * f1[0.025],
        "l1_cm": seen.depth_l1_cm,
        "psnr_db": seen.psnr_db,
        "double_%": 100 * double_rate(mesh, scene.held_out),
        **run.details,
    }


def compare(
    scene: Scene, drift: str, poses: Trajectories, align: bool
) -> dict[str, dict[str, float | None]]:
    """The four maps of one path and drift; with `align` a fifth, moved to where frames fit each other."""
    frames = list(scene.frames)
    rows: dict[str, dict[str, float | None]] = {}

    def add(name: str, run: Run, at: NDArray) -> None:
        rows[name] = measure(run, scene, at, poses.true)
        cells = " | ".join(
            f"{key} {value:.3g}" for key, value in rows[name].items() if value is not None
        )
        print(f"{drift} | {name} | {cells}", flush=True)

    fuse(frames[:3], WindowStore())  # compiles
    drifted = fuse(at_poses(frames, poses.drifted), WindowStore())
    add("drifted", drifted, poses.drifted)
    add("followed", follow(drifted, frames, poses.corrected), poses.corrected)
    if align:
        better = aligned(at_poses(frames, poses.corrected))
        add("aligned and followed", follow(drifted, frames, better), better)
    del drifted
    add("from scratch", fuse(at_poses(frames, poses.corrected), None), poses.corrected)
    add("true poses", fuse(frames, None), poses.true)
    return rows


def cost(format: str, path: str, data: Path, end: int, drift: float) -> None:
    """What following adds to the time of mapping every frame of a video whose loop moves all of it: of windows
    that are fused at once, as while somebody watches, and of windows that wait for their final poses.
    """
    recording = uf.open_dataset(format, data / path)[:end]
    frames = [recording[i] for i in range(len(recording))]
    poses = with_drift(np.array([frame.require_pose() for frame in frames]), drift)
    at_once = at_poses(frames, poses.drifted)
    waiting = [replace(frame, apart=True) for frame in at_once]
    kinds = {
        "without keeping": (at_once, None, None),
        "fused at once, no loop": (at_once, WindowStore, None),
        "fused at once, a loop": (at_once, WindowStore, poses.corrected),
        "fused in the end, no loop": (waiting, WindowStore, poses.drifted),
        "fused in the end, a loop": (waiting, WindowStore, poses.corrected),
    }
    spent: dict[str, float] = {}
    for name, (given, store, final) in kinds.items():
        details: dict[str, float] = {}
        for part in (given[:WARM], given):  # the first compiles: kernels know the index of a map
            run = fuse(part, store and store())
            if final is not None:
                run = follow(run, part, final[: len(part)])
            spent[name], details = 1e3 * run.seconds / len(part), run.details
            del run  # another map takes its index over
        shares = {"ms_a_frame": spent[name], "to_without": spent[name] / spent["without keeping"]}
        cells = " | ".join(f"{key} {value:.3g}" for key, value in (shares | details).items())
        print(f"{len(frames)} frames | {name} | {cells}", flush=True)


def kept(scene: Scene) -> None:
    """A map as usual; one that keeps windows; with all votes cast anew, from small images; and with all
    windows moved off the lattice that they were summed up in, by 1.7 cm and a degree. Then bytes.
    """
    frames = list(scene.frames)
    T = se3.exp(np.array([0.01, -0.008, 0.011, 0.01, 0.012, -0.008]))
    fuse(frames[:3], WindowStore())  # compiles

    def add(name: str, run: Run, T_now: NDArray) -> None:
        mesh = run.pipeline.extract_mesh()
        colors = run.pipeline.properties["color"].query
        seen = evaluate_rendering(
            mesh.transformed(se3.inverse(T_now)),
            scene.held_out,
            color=lambda points: colors(points @ T_now[:3, :3].T + T_now[:3, 3]),
            depth_min=DEPTH_RANGE[0],
            depth_max=DEPTH_RANGE[1],
        )
        row = f"l1_cm {seen.depth_l1_cm:.3f} | coverage {seen.coverage:.4f} | psnr_db {seen.psnr_db:.2f}"
        if scene.ground_truth is not None:
            views = Viewpoints(frames[0].camera, scene.T_world_camera, *DEPTH_RANGE)
            truth = scene.ground_truth
            moved = mesh.transformed(se3.inverse(T_now))
            scores = evaluate_surface(moved, truth, views=views).scores
            row += "".join(
                f" | f1_{100 * each.threshold:g}cm {100 * each.f1:.2f}" for each in scores
            )
        print(
            f"{scene.name} | {name} | {row} | {1e3 * run.seconds / len(frames):.0f} ms", flush=True
        )

    add("usual", fuse(frames, None), np.eye(4))
    run = fuse(frames, WindowStore())
    add("kept", run, np.eye(4))
    follower = run.pipeline.follower
    assert follower is not None
    follower.settle()
    add("votes anew", run, np.eye(4))
    follower.move_to(
        {n: T @ each.T_world_keyframe for n, each in enumerate(follower.store.windows)}
    )
    follower.finish()
    add("moved", run, T)
    for size in sizes(follower.store):
        print(f"{scene.name} | {size}")


def sizes(store: WindowStore) -> list[str]:
    """Bytes of the first full window, compressed, by what they are of."""
    number = max(range(len(store)), key=lambda n: len(store.windows[n].frames))
    values, arrays = to_record(store[number])
    of: dict[str, int] = {}
    for name, array in arrays.items():
        what = name.partition(".")[0]
        of[what] = of.get(what, 0) + len(pack({}, {name: array}))
    names = {f"part{i}": " + ".join(part["names"]) for i, part in enumerate(values["parts"])}
    frames = len(store.windows[number].frames)
    parts = [f"{names.get(what, what)} {size / 1e3:.0f} kB" for what, size in of.items()]
    minute = sum(of.values()) / frames * 30 * 60 / 1e6
    return [f"a window of {frames} frames: {', '.join(parts)}; {minute:.0f} MB a minute at 30 Hz"]


def cycle(count: int) -> None:
    """Take a window out and put it back elsewhere and here again, `count` times."""
    room = SyntheticRoom(frames=120, width=80, height=60)
    pipeline = Pipeline(replace(Config(), window=5, voxel_size=0.1), keep=WindowStore())
    for i in range(10):
        pipeline.step(room[i])
    pipeline.flush()
    follower, store = pipeline.follower, pipeline.fusion.keep
    assert follower is not None and isinstance(store, WindowStore)
    before = {name: each.voxels() for name, each in pipeline.maps.items()}
    home = store.windows[1].T_world_keyframe
    there = se3.exp(np.array([0.02, -0.01, 0.015, 0.01, 0.0, -0.02])) @ home
    for done in range(1, count + 1):
        for place in (there, home):
            follower.move_to({1: place})
            follower.work(np.inf)
        if done % SHOWN == 0 or done == count:
            states = [
                f"{name} {'the same to the bit' if same(each, before[name]) else 'CHANGED'}"
                for name, each in pipeline.maps.items()
            ]
            print(f"after {done} cycles: {', '.join(states)}", flush=True)


def same(lim: BaseMap, before: VoxelData) -> bool:
    """Whether a map holds the very voxels that it held before."""
    now = lim.voxels()
    return len(now) == len(before) and all(
        np.array_equal(now.tensors[part], before.tensors[part])
        for part in ("keys", "latents", "weights", "masks")
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--paths", nargs="+", default=list(PATHS), choices=list(PATHS))
    parser.add_argument(
        "--drifts", nargs="+", default=["0.02", "0.05", "0.10"], metavar="METRES|tracked"
    )
    parser.add_argument(
        "--align", action="store_true", help="also align frames to each other after the loop"
    )
    parser.add_argument("--frames", type=int, help="about how many frames (default: every 5th)")
    parser.add_argument("--cycles", type=int, help="only move one window so often")
    parser.add_argument(
        "--cost", nargs=2, metavar=("FORMAT", "PATH"), help="only the time it takes"
    )
    parser.add_argument("--end", type=int, default=150, help="frames of --cost")
    parser.add_argument("--kept", nargs="+", choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--threads", type=int, help="CPU threads of Taichi (default: all)")
    parser.add_argument("--out", type=Path, help="file for the numbers, JSON")
    options = parser.parse_args()
    uf.init(threads=options.threads)
    if options.cycles:
        cycle(options.cycles)
        return 0
    if options.cost:
        cost(*options.cost, options.data, options.end, float(options.drifts[0]))
        return 0
    if options.kept:
        for name in options.kept:
            kept(SCENES[name](options.data, options.frames))
        return 0
    results = {}
    for path in options.paths:
        scene = house(path, options.data, options.frames)
        scene = replace(scene, frames=[scene.frames[i] for i in range(len(scene.frames))])
        for drift in options.drifts:
            poses = (
                tracked(path, options.data, scene.frames)
                if drift == "tracked"
                else with_drift(scene.T_world_camera, float(drift))
            )
            name = f"{path} {drift}"
            results[name] = compare(scene, name, poses, options.align)
            if options.out:
                options.out.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
