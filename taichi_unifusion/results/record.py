"""What a run did, as frozen values that metrics.json keeps: one writer, one reader, one version."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from ..errors import FileError, InputError, convert, shortened
from ..files.atomic import read_bytes, write_text
from ..files.json_text import parse_json

D = TypeVar("D")

UNFINISHED = "unfinished"  # stands in a file that is there while a run writes
SCHEMA_VERSION = 1  # files without a number are older, and are read as version 1


@dataclass(frozen=True)
class ColorRecord:
    """Which colour camera the images were registered with, and why."""

    choice: str  # as asked for: auto, kinect, none or a file
    camera: Mapping[str, Any] | None = None  # a ColorCamera as values; None: colour as recorded
    verdict: str = ""
    gain_db: float | None = None  # of an estimate, on frames left out
    frames: int = 0  # how many these were


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which frames of which recording were asked for, and how it was opened."""

    format: str
    path: str  # empty for a recording that needs none
    start: int
    end: int | None  # None: to the last frame
    every: int
    # options of `open_dataset` as JSON values
    reading: Mapping[str, Any] = field(default_factory=dict)
    frames: int  # how many these are
    color: ColorRecord | None = None  # None: as the recording gives it
    before: tuple[
        Source, ...
    ] = ()  # others that the map is made from: it was added to them, or merged

    @property
    def asked(self) -> range:
        """The frames asked for, by their place in the recording."""
        return range(self.start, self.start + self.frames * self.every, self.every)


@dataclass(frozen=True)
class SkipReason:
    """A kind of trouble, how many frames had it, and what was said of the first."""

    reason: str
    frames: int
    first: str


@dataclass(frozen=True)
class Skipped:
    """A frame that was not used, by its place in the recording, and why."""

    frame: int
    message: str


@dataclass(frozen=True)
class Lacking:
    """Frames that were used but gave nothing to one of the maps, and what was said of the first."""

    frames: tuple[int, ...]  # by their place in the recording
    first: str


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """What became of the frames."""

    used: int
    skipped: int
    interrupted: bool  # asked to stop before the last frame
    reasons: tuple[SkipReason, ...] = ()
    skipped_frames: tuple[Skipped, ...]
    # by the map that was left out: color, features, a property
    without: Mapping[str, Lacking] = field(default_factory=dict)


@dataclass(frozen=True)
class Milliseconds:
    """Time that a stage takes for one frame, once its kernels are compiled."""

    median: float
    mean: float


@dataclass(frozen=True)
class Seconds:
    """Where the time of the whole run went."""

    frames: float
    mesh: float
    write: float
    first_frame: float = 0.0  # of `frames`, the first one, with the compilation of kernels


@dataclass(frozen=True)
class PointCounts:
    """Points of the frames after preprocessing."""

    median: float
    total: int


@dataclass(frozen=True)
class MapRecord:
    """The size of a map."""

    voxel_size: float  # [m]
    voxels: int
    bytes: int  # of memory
    file_bytes: int


@dataclass(frozen=True)
class PropertyRecord:
    """How a property's values were coloured, and how many frames gave it."""

    frames: int
    label: str
    colormap: str
    range: tuple[float, float] | None  # None: there are no values


@dataclass(frozen=True)
class MeshRecord:
    """The size of the mesh."""

    vertices: int
    triangles: int


@dataclass(frozen=True)
class ViewRecord:
    """A camera that pictures of the mesh are drawn from."""

    size: tuple[int, int]  # width, height [pixels]
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy [pixels]
    T_world_camera: tuple[tuple[float, ...], ...]  # (4, 4)
    near: float  # [m] nothing nearer is drawn


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What a run did, with what, and how long it took."""

    recording: Source | None = None  # None: the frames came from a program
    # mode, verdicts and what else the tracker says; None: the poses are the recording's own
    tracking: Mapping[str, Any] | None = None
    device: str = ""
    device_name: str
    frames: FrameCounts
    milliseconds: Mapping[str, Milliseconds]  # by stage, and of a whole frame
    seconds: Seconds = field(default_factory=lambda: Seconds(0.0, 0.0, 0.0))
    points: PointCounts = field(default_factory=lambda: PointCounts(0, 0))
    maps: Mapping[str, MapRecord] = field(default_factory=dict)
    properties: Mapping[str, PropertyRecord] = field(default_factory=dict)
    mesh: MeshRecord | None = None
    # (4, 4) from the world to one with z up and the floor, where it is known, at z = 0; None: not known
    T_up_world: tuple[tuple[float, ...], ...] | None = None
    up: str = ""  # how that was found, one of geometry.gravity.How
    views: tuple[ViewRecord, ...] = ()  # of preview.png and the pictures of properties
    peak_memory_bytes: int = 0
    files: Mapping[str, int] = field(default_factory=dict)  # sizes [bytes]
    answers: tuple[str, ...] = ()  # files of questions asked since
    earlier_files: tuple[str, ...] = ()  # of runs before, where this one could not write all
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # those of the warnings that make the whole result doubtful
    errors: tuple[str, ...] = ()
    versions: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """The record as JSON values; what there is none of, a recording or tracking, is left out."""
        values = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        return {
            name: value
            for name, value in values.items()
            if value is not None or name not in ("recording", "tracking")
        }

    @classmethod
    def from_json(cls, values: Any) -> RunRecord:
        """The record that `to_json` gave; raises InputError where the values are no record, or a
        newer one.
        """
        version = values.get("schema_version", SCHEMA_VERSION) if isinstance(values, dict) else None
        if type(version) is int and version > SCHEMA_VERSION:
            raise InputError(
                f"the record of a run of version {version}, this program reads up to version {SCHEMA_VERSION}; "
                "update taichi_unifusion"
            )
        try:
            return _decode(cls, values, "")
        except InputError as error:
            raise InputError(f"not the metrics of a run, or a damaged file ({error})") from None


def write_record(path: Path, record: RunRecord) -> None:
    """Write a record atomically; raises FileError."""
    write_text(path, json.dumps(record.to_json(), indent=2) + "\n")


def read_record(path: Path) -> RunRecord:
    """Read a record; raises FileError where it is missing, damaged or of a newer version."""
    try:
        values = parse_json(read_bytes(path))
    except ValueError as error:
        raise FileError(f"{path}: not the metrics of a run, or a damaged file ({error})") from None
    if isinstance(values, dict) and values.get(UNFINISHED):
        raise FileError(
            f"{path}: the run that wrote here was ended before it was done, or still writes; files of an "
            "earlier one may lie beside its own: run it again"
        )
    try:
        return RunRecord.from_json(values)
    except InputError as error:
        raise FileError(f"{path}: {error}") from None


def decoded(wanted: type[D], values: Any) -> D:
    """JSON values as a frozen dataclass; raises InputError that names what does not fit."""
    return _decode(wanted, values, "")


def _decode(wanted: Any, value: Any, at: str) -> Any:
    """JSON values as the type `wanted`; keys that it does not know are left out."""
    origin, options = get_origin(wanted), get_args(wanted)
    if wanted is Any:
        return value
    if NoneType in options:
        return None if value is None else _decode(options[0], value, at)
    if is_dataclass(wanted):
        return _decode_fields(wanted, _named_values(value, at), at)
    if origin is Mapping:
        return {
            name: _decode(options[1], item, f"{at}.{name}")
            for name, item in _named_values(value, at).items()
        }
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(f"{at}: expected a list, got {shortened(value)}")
        if options[-1] is not Ellipsis and len(value) != len(options):
            raise InputError(f"{at}: expected {len(options)} values, got {len(value)}")
        return tuple(_decode(options[0], item, f"{at}[{i}]") for i, item in enumerate(value))
    return convert(value, wanted, at)


def _decode_fields(wanted: Any, values: dict[str, Any], at: str) -> Any:
    types, given = get_type_hints(wanted), {}
    for each in fields(wanted):
        if each.name in values:
            here = f"{at}.{each.name}" if at else each.name
            given[each.name] = _decode(types[each.name], values[each.name], here)
        elif each.default is each.default_factory is MISSING:
            raise InputError(f"{at or 'the file'}: '{each.name}' is missing")
    return wanted(**given)


def _named_values(value: Any, at: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{at or 'the file'}: expected names and values, got {shortened(value)}")
    return value
