"""Map CLIP features with the library and ask for things in plain words, as `unifusion understand`
and `query` do.

    python apps/clip.py 7scenes path/to/redkitchen path/to/clip-vit-base-patch16 \\
        "sofa" "something to sit on"
"""

import sys

import taichi_unifusion as uf
from taichi_unifusion.cli.script import run_script
from taichi_unifusion.language import make_image_encoder, make_text_encoder
from taichi_unifusion.language.questions import ask
from taichi_unifusion.viewer.window_live import watch_in_window


def main(format: str, path: str, model: str, *texts: str) -> None:
    pipeline = uf.Pipeline(uf.Config(), encoder=make_image_encoder(f"clip:{model}"))
    frames = uf.open_dataset(format, path)[::10]
    watcher = watch_in_window(path, len(frames))  # where there is a screen
    pipeline.run(frames, on_step=watcher.on_step, on_skip=watcher.on_skip)
    watcher.close()
    for answer in ask(
        pipeline.maps["features"],
        pipeline.extract_mesh(),
        make_text_encoder(f"clip:{model}"),
        texts,
    ):
        best = f"best at {answer.regions[0].centroid.round(2)} m" if answer.found else "not here"
        print(f"{answer.text}: {len(answer.regions)} regions, {best}")


if __name__ == "__main__":
    sys.exit(run_script(main))
