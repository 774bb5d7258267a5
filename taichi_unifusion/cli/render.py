"""`unifusion render`: results -> a video of a flight through them, or pictures; no screen needed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..errors import FileError, InputError, convert
from .interrupts import INTERRUPTED, stop_on_signal
from .options import OPTIONAL, EncoderOptions, UpOption
from .results_source import results_source
from .terminal import DONE, frame_progress

if TYPE_CHECKING:
    from ..types import PinholeCamera
    from ..viewer.render import Picturing
    from ..viewer.scene import Scene

logger = logging.getLogger(__name__)

GAP = 12  # pixels between results side by side
MOST_SIDE = 8192  # pixels


@dataclass(frozen=True)
class Render:
    """Fly through results and write what there is to see, as a video or as pictures; no screen
    needed.

    Example: unifusion render results/kitchen --out tour.mp4

    Before and after, seen by the same camera: unifusion render results/coarse results/fine --out
    both.mp4

    A folder for --out gets color/000000.png and so on, camera.yaml and poses.txt, which the format
    `folder` reads; with --depth and --normals also depth/, in millimetres, and normals/.
    """

    dirs: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DIR...", help_behavior_hint="(one or more)")
    ]
    """Results folders of `unifusion`, or mesh files; several are shown side by side."""
    out: Annotated[Path, arg(metavar="FILE.mp4|DIR")]
    """Where to write: a video (.mp4, .mkv, .mov; with the extra `video`), or a folder for pictures."""
    path: Annotated[str, arg(metavar="trajectory|circle|FILE")] = "trajectory"
    """Where the camera goes: along the recorded trajectory, smoothed and levelled; once around
    everything; or through the poses of a file in TUM's format, one picture each."""
    layer: Annotated[str, arg(metavar="NAME")] = "color"
    """What is shown: color, a property, normals, height, weight, evidence, segmentation, or the text
    of a query that lies in the folder. A wrong name lists what there is.
    """
    query: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint=OPTIONAL)] = None
    """Ask for something, and show where it is."""
    compare: Annotated[Path | None, arg(metavar="MESH", help_behavior_hint=OPTIONAL)] = None
    """A mesh in the same world: the distance to it becomes a layer, which is shown."""
    size: Annotated[str, arg(metavar="WIDTHxHEIGHT")] = "1920x1080"
    """Pixels of a picture."""
    fov: Annotated[float, arg(metavar="DEGREES")] = 55.0
    """Vertical field of view."""
    fps: Annotated[float, arg(metavar="N")] = 30.0
    """Pictures a second."""
    seconds: Annotated[
        float | None, arg(metavar="S", help_behavior_hint="(default: as long as the way takes)")
    ] = None
    """How long the flight takes."""
    samples: Annotated[int, arg(metavar="1|2|3")] = 2
    """Samples of a pixel, along each side: 1 is twice as quick, and edges are jagged."""
    depth: FlagCreatePairsOff[bool] = False
    """Write depth images too, 16-bit PNG in millimetres."""
    normals: FlagCreatePairsOff[bool] = False
    """Write images of normals too: x right, y up, z towards the camera."""
    no_legend: FlagCreatePairsOff[bool] = False
    """Leave the legend of a layer out."""
    up: UpOption = None
    """Another up than that of the results: an axis as z or -y, or three numbers."""
    encoder: Annotated[EncoderOptions, arg(name="")] = field(default_factory=EncoderOptions)


def render(options: Render) -> int:
    """Results -> a video or pictures."""
    if not options.dirs:
        raise InputError("render: say what to show, for example: unifusion render results/demo")
    size = _size(options)
    from .. import runtime
    from ..viewer.render import Picturing, camera_of
    from ..viewer.several import with_shared_scales

    with _no_empty_folder(options.out):
        sink = _check_out(options, size)
        scenes = with_shared_scales([_open(path, options) for path in options.dirs])
        camera = camera_of(_panel(size, len(scenes)), options.fov)
        poses = _poses(options, scenes[0], camera)
        layer = _layer(options)
        runtime.init(options.encoder.device)
        shown = [
            Picturing(scene, layer, camera, options.samples, not options.no_legend)
            for scene in scenes
        ]
    with (
        stop_on_signal(clean_up=lambda: _remove_unfinished(options.out)) as stop,
        sink() as write,
        frame_progress(len(poses)) as on_frame,
    ):
        done = 0
        for T_world_camera in poses:
            if stop():
                break
            write(shown, T_world_camera)
            done += 1
            on_frame(done, len(poses))
    stopped = f", stopped after {done} of {len(poses)}" if done < len(poses) else ""
    print(f"{options.out}: {done} pictures of {size[0]}x{size[1]}{stopped}")
    return INTERRUPTED if stop() else DONE


def _size(options: Render) -> tuple[int, int]:
    """The size of a picture; raises InputError for numbers that make no picture."""
    width, height = convert(options.size, tuple[int, int], "size")
    if not (16 <= width <= MOST_SIDE and 16 <= height <= MOST_SIDE):
        raise InputError(f"size: sides must be 16 to {MOST_SIDE} pixels, got {width}x{height}")
    if _panel((width, height), len(options.dirs))[0] < 16:
        raise InputError(f"size: {width} pixels are too few for {len(options.dirs)} results")
    if options.samples not in (1, 2, 3):
        raise InputError(f"samples: must be 1, 2 or 3, got {options.samples}")
    if not 0 < options.fps <= 240:
        raise InputError(f"fps: must be above 0 and at most 240, got {options.fps:g}")
    if options.seconds is not None and not 0 < options.seconds <= 3600:
        raise InputError(f"seconds: must be above 0 and at most 3600, got {options.seconds:g}")
    return width, height


def _panel(size: tuple[int, int], count: int) -> tuple[int, int]:
    """The size of each of `count` pictures side by side."""
    return (size[0] - GAP * (count - 1)) // count, size[1]


def _layer(options: Render) -> str:
    from ..viewer.answers import layer_name

    if options.query is not None:
        return layer_name(options.query)
    if options.compare is not None and options.layer == Render.layer:
        return f"distance to {options.compare.name}"
    return options.layer


def _open(path: Path, options: Render) -> Scene:
    """The scene of a results folder, with the answer to --query in it."""
    from ..geometry.gravity import parse_up
    from ..viewer.results_scene import SceneOptions

    up = parse_up(options.up) if options.up else None
    source = results_source(path, SceneOptions(options.compare, cameras=0), options.encoder)
    scene = source.open()
    scene = scene if up is None else replace(scene, T_up_world=up.T_up_world)
    if options.query is None:
        return scene
    answer = source.ask(scene.meshes[0], options.query)
    print(f"{path}: {answer.sentence}")
    return replace(
        scene,
        meshes=(scene.meshes[0].with_layers([answer.layer]),),
        boxes=answer.boxes,
        labels=answer.labels,
    )


def _poses(options: Render, scene: Scene, camera: PinholeCamera) -> NDArray[np.float64]:
    """Where the camera goes (N, 4, 4)."""
    from ..files.trajectories import read_trajectory
    from ..results.outlook import read_poses
    from ..results.run_folder import RunFolder
    from ..viewer.render import WAYS, plan_path

    if options.path not in WAYS:
        if not Path(options.path).is_file():
            raise FileError(
                f"{options.path}: no such file; a path is {' or '.join(WAYS)}, or a file of poses "
                "'timestamp tx ty tz qx qy qz qw'"
            )
        return read_trajectory(options.path).T_world_camera
    first = options.dirs[0]
    trajectory = read_poses(RunFolder(first)) if first.is_dir() else None
    return plan_path(scene, trajectory, options.path, camera, options.fps, options.seconds)


# writes what some scenes, side by side, show from a pose
Write = Callable[["list[Picturing]", NDArray[np.float64]], None]


def _check_out(
    options: Render, size: tuple[int, int]
) -> Callable[[], AbstractContextManager[Write]]:
    """What opens the output, which is checked now, before any work is done."""
    from ..files.atomic import check_writable
    from ..files.video import check_video

    if options.out.suffix and not options.out.is_dir():
        check_video(options.out, size)
        check_writable(options.out.parent)
        folder = options.out.with_suffix("")
    else:
        folder = check_writable(options.out)
    return lambda: _opened(options, folder, size)


@contextmanager
def _no_empty_folder(path: Path) -> Iterator[None]:
    """Where what is done inside fails, a folder that was made for it, and holds nothing, goes."""
    new = not path.exists()
    try:
        yield
    except BaseException:
        if new and path.is_dir():
            with suppress(OSError):
                path.rmdir()
        raise


@contextmanager
def _opened(options: Render, folder: Path, size: tuple[int, int]) -> Iterator[Write]:
    """Gives what writes a picture into the video or the folder, and the images beside it."""
    from ..files.images import write_depth_png, write_png
    from ..files.video import video_writer

    video = folder != options.out
    poses: list[NDArray] = []
    subfolders = ["color"] * (not video) + ["depth"] * options.depth + ["normals"] * options.normals
    with ExitStack() as stack:
        for name in subfolders:
            (folder / name).mkdir(parents=True, exist_ok=True)
        add = stack.enter_context(video_writer(options.out, size, options.fps)) if video else None

        def write(shown: list[Picturing], T_world_camera: NDArray) -> None:
            name = f"{len(poses):06d}.png"
            picture = _beside([each.picture(T_world_camera) for each in shown], size, 255)
            if add is None:
                write_png(folder / "color" / name, picture)
            else:
                add(picture)
            if options.depth:
                depth = _beside([each.depth(T_world_camera) for each in shown], size, 0)
                write_depth_png(folder / "depth" / name, depth)
            if options.normals:
                normals = _beside([each.normals(T_world_camera) for each in shown], size, 0)
                write_png(folder / "normals" / name, normals)
            poses.append(T_world_camera)
            if len(poses) == 1 and subfolders:
                _write_camera(folder, shown[0].camera)

        try:
            yield write
        finally:
            if poses and subfolders:
                _write_poses(folder, poses)


def _remove_unfinished(out: Path) -> None:
    """Remove what a process leaves of a video that is ended at once."""
    for path in out.parent.glob(f".{out.name}.*.tmp"):
        with suppress(OSError):
            path.unlink()


def _beside(pictures: list[NDArray], size: tuple[int, int], gap: int) -> NDArray:
    """Pictures side by side in one of `size` (width, height), `gap` between them."""
    if len(pictures) == 1:
        return pictures[0]
    width, height = pictures[0].shape[1::-1]
    whole = np.full((size[1], size[0], *pictures[0].shape[2:]), gap, pictures[0].dtype)
    for i, picture in enumerate(pictures):
        left = i * (width + GAP)
        whole[:height, left : left + width] = picture
    return whole


def _write_camera(folder: Path, camera: PinholeCamera) -> None:
    from ..files.atomic import write_text

    names = ("width", "height", "fx", "fy", "cx", "cy")
    lines = "".join(f"{name}: {getattr(camera, name)}\n" for name in names)
    write_text(folder / "camera.yaml", f"{lines}depth_scale: 1000\n")


def _write_poses(folder: Path, poses: list[NDArray]) -> None:
    """One row of 16 numbers for every picture, camera to world."""
    from ..files.atomic import write_text

    rows = (" ".join(f"{number:.9g}" for number in T.ravel()) for T in poses)
    write_text(folder / "poses.txt", "".join(f"{row}\n" for row in rows))
