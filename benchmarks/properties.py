"""Properties: what a frame costs each map, what a second property adds, and how well images come
back.

    python benchmarks/properties.py cost                  # frames of 1280x720, as in the paper's Table VIII
    python benchmarks/properties.py sharing               # the time that a second property of three channels adds
    python benchmarks/properties.py quality synthetic     # PSNR at held-out frames: colour, infrared-like, styles
    python benchmarks/properties.py quality house PATH    # the same in the flat of aws-robomaker-small-house-world
    python benchmarks/properties.py flicker house PATH --out docs/flicker.jpg   # change between views; a picture

Times are of this process's processors (CPU seconds by threads in use), because other programs share
the machine; on a GPU, of the clock. Frames are loaded and property images made before; every map
takes its turn at every frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.maps import PropertyGroup
from taichi_unifusion.properties import SurfaceProperty, make_property

STYLES, SHOWN_STYLE = ("painting", "opencv", "sketch"), "sketch"
VOXEL_SIZE = 0.1  # [m] of every property's map in the table of costs
# Table VIII, a GPU, 1280x720
PAPER_MS = {"surface": 100, "color": 38, "infrared": 45, "style": 48, "saliency": 45}


def like_infrared(frame: uf.Frame) -> np.ndarray:
    """Mean colour in units of 0..65535: of what an infrared camera gives, the part that a rendered
    scene has.
    """
    return np.float32(frame.color).mean(axis=2) * 257


def with_images(frame: uf.Frame, properties: Sequence[SurfaceProperty]) -> uf.Frame:
    frame = made = frame.with_image("infrared", like_infrared(frame))
    for each in properties:
        made = made.with_image(each.name, each.image(frame))
    return made


def cloud_of(frame: uf.Frame) -> uf.PointCloud:
    return uf.preprocess(frame).transformed(frame.T_world_camera)


def timed(work: Callable, *arguments) -> float:
    """Milliseconds: of all threads' processor time on the CPU, of the clock on a GPU."""
    clock = time.process_time if runtime.current().device == "cpu" else time.perf_counter
    runtime.synchronize()
    start = clock()
    work(*arguments)
    runtime.synchronize()
    return 1e3 * (clock() - start)


def alike(surface_property: SurfaceProperty) -> uf.PropertyMap:
    """A map for a property with voxels as large as those of the paper's Table VIII."""
    return uf.PropertyMap(surface_property.name, surface_property.channels, voxel_size=VOXEL_SIZE)


def cost(frames: int) -> None:
    """A table of milliseconds a frame by map."""
    properties = [make_property(name) for name in ("infrared", "style", "saliency")]
    room = uf.open_dataset("synthetic", frames=60, width=1280, height=720)
    clouds = [cloud_of(with_images(room[i], properties)) for i in range(frames)]
    maps = {
        "surface": uf.SurfaceMap(),
        "color": uf.PropertyMap("color", 3),
        **{each.name: alike(each) for each in properties},
    }
    group = PropertyGroup([alike(each) for each in properties])
    laps: dict[str, list[float]] = {}
    for cloud in clouds:
        for name, target in maps.items():
            laps.setdefault(name, []).append(timed(target.integrate, cloud))
        laps.setdefault("infrared + style + saliency", []).append(timed(group.integrate, cloud))
    sizes = {name: f"{100 * target.voxel_size:g} cm" for name, target in maps.items()}
    table = Table(
        title=f"{len(clouds[0]):,} points a frame of 1280x720, {runtime.current().description}"
    )
    for column in ("map", "voxels", "ms a frame", "paper, ms"):
        table.add_column(column, justify="left" if column == "map" else "right")
    for name, values in laps.items():
        table.add_row(
            name,
            sizes.get(name, sizes["infrared"]),
            f"{np.median(values[2:]):.1f}",
            str(PAPER_MS.get(name, sum(PAPER_MS[each.name] for each in properties))),
        )
    Console().print(table)


def sharing(frames: int) -> None:
    """The time of a frame for one property of three channels, and for two of them."""
    room = uf.open_dataset("synthetic", frames=60)
    clouds = []
    for i in range(frames):
        frame = room[i]
        image = np.float32(frame.color) / 255
        clouds.append(
            cloud_of(frame.with_image("first", image).with_image("second", image[..., ::-1]))
        )
    for voxel_size in (0.1, 0.05, 0.02):
        groups = [
            PropertyGroup([uf.PropertyMap(name, 3, voxel_size=voxel_size) for name in names])
            for names in (["first"], ["first", "second"])
        ]
        laps = np.array(
            [[timed(group.integrate, cloud) for group in groups] for cloud in clouds * 3]
        )[len(clouds) :]
        one, two = np.median(laps, axis=0)
        print(
            f"{100 * voxel_size:g} cm voxels: one property {one:.1f} ms a frame, two {two:.1f} ms, the second adds "
            f"{100 * np.median((laps[:, 1] - laps[:, 0]) / laps[:, 0]):.0f} %",
            flush=True,
        )
        del groups


def quality(scene: str, path: str | None, voxel_sizes: Sequence[float]) -> None:
    """PSNR [dB] of every property at the points of frames that were not mapped, by voxel size."""
    recording = (
        open_scene(scene, path)[:120:6] if scene == "house" else open_scene(scene, path)[:20]
    )
    properties = [
        make_property(text)
        for text in (
            "infrared=linear,name=infrared",
            "saliency",
            *(f"style={style},name={style}" for style in STYLES),
        )
    ]
    frames = [cloud_of(with_images(recording[i], properties)) for i in range(len(recording))]
    left_out = range(2, len(frames), 4) or [len(frames) - 1]
    held_out = [frames[i] for i in left_out]
    for voxel_size in voxel_sizes:
        maps = [uf.PropertyMap("color", 3, voxel_size=voxel_size)]
        maps += [
            uf.PropertyMap(each.name, each.channels, voxel_size=voxel_size) for each in properties
        ]
        group = PropertyGroup(maps)
        for i, cloud in enumerate(frames):
            if i not in left_out:
                group.integrate(cloud)
        found = {}
        for each in maps:
            squares = []
            for cloud in held_out:
                values, valid = each.query(cloud.points, return_valid=True)
                squares.append(np.square(values - cloud.attributes[each.name])[valid].mean())
            found[each.name] = np.mean(-10 * np.log10(squares))
        levels = ", ".join(f"{name} {value:.2f} dB" for name, value in found.items())
        print(f"{scene}, {100 * voxel_size:g} cm: {levels}", flush=True)
        del maps, group


def flicker(scene: str, path: str | None, frames: int, voxel_size: float, out: str | None) -> None:
    """How much styles change from view to view at the same points of the surface, and how much the
    map does.
    """
    from properties_flicker import look, mean_changes, write_sheet

    views = look(open_scene(scene, path), frames, STYLES, voxel_size)
    for name, (images, renderings) in mean_changes(views).items():
        print(
            f"{scene}, {100 * voxel_size:g} cm, {name}: its images change by {images:.2f} % of the range "
            f"from view to view, the map's renderings by {renderings:.2f} %",
            flush=True,
        )
    if out:
        write_sheet(Path(out), views[-3:], SHOWN_STYLE)


def open_scene(scene: str, path: str | None) -> uf.Dataset:
    if scene == "house":
        from house import load_house

        return load_house(path, "living")
    return uf.open_dataset(scene, path, **({"frames": 60} if scene == "synthetic" else {}))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("cost", "sharing", "quality", "flicker"))
    parser.add_argument(
        "scene", nargs="?", choices=("synthetic", "house", "replica"), default="synthetic"
    )
    parser.add_argument(
        "path", nargs="?", help="folder of the house's GLB, or of a recording of Replica"
    )
    parser.add_argument("--frames", type=int, default=12, help="how many (not for quality)")
    parser.add_argument("--voxel-sizes", type=float, nargs="+", default=(0.02, 0.05, 0.1))
    parser.add_argument("--out", help="picture of flicker, a JPEG file")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    if options.what == "flicker" and options.scene == "replica":
        parser.error("flicker needs a scene whose exact depth is known: synthetic or house")
    uf.init(options.device)
    if options.what == "quality":
        quality(options.scene, options.path, options.voxel_sizes)
    elif options.what == "flicker":
        flicker(options.scene, options.path, options.frames, options.voxel_sizes[0], options.out)
    else:
        {"cost": cost, "sharing": sharing}[options.what](options.frames)


if __name__ == "__main__":
    main()
