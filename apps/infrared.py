"""The infrared field of a surface, from an Azure Kinect recording or any recording with infrared
images.

    python apps/infrared.py k4a path/to/recording.mkv results/infrared
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.results import write_results


def main(format: str, path: str, out: str) -> None:
    pipeline = uf.Pipeline(uf.Config(properties=("infrared,voxel_size=0.02",)))
    run = pipeline.run(uf.open_dataset(format, path))
    results = write_results(out, pipeline, run)
    print(f"{out}: {', '.join(results.files)}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except uf.UniFusionError as error:
        sys.exit(str(error))
