"""Memory and time of reading a large bag: writes one of some gigabytes, reads every frame of it, removes it.

python benchmarks/bags.py /tmp --gigabytes 2 --container bag
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

WIDTH, HEIGHT = 640, 480
FRAME_BYTES = WIDTH * HEIGHT * (2 + 3)
READ = """
import resource, sys, time
import taichi_unifusion as uf

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

started = time.perf_counter()
frames = uf.open_dataset("rosbag", sys.argv[1])
opened, at_first = time.perf_counter() - started, 0.0
for i, frame in enumerate(frames):
    at_first = at_first or peak()
    assert frame.depth.shape == (480, 640) and frame.T_world_camera is not None
spent = time.perf_counter() - started - opened
print(f"opened in {opened:.1f} s, {len(frames)} frames in {spent:.1f} s ({1e3 * spent / len(frames):.1f} ms a frame); "
      f"peak {at_first:.0f} MB after the first frame, {peak():.0f} MB after the last")
"""


def write(path: Path, container: str, frames: int) -> Path:
    """A bag of noise, frame by frame, with transforms and CameraInfo."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
    import bag_writer as bags

    from taichi_unifusion.types import PinholeCamera

    camera = PinholeCamera(WIDTH, HEIGHT, 525.0, 525.0, 319.5, 239.5)
    rng = np.random.default_rng(0)
    units = rng.integers(500, 5000, (HEIGHT, WIDTH), dtype=np.uint16)
    color = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)

    def messages():
        for i in range(frames):
            at = 1000.0 + i / 30
            pose = np.eye(4)
            pose[0, 3] = 0.001 * i
            yield bags.transform(pose, at, "map")
            yield bags.camera_info("/camera/depth/camera_info", at, camera=camera)
            yield bags.image(bags.DEPTH, np.roll(units, i, axis=1), "16UC1", at)
            yield bags.image(bags.COLOR, color, "rgb8", at)

    return bags.write_bag(path, messages(), container)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the bag may lie meanwhile")
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--container", default="bag", help="bag, bag-lz4, mcap, mcap-zstd or db3")
    options = parser.parse_args()
    with TemporaryDirectory(dir=options.folder) as folder:
        started = time.perf_counter()
        frames = int(options.gigabytes * 1e9 / FRAME_BYTES)
        path = write(Path(folder) / "large", options.container, frames)
        files = [path] if path.is_file() else list(path.iterdir())
        size = sum(file.stat().st_size for file in files) / 1e9
        print(f"{options.container}: {size:.2f} GB in {time.perf_counter() - started:.0f} s")
        subprocess.run([sys.executable, "-c", READ, str(path)], check=True)
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"(writing took {own:.0f} MB)")


if __name__ == "__main__":
    main()
