"""`unifusion convert`: any recording -> the files of a `folder`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from .color_camera import given_color
from .interrupts import INTERRUPTED, stop_on_signal
from .options import FORMAT_DEFAULT, RecordingOptions, open_recording
from .terminal import DONE, frame_progress

logger = logging.getLogger(__name__)
SHOWN = 3  # sentences on frames that were left out


@dataclass(frozen=True)
class Convert:
    """Write a recording of any format as plain files: PNG images, camera.yaml, poses.txt.

    Example: unifusion convert rosbag robot.bag --out my_recording

    The format 'folder' reads them back, as do other programs: depth is 16 bits, colour is registered to
    depth, or lies beside its own color_camera.yaml.
    """

    recording: Annotated[RecordingOptions, arg(name="")]
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder to write; it must not exist yet, or be empty. It appears when everything is written."""
    units: Annotated[float | None, arg(metavar="S", help_behavior_hint=FORMAT_DEFAULT)] = None
    """Units a metre of the depth images that are written, 1000 for millimetres."""


def convert(options: Convert) -> int:
    """Frames -> files."""
    from ..datasets.folder_writing import write_folder

    recording = open_recording(options.recording)
    recording, _ = given_color(recording, options.recording.color_camera)
    for sentence in recording.warnings:
        logger.warning("%s", sentence)
    frames = recording[:: options.recording.every]
    with (
        stop_on_signal(clean_up=lambda: None) as stop,
        frame_progress(len(frames)) as on_frame,
    ):
        written = write_folder(
            frames, options.out, depth_scale=options.units, stop=stop, on_frame=on_frame
        )
    for sentence in written.skipped[:SHOWN]:
        logger.warning("frame left out: %s", sentence)
    if len(written.skipped) > SHOWN:
        logger.warning("%d more frames were left out", len(written.skipped) - SHOWN)
    if written.resampled:
        logger.warning(
            "%d frames have another camera than the first one and were resampled to it",
            written.resampled,
        )
    named = "their time stamps" if written.named_by_time else "number"
    print(
        f"{written.path}: {written.frames} of {len(frames)} frames, {written.poses} with a pose, named by {named}; "
        f"depth has {written.depth_scale:g} units a metre\n"
        f"unifusion reconstruct folder {written.path} --out results/NAME   maps it"
    )
    return INTERRUPTED if written.stopped else DONE
