"""Recordings in the formats that people have: `open_dataset("tum", path)` gives frames that can be
indexed and sliced.
"""

from __future__ import annotations

import ast
import inspect
import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import lazy_loader

from ..errors import (
    DatasetError,
    InputError,
    as_path,
    check_type,
    convert,
    did_you_mean,
    is_convertible,
)
from .dataset import Dataset, DatasetView
from .mending import MENDINGS, Mending

if TYPE_CHECKING:
    from .color_camera import ColorCamera
    from .color_estimation import ColorEstimate, estimate_color_camera

logger = logging.getLogger(__name__)

FORMATS = {  # name -> module here, what opens a recording
    "synthetic": ("synthetic", "SyntheticRoom"),
    "7scenes": ("seven_scenes", "open_seven_scenes"),
    "replica": ("replica", "open_replica"),
    "tum": ("tum", "open_tum"),
    "scannet": ("scannet", "open_scannet"),
    "k4a": ("k4a", "open_k4a"),
    "folder": ("folder", "open_folder"),
    "2d3ds": ("stanford", "open_stanford"),
    "scene": ("scene", "open_scene"),
    "record3d": ("record3d", "open_record3d"),
    "strayscanner": ("strayscanner", "open_strayscanner"),
    "polycam": ("polycam", "open_polycam"),
    "nerfstudio": ("nerfstudio", "open_nerfstudio"),
    "arkitscenes": ("arkitscenes", "open_arkitscenes"),
    "scannetpp": ("scannetpp", "open_scannetpp"),
    "hypersim": ("hypersim", "open_hypersim"),
    "matterport": ("matterport", "open_matterport"),
    "open3d": ("open3d_system", "open_open3d"),
    "realsense": ("realsense", "open_realsense"),
    "rosbag": ("rosbag", "open_rosbag"),
}

AUTO = "auto"  # instead of a format: the one that the files are of

SENTENCES = {  # what an option of open_dataset means, the same in every format that has it
    "align": "The camera whose pixels the frames have, depth or color; the paper's is color.",
    "camera": "The PinholeCamera of the depth images, instead of the recording's.",
    "camera_topic": "Topic of the depth camera's CameraInfo, instead of the one beside the images.",
    "classes": "The class of each object by name; others are their own class.",
    "color_detail": "Pixels for each of the depth image's, across and down; 0: 2 where these span over 6 mm, else 1.",
    "color_topic": "Topic of the colour images, or none; needed where several could be meant.",
    "depth_scale": "Units of the depth images that make a metre.",
    "depth_topic": "Topic of the depth images; needed where several could be meant.",
    "drop_alpha": "Accept colour images with a fourth channel and ignore it.",
    "frames": "Frames of the loop through the room.",
    "height": "Rows of an image.",
    "max_difference": "How far time stamps of depth, colour and pose may be apart, in seconds.",
    "min_confidence": "How sure the phone must be of a reading, 0 (not at all) to 2.",
    "noise": "Depth as a Kinect reads it; false: exact depth.",
    "pose_topic": "Topic of the camera's poses, or tf for transforms.",
    "room": "The one room to read, as office_1, instead of the whole area.",
    "seed": "Another number gives other noise.",
    "trajectory": "File of poses: those to render from, or those of the frames where several files hold some.",
    "weigh_confidence": "Readings of confidence 1 count half as much as those of 2.",
    "width": "Columns of an image.",
    "world_frame": "Frame of the transforms that is the world, as odom; the root of their tree is.",
    **MENDINGS,
}
# formats whose `camera` may be bare intrinsics; in others it is put into the frames as they are read
TAKES_INTRINSICS = ("7scenes", "replica", "tum", "scannet", "folder")

__all__ = [
    "FORMATS",
    "ColorCamera",
    "ColorEstimate",
    "Dataset",
    "DatasetView",
    "FormatOption",
    "estimate_color_camera",
    "format_options",
    "open_dataset",
    "parse_options",
]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "color_camera": ["ColorCamera"],
        "color_estimation": ["ColorEstimate", "estimate_color_camera"],
    },
)


@dataclass(frozen=True)
class FormatOption:
    """An option that `open_dataset` takes for a format."""

    name: str
    type: Any  # as annotated
    default: Any  # None: the recording's own, or the format's usual
    sentence: str

    @property
    def has_text_form(self) -> bool:
        """Whether it can be given as text, as NAME=VALUE."""
        return is_convertible(self.type)


def open_dataset(format: str, path: str | Path | None = None, **options: Any) -> Dataset:
    """Open the recording at `path`; frames are read when indexed.

    With the format "auto" the files say which it is. `format_options` says which options a format
    has. Raises DatasetError for an unknown format, a path that does not exist or holds no such
    recording, InputError for an unknown option.
    """
    format = known_format(format, path)
    opener = _opener(format)
    known = format_options(format)
    options = {american(name): value for name, value in options.items()}
    for option, value in options.items():
        _check_option(option, format, known)
        if option not in MENDINGS:
            check_type(f"option '{option}'", value, known[option].type)
    mending = Mending.of(options)
    options = {name: value for name, value in options.items() if name not in MENDINGS}
    if not mending.changes:
        return _open(format, opener, path, options)
    from .depth_camera import Intrinsics
    from .mended import Mended
    from .projected import Projected

    if mending.intrinsics is not None and format in TAKES_INTRINSICS:
        options["camera"] = Intrinsics(*mending.intrinsics)
        mending = replace(mending, intrinsics=None)
    recording = _open(format, opener, path, options)
    if mending.project_poses is not None:
        recording = Projected(recording) if mending.project_poses else recording
        mending = replace(mending, project_poses=None)
    return Mended(recording, mending) if mending.changes else recording


def _open(
    format: str, opener: Callable[..., Dataset], path: str | Path | None, options: dict[str, Any]
) -> Dataset:
    if path is None:
        if inspect.signature(opener).parameters["path"].default is inspect.Parameter.empty:
            raise DatasetError(f"format '{format}' needs the path of a recording")
        return opener(**options)
    path = as_path(f"path of a recording, format '{format}'", path).expanduser()
    if not os.path.exists(path):  # unlike Path.exists it answers for any name
        raise DatasetError(f"{path}: no such file or folder")
    try:
        return opener(path, **options)
    except DatasetError as error:
        from .detection import other_format

        hint = other_format(path, format, FORMATS)
        if not hint:
            raise
        raise DatasetError(f"{error}{hint}") from error


def known_format(format: str, path: str | Path | None) -> str:
    """The format itself, or of "auto" the one that the files at `path` are of.

    Raises DatasetError where none is recognised or several could be meant.
    """
    if format != AUTO:
        return format
    if path is None:
        raise DatasetError(f"format '{AUTO}' needs the path of a recording")
    from .detection import find_format

    found = find_format(Path(path).expanduser(), FORMATS)
    logger.info("format %s: found %s", found.format, found.sign)
    return found.format


def format_layout(format: str) -> str:
    """What a recording of a format is made of, in words: the docstring of its module, which is not
    imported for it. DatasetError for an unknown format.
    """
    _opener_name(format)
    source = Path(__file__).with_name(f"{FORMATS[format][0]}.py").read_text(encoding="utf-8")
    return ast.get_docstring(ast.parse(source)) or ""


def format_options(format: str) -> dict[str, FormatOption]:
    """The options that `open_dataset` takes for a format, by name; DatasetError for an unknown
    format.

    Some formats import Taichi or PyAV to answer.
    """
    opener = _opener(format)
    types = get_type_hints(opener.__init__ if inspect.isclass(opener) else opener)
    own = {
        name: FormatOption(name, types[name], parameter.default, SENTENCES[name])
        for name, parameter in inspect.signature(opener).parameters.items()
        if name != "path"
    }
    mending = get_type_hints(Mending)
    return own | {
        name: FormatOption(name, mending[name], None, MENDINGS[name]) for name in MENDINGS
    }


def parse_options(format: str, texts: Iterable[str]) -> dict[str, Any]:
    """Options for `open_dataset` from texts such as "align=color" or "noise=false".

    Raises DatasetError for an unknown format, InputError for an option that is unknown, given
    twice or has no text form, and for a value of another type.
    """
    known = format_options(format)
    options: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = american(name)
        if not equals:
            raise InputError(f"option '{text}': give it as NAME=VALUE")
        _check_option(name, format, known)
        if name in options:
            raise InputError(f"option '{name}' is given twice")
        if not known[name].has_text_form:
            raise InputError(f"option '{name}' cannot be given as text, only in Python")
        if name in MENDINGS:
            options[name] = getattr(Mending.of({name: value}), name)
            continue
        options[name] = convert(value, known[name].type, f"option '{name}'")
    return options


def american(name: str) -> str:
    """The name of an option as it is spelled here: `colour_topic` is `color_topic`."""
    return name.replace("colour", "color")


def _opener(format: str) -> Callable[..., Dataset]:
    """The function or class that opens recordings of a format."""
    module, name = _opener_name(format)
    return getattr(import_module(f".{module}", __name__), name)


def _opener_name(format: str) -> tuple[str, str]:
    """Its module here and its name."""
    if format not in FORMATS:
        raise DatasetError(
            f"format '{format}' is unknown{did_you_mean(format, FORMATS)}; formats: {', '.join(FORMATS)}, or auto"
        )
    return FORMATS[format]


def _check_option(name: str, format: str, known: Iterable[str]) -> None:
    if name not in known:
        raise InputError(
            f"option '{name}' is unknown for format '{format}'{did_you_mean(name, known)}; "
            f"options: {', '.join(known)}"
        )
