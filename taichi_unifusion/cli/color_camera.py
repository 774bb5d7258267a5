"""`--color-camera`: which colour camera a recording's images are registered with."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from ..datasets import Dataset
from ..datasets.loading import recording_of
from ..errors import InputError
from ..results.record import ColorRecord

logger = logging.getLogger(__name__)

AUTO, KINECT, NONE = "auto", "kinect", "none"
CHOICES = f"{AUTO}|{KINECT}|{NONE}|FILE"
ColorChoice = Annotated[str, arg(metavar=CHOICES)]


def given_color(recording: Dataset, choice: str) -> tuple[Dataset, ColorRecord]:
    """The recording with the colour camera that was chosen by name or file, and what to keep of it;
    unchanged for "auto", which needs poses.

    Raises DatasetError for a file that is none, InputError where the recording takes no camera.
    """
    if choice == AUTO:
        return recording, ColorRecord(choice)
    if choice == NONE:
        return recording.with_color_camera(None), ColorRecord(choice, verdict="as recorded")
    from ..datasets.color_camera import kinect_color_camera, read_color_camera

    file = Path(choice)
    if choice != KINECT and not file.suffix and not file.exists():
        raise InputError(
            f"--color-camera: '{choice}' is neither {AUTO}, {KINECT} nor {NONE}, nor a file"
        )
    camera = kinect_color_camera() if choice == KINECT else read_color_camera(file)
    record = ColorRecord(choice, camera.to_values(), f"registered with {choice}")
    return recording.with_color_camera(camera), record


def found_color(recording: Dataset, record: ColorRecord) -> tuple[Dataset, ColorRecord]:
    """Of "auto", the recording with the colour camera that its frames tell of, where they do; and
    with one that is known, the same with its clock offset applied to poses found meanwhile.
    """
    if record.choice != AUTO:
        from ..results.reader import registered_as

        return registered_as(recording, record), record
    from ..datasets.color_estimation import estimate_color_camera

    own = getattr(recording_of(recording), "color_camera", None)
    if own is not None:
        recording = recording.with_color_camera(own)
    if not recording.registered:
        logger.info("looking whether colour fits depth")
    estimate = estimate_color_camera(recording)
    logger.info("colour: %s", estimate.verdict)
    camera = estimate.camera
    record = replace(
        record,
        camera=None if camera is None else camera.to_values(),
        verdict=estimate.verdict,
        gain_db=None if estimate.gain_db is None else round(estimate.gain_db, 2),
        frames=estimate.frames,
    )
    return (recording if camera is None else recording.with_color_camera(camera)), record
