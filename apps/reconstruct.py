"""Reconstruct a recording with the library, as `unifusion reconstruct` does: a start for a program
of your own.

    python apps/reconstruct.py 7scenes path/to/redkitchen results/kitchen
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.results import write_results
from taichi_unifusion.viewer.window_live import watch_in_window


def main(format: str, path: str, out: str) -> None:
    pipeline = uf.Pipeline(uf.Config())
    frames = uf.open_dataset(format, path)
    watcher = watch_in_window(out, len(frames))  # where there is a screen
    run = pipeline.run(frames, on_step=watcher.on_step, on_skip=watcher.on_skip)
    results = write_results(out, pipeline, run)
    print(
        f"{len(run.steps)} frames used, {len(run.skipped)} skipped; {', '.join(results.files)} in {results.directory}"
    )
    watcher.finish(results.directory)  # until the window is closed


if __name__ == "__main__":
    sys.exit(run_script(main))
