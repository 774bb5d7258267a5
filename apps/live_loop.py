"""Map what a RealSense camera sees, without poses and while it moves; or a recording, at its own frame rate.

python apps/live_loop.py results/mine
python apps/live_loop.py results/mine rosbag path/to/robot.bag
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.datasets.live import LiveFrames, Replay
from taichi_unifusion.datasets.realsense_camera import RealsenseCamera
from taichi_unifusion.results import write_results
from taichi_unifusion.tracking import make_tracker
from taichi_unifusion.tracking.live import TrackedFrames
from taichi_unifusion.viewer.window_live import watch_in_window


def main(out: str, format: str = "", path: str = "") -> None:
    pipeline = uf.Pipeline(uf.Config())
    uf.warm_up()  # compile first, so that no frame is missed meanwhile
    source = Replay(uf.open_dataset(format, path).without_poses()) if format else RealsenseCamera()
    watcher = watch_in_window(out, 0)  # where there is a screen
    with LiveFrames(source, path or "camera") as frames:
        run = pipeline.run(
            TrackedFrames(frames, make_tracker("rgbd")),
            stop=lambda: frames.received > 300,
            on_step=watcher.on_step,
            on_skip=watcher.on_skip,
        )
        print(f"{frames.received} came, {len(run.steps)} are mapped, {frames.dropped} were dropped")
    watcher.finish(write_results(out, pipeline, run).directory)  # until the window is closed


if __name__ == "__main__":
    sys.exit(run_script(main))
