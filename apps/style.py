"""A scene as painted and as drawn, by OpenCV's filters, or in the style of an image-to-image
network in an ONNX file.

    python apps/style.py replica path/to/office0 results/style
    python apps/style.py replica path/to/office0 results/style candy.onnx
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.results import write_results
from taichi_unifusion.viewer.window_live import watch_in_window


def main(format: str, path: str, out: str, network: str = "") -> None:
    styles = (
        (f"style=onnx:{network},voxel_size=0.02",)
        if network
        else (
            "style=painting,name=painting,voxel_size=0.02",
            "style=sketch,name=sketch,voxel_size=0.02",
        )
    )
    pipeline = uf.Pipeline(uf.Config(properties=styles))
    frames = uf.open_dataset(format, path)[::10]
    watcher = watch_in_window(out, len(frames))  # where there is a screen
    run = pipeline.run(frames, on_step=watcher.on_step, on_skip=watcher.on_skip)
    results = write_results(out, pipeline, run)
    print(f"{out}: {', '.join(results.files)}")
    watcher.finish(results.directory)  # until the window is closed


if __name__ == "__main__":
    sys.exit(run_script(main))
