"""The infrared field of a surface, from an Azure Kinect recording or any recording with infrared
images.

    python apps/infrared.py k4a path/to/recording.mkv results/infrared
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.results import write_results
from taichi_unifusion.viewer.window_live import watch_in_window


def main(format: str, path: str, out: str) -> None:
    pipeline = uf.Pipeline(uf.Config(properties=("infrared,voxel_size=0.02",)))
    frames = uf.open_dataset(format, path)
    watcher = watch_in_window(out, len(frames))  # where there is a screen
    run = pipeline.run(frames, on_step=watcher.on_step, on_skip=watcher.on_skip)
    results = write_results(out, pipeline, run)
    print(f"{out}: {', '.join(results.files)}")
    watcher.finish(results.directory)  # until the window is closed


if __name__ == "__main__":
    sys.exit(run_script(main))
