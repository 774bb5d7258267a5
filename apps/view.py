"""Look at a results folder in a window, with the library: layers by keys, a camera that turns and
flies. `unifusion view --window` does the same, and takes questions.

    python apps/view.py results/kitchen
"""

import sys

from taichi_unifusion.cli.script import run_script
from taichi_unifusion.viewer.results_scene import open_scene
from taichi_unifusion.viewer.window import SceneWindow


def main(path: str) -> None:
    scene = open_scene(path)
    window = SceneWindow(scene.name)
    window.put(scene)
    window.serve()
    window.close()


if __name__ == "__main__":
    sys.exit(run_script(main))
