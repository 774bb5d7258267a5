"""What a results folder, a map file or a mesh holds, read and checked without starting Taichi."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..cli.terminal import format_bytes, format_table
from ..errors import FileError, MapCorrupt, UniFusionError
from ..files.atomic import read_bytes
from ..files.maps import read_map
from ..files.mesh_reading import read_mesh

MAP_COLUMNS = ["map", "kind", "voxels", "voxel size", "file", "encoder", "fusion", "version"]


@dataclass(frozen=True)
class Inspection:
    """Tables to read, and the error of every file that is damaged."""

    text: str
    problems: tuple[UniFusionError, ...]


def inspect(path: Path) -> Inspection:
    """Describe a results folder, a map file or a PLY mesh; raises FileError where there is nothing
    to describe.
    """
    if path.is_dir():
        maps, mesh, metrics = (
            sorted((path / "maps").glob("*.safetensors")),
            path / "mesh.ply",
            path / "metrics.json",
        )
        if not (maps or mesh.exists() or metrics.exists()):
            raise FileError(
                f"{path}: holds no results; expected maps/*.safetensors, mesh.ply or metrics.json"
            )
    elif not path.exists():
        raise FileError(f"{path}: no such file or folder")
    elif path.suffix.lower() == ".ply":
        maps, mesh, metrics = [], path, None
    else:
        maps, mesh, metrics = [path], None, None
    problems: list[UniFusionError] = []

    def attempt(describe: Callable, file: Path | None):
        try:
            return describe(file) if file and file.exists() else None
        except UniFusionError as error:
            problems.append(error)
            return None

    rows = [row for row in (attempt(_describe_map, file) for file in maps) if row]
    texts = [
        format_table([MAP_COLUMNS, *rows]) if rows else None,
        attempt(_describe_mesh, mesh),
        attempt(_describe_run, metrics),
    ]
    return Inspection("\n\n".join(text for text in texts if text), tuple(problems))


def _describe_map(file: Path) -> list[str]:
    """A row of MAP_COLUMNS, after the checksums were found right."""
    tensors, manifest = read_map(file)
    try:
        settings, encoder = manifest["settings"], manifest["settings"]["encoder"]
        kind = f"{manifest['kind']}, {manifest['channels']} channel{'s' if manifest['channels'] > 1 else ''}"
        return [
            manifest["name"],
            kind,
            f"{len(tensors['keys']):,}",
            f"{100 * settings['voxel_size']:g} cm",
            format_bytes(file.stat().st_size),
            f"Matern-7/2, rank {encoder['rank']} of {encoder['anchors']}, seed {encoder['seed']}",
            settings["fusion"],
            str(manifest["format_version"]),
        ]
    except (KeyError, TypeError) as error:
        raise MapCorrupt(
            f"{file}: its manifest does not describe a map ({error}); write it again"
        ) from error


def _describe_mesh(file: Path) -> str:
    mesh = read_mesh(file)
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
    try:
        metrics = json.loads(read_bytes(file))
        frames, versions = metrics["frames"], metrics["versions"]
        return "\n".join(
            [
                *([_describe_recording(metrics["recording"])] if "recording" in metrics else []),
                f"frames  {frames['used']} used, {frames['skipped']} skipped{', stopped early' if frames['interrupted'] else ''}",
                f"made    by taichi_unifusion {versions['taichi_unifusion']} on {metrics['device_name']}, "
                f"{metrics['milliseconds']['frame']['median']:.0f} ms a frame (median)",
            ]
        )
    except (ValueError, KeyError, TypeError) as error:
        raise FileError(f"{file}: not the metrics of a run, or a damaged file ({error})") from None


def _describe_recording(recording: dict[str, object]) -> str:
    source = f"{recording['format']} {recording['path']}".rstrip()
    last = "the last" if recording["end"] is None else int(recording["end"]) - 1
    steps = f" in steps of {recording['every']}" if recording["every"] != 1 else ""
    return f"from    {source}, frames {recording['start']} to {last}{steps}"
