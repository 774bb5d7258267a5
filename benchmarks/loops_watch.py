"""What somebody sees who watches a map while a loop closes: the map just before its windows move, and
just after, from where it changed most.

    python benchmarks/loops_watch.py PATH/7scenes-redkitchen --end 300 --every 2 --picture docs/loops-kitchen.jpg

Prints a row whenever the tracker moves earlier frames; the picture is of the largest move.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.config import Config
from taichi_unifusion.datasets import Dataset
from taichi_unifusion.geometry import se3
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.rendering.drawing import Drawable, Viewpoint
from taichi_unifusion.tracking import CurrentPoses, make_tracker
from taichi_unifusion.tracking.online import OnlineFrames
from taichi_unifusion.types import Mesh, PinholeCamera

CANDIDATES = 24  # cameras of the recording from which the two maps are compared
SMALL, LARGE = (
    (120, 90),
    (480, 360),
)  # pixels of an image that is compared, and of one that is shown
FOCAL = 0.82  # of the width
NEAR = 0.3  # [m]
CHANGED = 0.01  # [m] of depth from which on a pixel counts as changed
LEAST = 0.01  # [m] of a move of which a picture is made


@dataclass
class Watched:
    """The largest move so far."""

    farthest: float = LEAST  # [m] that a window moved
    before: Mesh | None = None
    after: Mesh | None = None
    poses: list[NDArray[np.float64]] = field(default_factory=list)  # of cameras at that moment


def watch(frames: Dataset, every: int) -> Watched:
    """Track and map frames in one pass, and keep the meshes around the largest move."""
    tracker, seen = make_tracker("rgbd"), Watched()
    pipeline = Pipeline(Config(), keep=WindowStore())
    follower = pipeline.follower
    assert follower is not None

    def on_moved(now: CurrentPoses) -> None:
        pipeline.fusion.close()
        pipeline.flush()
        places = [each.place for each in follower.store.windows]
        mesh = pipeline.extract_mesh()
        follower.follow(now.by_frame)
        moved = follower.work(np.inf)
        shifts = [
            100 * se3.distance(a, each.place)[0]
            for a, each in zip(places, follower.store.windows, strict=True)
            if a is not None and each.place is not None
        ]
        far = max(shifts, default=0.0)
        print(
            f"after {len(now.by_frame):4d} frames: {moved:2d} of {len(places):2d} windows moved, by up to {far:.2f} cm",
            flush=True,
        )
        if far > 100 * seen.farthest:
            seen.farthest, seen.before, seen.after = far / 100, mesh, pipeline.extract_mesh()
            seen.poses = list(now.by_frame.values())

    pipeline.run(OnlineFrames(frames, tracker, every, on_moved))
    return seen


def camera_of(size: tuple[int, int]) -> PinholeCamera:
    """A camera for pictures."""
    width, height = size
    focal = FOCAL * width
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def where_it_changed(
    before: Drawable, after: Drawable, poses: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The camera from which most of the surface lies elsewhere than before."""
    rows = np.linspace(0, len(poses) - 1, min(CANDIDATES, len(poses))).astype(int)
    shares = []
    for row in rows:
        view = Viewpoint(camera_of(SMALL), poses[row], NEAR)
        depths = [each.depth_buffer(view).depth(nothing=0.0) for each in (before, after)]
        both = (depths[0] > 0) & (depths[1] > 0)
        shares.append(float((np.abs(depths[0] - depths[1])[both] > CHANGED).sum()))
    return poses[rows[int(np.argmax(shares))]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=Path, help="a recording in 7-Scenes' format")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--end", type=int, default=300)
    parser.add_argument("--every", type=int, default=1, help="frames that are tracked")
    parser.add_argument("--map-every", type=int, default=1, help="tracked frames that are mapped")
    parser.add_argument("--picture", type=Path, required=True, help="JPG file")
    options = parser.parse_args()
    uf.init("cpu")
    part = slice(options.start, options.end, options.every)
    seen = watch(uf.open_dataset("7scenes", options.path)[part], options.map_every)
    if seen.before is None or seen.after is None:
        print(f"no window moved by more than {100 * LEAST:g} cm: no picture")
        return
    before, after = Drawable.of(seen.before), Drawable.of(seen.after)
    view = Viewpoint(camera_of(LARGE), where_it_changed(before, after, seen.poses), NEAR)
    panels = [before.draw(view), np.full((LARGE[1], 6, 3), 255, np.uint8), after.draw(view)]
    image = cv2.cvtColor(np.hstack(panels), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(options.picture), image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    print(f"{options.picture}: a move of {100 * seen.farthest:.1f} cm")


if __name__ == "__main__":
    main()
