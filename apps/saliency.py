"""What draws the eye, on the surface: by a simple detector, or by a salient-object network in an
ONNX file.

    python apps/saliency.py 7scenes path/to/redkitchen results/saliency
    python apps/saliency.py 7scenes path/to/redkitchen results/saliency \\
        u2net.onnx,size=320x320,activation=minmax
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.results import write_results
from taichi_unifusion.viewer.window_live import watch_in_window


def main(format: str, path: str, out: str, network: str = "") -> None:
    pipeline = uf.Pipeline(
        uf.Config(properties=(f"saliency=onnx:{network}" if network else "saliency",))
    )
    frames = uf.open_dataset(format, path)[::10]
    watcher = watch_in_window(out, len(frames))  # where there is a screen
    run = pipeline.run(frames, on_step=watcher.on_step, on_skip=watcher.on_skip)
    results = write_results(out, pipeline, run)
    print(f"{out}: {', '.join(results.files)}")
    watcher.finish(results.directory)  # until the window is closed


if __name__ == "__main__":
    sys.exit(run_script(main))
