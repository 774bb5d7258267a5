"""The end of a run in some lines, for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .record import FrameCounts, RunRecord
from .tables import format_bytes, format_table

HOW = {  # how up was found
    "floor": "the floor's normal",
    "given": "given",
    "recording": "as the recording says",
    "convention": "the axis that the cameras are level to",
    "cameras": "a guess, the mean of the cameras' own",
    "guess": "a guess",
}


def summarize(record: RunRecord, files: Sequence[str], directory: Path) -> str:
    """What a run did, and the files that it wrote."""
    frames, seconds, mesh = record.frames, record.seconds, record.mesh
    stages = [["stage", "median ms", "mean ms"]]
    stages += [
        [stage, f"{time.median:.1f}", f"{time.mean:.1f}"]
        for stage, time in record.milliseconds.items()
    ]
    maps = [["map", "voxels", "voxel size", "memory"]]
    maps += [
        [
            name,
            f"{size.voxels:,}",
            f"{100 * size.voxel_size:g} cm",
            format_bytes(size.bytes),
        ]
        for name, size in record.maps.items()
    ]
    lines = [
        *tracking_lines(record.tracking),
        *color_lines(record),
        f"frames   {count_frames(frames)}",
    ]
    lines += [
        f"           {entry.frames} {entry.reason} (first: {entry.first})"
        for entry in frames.reasons
    ]
    lines += [
        f"           {len(entry.frames)} without {name} (first: {entry.first})"
        for name, entry in frames.without.items()
    ]
    lines += ["", format_table(stages)]
    if frames.used == 1:  # with more, the first is left out of the table
        lines.append("kernels were compiled for this frame: further ones take a fraction of that")
    lines += ["", format_table(maps), ""]
    if mesh:
        lines.append(f"mesh     {mesh.vertices:,} vertices, {mesh.triangles:,} triangles")
    lines.append(f"origin   {describe_origin(record)}")
    if record.T_up_world is not None:
        lines.append(f"up       {describe_up(record)}")
    lines += [
        f"time     {seconds.frames:.1f} s for the frames ({seconds.first_frame:.1f} s for the first, which "
        f"compiles kernels), {seconds.mesh:.1f} s for the mesh, {seconds.write:.1f} s to write",
        f"memory   {format_bytes(record.peak_memory_bytes)} at most, on {record.device_name}",
        f"results  {directory}: {', '.join(files)}",
    ]
    lines += [f"doubtful {sentence}" for sentence in record.doubts]
    return "\n".join(lines)


def count_frames(frames: FrameCounts) -> str:
    """How many frames were used, how many of these lack something, and how many were not."""
    lacking = ", ".join(
        f"{len(each.frames)} without {name}" for name, each in frames.without.items()
    )
    lacking = f" ({lacking})" if lacking else ""
    stopped = ", stopped early" if frames.interrupted else ""
    return f"{frames.used} used{lacking}, {frames.skipped} skipped{stopped}"


def describe_origin(record: RunRecord) -> str:
    """Where x = y = z = 0 is, and which way the axes point."""
    tracking = record.tracking or {}
    if "joined" in tracking:
        return f"that of {tracking['joined']['into']}, to which the recording was added"
    recording = f"the {'first ' if 'merged' in tracking else ''}recording"
    if tracking.get("mode") == "rgbd" and "reposed" not in tracking:
        return (  # rgbd.T_WORLD_FIRST
            f"the first camera of {recording} that was tracked: x to its right, y forwards, z up if "
            "it was held level"
        )
    poses = tracking.get("reposed") or tracking.get("trajectory") or recording
    return f"where the poses of {poses} have it"


def describe_up(record: RunRecord) -> str:
    """Which way is up, and how that was found."""
    direction = " ".join(f"{number:.2f}" for number in (record.T_up_world or ((),) * 3)[2][:3])
    return f"{direction} ({HOW.get(record.up, record.up)})"


def color_lines(record: RunRecord) -> list[str]:
    """Which colour camera images were registered with, where that is not plain."""
    color = record.recording.color if record.recording else None
    return [f"colour   {color.verdict}"] if color and color.camera else []


def tracking_lines(tracking: Mapping[str, Any] | None) -> list[str]:
    """How the poses were found, where they were."""
    if not tracking:
        return []
    joined = tracking.get("joined")
    added = (
        [f"added    to {joined['into']}: {joined['said']}"]  # where the camera found its place
        if joined
        else []
    )
    if "verdicts" not in tracking:
        return added
    counts = ", ".join(f"{count} {verdict}" for verdict, count in tracking["verdicts"].items())
    found = [f"{tracking[name]} {name}" for name in ("keyframes", "loops") if name in tracking]
    return [
        f"tracking {tracking['mode']}: {counts}{'; ' if found else ''}{', '.join(found)} ({tracking['seconds']:.1f} s)",
        *added,
    ]
