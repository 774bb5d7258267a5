"""Reconstruct a recording with the library, as `unifusion reconstruct` does: a start for a program
of your own.

    python apps/reconstruct.py 7scenes path/to/redkitchen results/kitchen
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.results import write_results


def main(format: str, path: str, out: str) -> None:
    pipeline = uf.Pipeline(uf.Config())
    run = pipeline.run(uf.open_dataset(format, path))
    results = write_results(out, pipeline, run)
    print(
        f"{len(run.steps)} frames used, {len(run.skipped)} skipped; {', '.join(results.files)} in {results.directory}"
    )


if __name__ == "__main__":
    try:
        main(*sys.argv[1:4])
    except uf.UniFusionError as error:
        sys.exit(str(error))
