"""Options that several commands share, as values: a recording, where poses come from, where results
go, a text encoder, where numbers go.

A command nests them, with `name=""` so that their flags have no prefix.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

from ..cluster.engine import ClusterSettings
from ..config import Config
from ..datasets import (
    FORMATS,
    Dataset,
    american,
    format_options,
    known_format,
    open_dataset,
    parse_options,
)
from ..datasets.doctor.fix import read_fix
from ..errors import DatasetError, InputError
from ..results.record import ColorRecord, Source
from ..tracking import Mode
from .color_camera import AUTO, ColorChoice

logger = logging.getLogger(__name__)
FORMAT_DEFAULT = "(default: the format's)"
OPTIONAL = "(optional)"
DETAIL = "color_detail"


def _folder(words: list[str]) -> Path:
    if not words[0]:  # an unset variable of a shell; as a path it would be the current folder
        raise ValueError("the name of a folder is empty; write . for the current one")
    return Path(words[0])


FOLDER = PrimitiveConstructorSpec(
    nargs=1,
    metavar="DIR",
    instance_from_str=_folder,
    is_instance=lambda value: isinstance(value, Path),
    str_from_instance=lambda path: [str(path)],
)
ONE_EACH = "(give it once for each)"

Settings = Annotated[Config, arg(name="")]
UpOption = Annotated[
    str | None, arg(metavar="X,Y,Z", help_behavior_hint="(default: from the floor; write --up=-y)")
]
Device = Literal["auto", "cuda", "cpu"]


@dataclass(frozen=True)
class RecordingOptions:
    """Which frames of which recording, and how to read it."""

    format: Annotated[
        Positional[str],
        arg(
            metavar="FORMAT",
            help=f"The kind of recording: {', '.join(FORMATS)}; or auto, which looks at the files.",
        ),
    ]
    path: Annotated[
        Positional[Path | None],
        arg(metavar="[PATH]", help_behavior_hint="(synthetic and live cameras need none)"),
    ] = None
    """Where the recording lies."""
    start: Annotated[int, arg(metavar="A")] = 0
    """First frame, counted from 0."""
    end: Annotated[int | None, arg(metavar="B", help_behavior_hint="(default: all)")] = None
    """Frame to stop before."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Use every N-th frame."""
    option: Annotated[
        UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE", help_behavior_hint=ONE_EACH)
    ] = ()
    """Another option of the format, as align=color for k4a; a wrong one lists them."""
    depth_scale: Annotated[float | None, arg(metavar="S", help_behavior_hint=FORMAT_DEFAULT)] = None
    """Units of the depth images that make a metre."""
    drop_alpha: FlagCreatePairsOff[bool] = False
    """Accept colour images with a fourth channel and ignore it."""
    max_difference: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint=FORMAT_DEFAULT)
    ] = None
    """How far time stamps of depth, colour and pose may be apart (tum, folder, k4a, rosbag, realsense)."""
    camera_path: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(scene needs one)")
    ] = None
    """Poses to render a scene from: lines 'timestamp tx ty tz qx qy qz qw', camera to world."""
    intrinsics: Annotated[
        str | None, arg(metavar="FX,FY,CX,CY", help_behavior_hint="(default: the recording's)")
    ] = None
    """Intrinsics of the depth images, in pixels."""
    pose_reading: Annotated[
        str | None, arg(metavar="WORDS", help_behavior_hint="(default: c2w)")
    ] = None
    """How the recording's poses are written, as w2c, opengl or w-first+w2c; a wrong one lists the words."""
    pose_scale: Annotated[
        float | None, arg(metavar="METRES", help_behavior_hint="(default: 1)")
    ] = None
    """Metres in a unit of the poses' translations: 0.01 where they are centimetres."""
    project_poses: FlagCreatePairsOff[bool] = False
    """Take the nearest rotation where a pose's is none (scaled, sheared), instead of skipping its frame."""
    clock_offset: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: 0)")
    ] = None
    """Seconds to add to a frame's time stamp before its pose is looked up."""
    fix: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Answers on this recording: `unifusion check` writes them there, other commands take them; options
    given here count more.
    """
    color_camera: ColorChoice = AUTO
    """Where the colour camera stands. auto: found from the frames, and used if colour then fits depth better in
    frames left out; FILE: your calibration; kinect: a Kinect's nominal one; none: colour as recorded.
    """
    strict: FlagCreatePairsOff[bool] = False
    """Stop at the first frame that cannot be used, instead of skipping it."""

    @cached_property
    def kind(self) -> str:
        """The format, and of "auto" the one that the files are of; DatasetError where none is."""
        return known_format(self.format, self.path)


@dataclass(frozen=True)
class TrackingOptions:
    """Where camera poses come from."""

    tracking: Annotated[
        Mode | None,
        arg(
            help_behavior_hint="(default: given; rgbd for a sensor's file without poses beside it)"
        ),
    ] = None
    """Camera poses. given: the recording's; external: from --trajectory; internal: either of them,
    refined; rgbd: from the frames alone."""
    trajectory: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Poses of another program: a file of TUM, KITTI, Replica, COLMAP (images.txt, images.bin), EuRoC
    (data.csv), Redwood or Open3D (.log, .json), a transforms.json, or a folder of one matrix a frame.
    """
    body_camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Where the camera sits on the body of EuRoC's poses: its sensor.yaml (T_BS), or 4 rows of 4 numbers."""
    interpolate: FlagCreatePairsOff[bool] = False
    """Fill gaps of up to a second between the poses of --trajectory."""
    tracking_passes: Literal[1, 2] = 2
    """2: all frames are tracked before any is mapped; 1: frames are tracked and mapped as they come, and the map
    follows when a loop moves them.
    """

    @property
    def tracked(self) -> bool:
        """Whether poses come from elsewhere than the recording, or are meant to."""
        return self.mode != "given" or self.trajectory is not None or self.interpolate

    @property
    def mode(self) -> Mode:
        """What was asked for, else the recording's poses."""
        return self.tracking or "given"

    def for_recording(self, recording: Dataset) -> TrackingOptions:
        """The same with a mode: a sensor's own file holds no poses, so that they are found from its frames
        where nothing else was asked for, which is said.
        """
        if self.tracking or self.tracked or not recording.sensor_alone:
            return replace(self, tracking=self.mode)
        logger.info(
            "tracking: a sensor's file holds no poses and none lie beside it, so they are found from the frames "
            "(--tracking given takes what there is)"
        )
        return replace(self, tracking="rgbd")


@dataclass(frozen=True)
class OutputOptions:
    """Where the results of a run go, and what its settings begin with."""

    out: Annotated[Path, FOLDER]
    """Folder for the results; made where it does not exist. The results of an earlier run in it are
    replaced once this one is done, which is said; other files stay.
    """
    into: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint=OPTIONAL)] = None
    """Add the recording to the map of an earlier run: the camera finds its place in it, or the run ends with
    a sentence. Results go to --out, which leaves that map as it is; without --out to DIR itself.
    """
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace files that stand in the way and that no run is known to have written."""
    resume: FlagCreatePairsOff[bool] = False
    """Go on with a run of the same options that was ended in this folder, whatever ended it."""
    save_every: Annotated[float, arg(metavar="SECONDS")] = 60.0
    """Time between safe points to go on from, which take a twentieth of the time at most; 0: none."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """YAML file of settings that differ from the defaults; options given here count more."""
    json: FlagCreatePairsOff[bool] = False
    """Print the metrics as JSON instead of tables."""
    keep_windows: FlagCreatePairsOff[bool] = False
    """Keep what the maps were fused from (windows.log), so that `unifusion repose` can move them to other poses."""
    forget: FlagCreatePairsOff[bool] = False
    """Keep no windows.log of a run in one pass: some megabytes for every second of the recording."""
    up: UpOption = None
    """Which way is up in the world: an axis as z or -y, or three numbers."""


class RunOptions(Protocol):
    """What decides what a run does: the options of a command that makes maps."""

    @property
    def recording(self) -> RecordingOptions: ...
    @property
    def poses(self) -> TrackingOptions: ...
    @property
    def output(self) -> OutputOptions: ...
    @property
    def settings(self) -> Config: ...
    @property
    def cluster(self) -> ClusterSettings: ...


@dataclass(frozen=True)
class EncoderOptions:
    """What turns words into vectors, for questions to a map of features."""

    text: Annotated[
        str | None,
        arg(metavar="ENCODER", help_behavior_hint="(default: the one that made the features)"),
    ] = None
    """Text encoder: clip:MODEL, onnx:FILE.onnx, or embeddings:FILE (.npz, or .npy with --names)."""
    names: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Names of the vectors of an embeddings file: .txt, .csv or .json."""
    tokenizer: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """CLIP's byte-pair merges, for a text encoder in an ONNX file."""
    template: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="TEXT", help_behavior_hint="(default: five; give it once for each)"),
    ] = ()
    """What a name is put into, at its {}, such as 'a photo of a {}'; embeddings are averaged over
    templates.
    """
    download: FlagCreatePairsOff[bool] = False
    """Allow a CLIP model to be fetched from the Hugging Face hub; without it only what lies on this
    machine is used.
    """
    device: Device = "auto"
    """Where to compute."""


@dataclass(frozen=True)
class TextOptions(EncoderOptions):
    """What turns words into vectors, and how answers are printed."""

    json: FlagCreatePairsOff[bool] = False
    """Print JSON instead of tables."""


@dataclass(frozen=True)
class ScoreOptions:
    """Where the numbers of an evaluation go."""

    json: FlagCreatePairsOff[bool] = False
    """Print the numbers as JSON instead of a table."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Write the numbers there too, as JSON."""


def open_recording(options: RecordingOptions) -> Dataset:
    """All frames from --start to --end, whatever --every says; raises DatasetError if there are
    none.
    """
    recording = open_dataset(options.kind, options.path, **reading_options(options))
    asked = frames_asked(recording, options.start, options.end, options.every)
    return recording[asked.start : options.end]


def for_mapping(options: RecordingOptions) -> RecordingOptions:
    """The same for who maps: pixels of a phone's depth, beside which colour is large, are divided where
    they are coarse, unless `color_detail` says otherwise.
    """
    given = {american(text.partition("=")[0]) for text in options.option}
    if DETAIL in given or DETAIL not in format_options(options.kind):
        return options
    return replace(options, format=options.kind, option=(*options.option, f"{DETAIL}=0"))


def source_of(options: RecordingOptions, frames: int, color: ColorRecord | None = None) -> Source:
    """What the record of a run keeps of the recording; `frames` were asked for."""
    return Source(
        format=options.kind,
        path=str(options.path or ""),
        start=options.start,
        end=options.end,
        every=options.every,
        reading={
            name: str(value) if isinstance(value, Path) else value
            for name, value in reading_options(options).items()
        },
        frames=frames,
        color=color,
    )


def reading_options(options: RecordingOptions) -> dict[str, Any]:
    """Options for `open_dataset`: those that were given."""
    flags = {
        "depth_scale": options.depth_scale,
        "max_difference": options.max_difference,
        "drop_alpha": options.drop_alpha or None,
        "trajectory": options.camera_path,
        "intrinsics": options.intrinsics,
        "pose_reading": options.pose_reading,
        "pose_scale": options.pose_scale,
        "project_poses": options.project_poses or None,
        "clock_offset": options.clock_offset,
    }
    given = {name: value for name, value in flags.items() if value is not None}
    if options.fix is not None:
        given = {**read_fix(options.fix).recording, **given}
    if options.camera_path is not None and "trajectory" not in format_options(options.kind):
        raise InputError(f"--camera-path: format '{options.kind}' has poses of its own; drop it")
    return merged_options(options.kind, given, options.option)


def merged_options(format: str, given: dict[str, Any], texts: tuple[str, ...]) -> dict[str, Any]:
    """Options given by flags of their own together with those of --option; InputError for one that
    is given in both ways.
    """
    more = parse_options(format, texts) if texts else {}
    for name in more:
        if name in given:
            raise InputError(f"option '{name}' is given twice, once with --option")
    return {**given, **more}


def frames_asked(recording: Dataset, start: int, end: int | None, every: int) -> range:
    """Places of the frames that are asked for; InputError where these make no sense, DatasetError
    where there are none.
    """
    if start < 0 or every < 1 or (end is not None and end <= start):
        raise InputError(
            f"frames: need 0 <= start < end and every >= 1, got start {start}, end {end}, every {every}"
        )
    asked = range(len(recording))[start:end:every]
    if not asked:
        raise DatasetError(
            f"{recording.name}: there is no frame {start}, it has {len(recording)} (0 is the first)"
        )
    return asked
