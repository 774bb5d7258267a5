"""What a results folder, a map file or a mesh holds, read and checked without starting Taichi."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ..errors import FileError, MapCorrupt, UniFusionError
from ..files.mesh_reading import read_any_mesh
from ..files.tiles import TileFolder, map_bytes
from ..maps.settings import FeatureSettings
from ..maps.stored import MapDescription, describe_tiles, read_stored, read_tile
from ..maps.tile_places import code_of, key_codes
from .lock import who_writes
from .ownership import answer_files
from .record import Source, read_record
from .run_folder import RunFolder
from .safe_point import read_state
from .summary import count_frames, describe_origin, describe_up
from .tables import format_bytes, format_table

T = TypeVar("T")

MESHES = (".ply", ".glb", ".obj")
MAP_COLUMNS = ["map", "kind", "voxels", "voxel size", "file", "encoder", "fusion", "version"]


@dataclass(frozen=True)
class Inspection:
    """Tables to read, and the error of every file that is damaged."""

    text: str
    problems: tuple[UniFusionError, ...]


def inspect(path: Path) -> Inspection:
    """Describe a results folder, a map file or a mesh; raises FileError where there is nothing to
    describe.
    """
    if path.is_dir() and not TileFolder.is_one(path):
        folder = RunFolder(path)
        maps, mesh, record = list(folder.maps.values()), folder.mesh, folder.record
        maps += folder.safe_maps
        if not (maps or mesh.exists() or record.exists()):
            raise FileError(
                f"{path}: holds no results; expected {folder.relative(folder.map('*'))}, {mesh.name} or {record.name}"
            )
    elif not path.exists():
        raise FileError(f"{path}: no such file or folder")
    elif path.suffix.lower() in MESHES:
        maps, mesh, record = [], path, None
    else:
        maps, mesh, record = [path], None, None
    problems: list[UniFusionError] = []

    def attempt(describe: Callable[[Path], T], file: Path | None) -> T | None:
        try:
            return describe(file) if file and file.exists() else None
        except UniFusionError as error:
            problems.append(error)
            return None

    checked = {file: attempt(_checked, file) for file in maps}
    stored = {file: each for file, each in checked.items() if each}
    empty = {file for file in stored if record is not None and not stored[file].voxels}
    empty &= set(RunFolder(path).safe_maps)  # of a run whose windows wait
    rows = [_describe_map(file, each) for file, each in stored.items() if file not in empty]
    texts = [
        format_table([MAP_COLUMNS, *rows]) if rows else None,
        _describe_features(list(stored.values())),
        attempt(_describe_mesh, mesh),
        attempt(_describe_run, record),
    ]
    if path.is_dir():
        texts.append(_describe_answers(RunFolder(path)))
        texts.append(_describe_foreign(RunFolder(path)))
        texts.append(attempt(_describe_unfinished, RunFolder(path).state))
        texts.append(_describe_writer(RunFolder(path)))
        problems += _find_mixed(RunFolder(path))
    return Inspection("\n\n".join(text for text in texts if text), tuple(problems))


def _describe_map(file: Path, stored: MapDescription) -> list[str]:
    """A row of MAP_COLUMNS."""
    settings, encoder = stored.settings, stored.settings.encoder
    return [
        stored.name,
        f"{stored.kind}, {stored.channels} channel{'s' if stored.channels > 1 else ''}",
        f"{stored.voxels:,}",
        f"{100 * settings.voxel_size:g} cm",
        _size(file),
        f"Matern-7/2, rank {encoder.rank} of {encoder.anchors}, seed {encoder.seed}",
        settings.fusion,
        str(stored.version),
    ]


def _describe_features(maps: Sequence[MapDescription]) -> str | None:
    """Where image-text features come from, and which text encoder belongs to them."""
    sources = dict.fromkeys(
        each.source for each in maps if isinstance(each.settings, FeatureSettings)
    )
    lines = []
    for source in sources:
        if source.startswith("clip:"):
            texts = f"the text encoder of {source}, which `query` takes unless told otherwise"
        else:
            texts = "that of the network that made them: `query DIR TEXT --text ENCODER`"
        lines.append(f"features from {source or 'an unknown network'}; text encoder: {texts}")
    return "\n".join(lines) or None


def _describe_answers(folder: RunFolder) -> str | None:
    """The files of questions that were put to the maps."""
    files = ", ".join(map(folder.relative, answer_files(folder)))
    return f"answers {files}" if files else None


def _describe_foreign(folder: RunFolder) -> str | None:
    """The safetensors files of others that lie among the maps."""
    files = ", ".join(map(folder.relative, folder.foreign_maps))
    return f"no map  {files}: written by another program, left alone" if files else None


def _checked(file: Path) -> MapDescription:
    """What a map is, once everything was checked that loading it would; of one in tiles one tile is read
    at a time.
    """
    if not TileFolder.is_one(file):
        return read_stored(file)[0]
    folder = TileFolder.open(file)
    for tile in folder.tiles:
        strangers = key_codes(read_tile(folder, tile).keys) != code_of(tile)
        if strangers.any():
            raise MapCorrupt(
                f"{file / folder.tiles[tile].file}: holds voxels of another tile than {tile}; integrate the "
                "frames again"
            )
    return describe_tiles(folder)


def _size(file: Path) -> str:
    """Bytes of a map on disk, and its tiles."""
    size = format_bytes(map_bytes(file))
    if not TileFolder.is_one(file):
        return size
    return f"{size} in {len(TileFolder.open(file).tiles)} tiles"


def _describe_unfinished(file: Path) -> str | None:
    """How far a run was that is not done."""
    folder = RunFolder(file.parents[1])
    if (state := read_state(folder)) is None:
        return None
    text = (
        f"ended   {state.done} of {state.recipe.recording.frames} frames are safe in "
        f"{folder.relative(folder.unfinished)}/: the same command with --resume goes on from there"
    )
    if state.windows is None or not (waiting := state.windows.waiting):
        return text
    return (
        f"{text}\nwaiting {waiting} window{'s' if waiting > 1 else ''} of frames, which the maps take in at "
        "the end, when poses are final; `unifusion view` fuses them to show them"
    )


def _describe_writer(folder: RunFolder) -> str | None:
    """Who writes into the folder now, if somebody does."""
    holder = who_writes(folder)
    return None if holder is None else f"writing {holder}"


def _find_mixed(folder: RunFolder) -> list[UniFusionError]:
    """Files that are not those of the run that the record tells of."""
    try:
        record = read_record(folder.record)
    except FileError:  # described already, or there is none
        return []
    there = {name: folder.path / name for name in record.files if folder.could_write(name)}
    sizes = {name: file.stat().st_size for name, file in there.items() if file.is_file()}
    changed = [name for name, size in sizes.items() if size != record.files[name]]
    problems: list[UniFusionError] = [
        FileError(
            f"{folder.path / name}: holds {sizes[name]:,} bytes, not the {record.files[name]:,} that "
            f"{folder.record.name} says: something else has written it since"
        )
        for name in changed
    ]
    if record.earlier_files:
        problems.append(
            FileError(
                f"{folder.path}: {', '.join(record.earlier_files)} "
                f"{'are' if len(record.earlier_files) > 1 else 'is'} of an earlier run, since this one could "
                "not write all of its own"
            )
        )
    return problems


def _describe_mesh(file: Path) -> str:
    mesh = read_any_mesh(file)
    carries = ["normals"] * (mesh.normals is not None) + list(mesh.attributes)
    text = (
        f"mesh    {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, "
        f"with {', '.join(carries) or 'neither normals nor colour'}"
    )
    if not len(mesh.vertices):
        return text
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return f"{text}; {' x '.join(f'{size:.2f}' for size in high - low)} m; {format_bytes(file.stat().st_size)}"


def _describe_run(file: Path) -> str:
    record = read_record(file)
    lines = [] if record.recording is None else [_describe_recording(record.recording)]
    if record.recording and (color := record.recording.color) and color.camera:
        lines.append(f"colour  {color.verdict}")
    lines.append(f"frames  {count_frames(record.frames)}")
    made = f"made    by taichi_unifusion {record.versions.get('taichi_unifusion', '?')} on {record.device_name}"
    if frame := record.milliseconds.get("frame"):
        made += f", {frame.median:.0f} ms a frame (median)"
    lines.append(made)
    lines.append(f"origin  {describe_origin(record)}")
    if record.T_up_world is not None:
        lines.append(f"up      {describe_up(record)}")
    return "\n".join(lines)


def _describe_recording(source: Source) -> str:
    last = "the last" if source.end is None else source.end - 1
    steps = f" in steps of {source.every}" if source.every != 1 else ""
    return f"from    {f'{source.format} {source.path}'.rstrip()}, frames {source.start} to {last}{steps}"
