"""The keyframes of a results folder: what another recording of the place is aligned to."""

from __future__ import annotations

import logging
from collections.abc import Callable

from ..config import Config
from ..datasets import Dataset
from ..errors import DatasetError, FileError
from ..geometry import se3
from ..run_log import RunResult
from ..tracking.joining import keyframes_of
from ..tracking.keyframe_file import read_keyframes, write_keyframes
from ..tracking.keyframes import Keyframes
from ..tracking.sequence import PosedFrames, with_poses
from .reader import Run, read_run
from .reposing import NewPoses
from .run_folder import RunFolder

logger = logging.getLogger(__name__)


def known_keyframes(folder: RunFolder) -> Keyframes:
    """The keyframes of a folder, or else of the recording that it was made from; Taichi must run.
    Raises FileError where neither is there.
    """
    if folder.keyframes.exists():
        found = read_keyframes(folder.keyframes)
    else:
        run = read_run(folder.path)
        try:
            frames = posed_as(run)
        except DatasetError as error:
            raise FileError(
                f"{folder.path}: holds no {folder.keyframes.name}, by which a camera finds its place in the map, and "
                f"the recording is gone ({error}); make the map again with --keep-windows"
            ) from None
        found = keyframes_of(frames, depth_range(run.config()))
    if not len(found):
        raise FileError(f"{folder.path}: has no frame by which a camera could find its place")
    return found


def posed_as(run: Run) -> PosedFrames:
    """The frames that a run asked for, with the poses that it used."""
    used = dict(zip(run.used, run.trajectory().T_world_camera, strict=True))
    asked = run.source.asked
    return with_poses(run.recording[asked.start : asked.stop : asked.step], used)


def depth_range(config: Config) -> tuple[float, float]:
    """Nearest and farthest reading [m] that keyframes use."""
    return config.preprocess.depth_min, config.tracking.depth_max


def keyframes_of_run(
    frames: Dataset, run: RunResult, config: Config, stop: Callable[[], bool]
) -> Keyframes:
    """Some of the frames that a run mapped, at their final poses."""
    places = [step.index for step in run.steps]
    poses = dict(zip(places, run.trajectory.T_world_camera, strict=True))
    return keyframes_of(with_poses(frames, poses), depth_range(config), stop)


def repose_keyframes(folder: RunFolder, poses: NewPoses) -> None:
    """Move the keyframes of a folder, if it has any, to new poses; raises FileError."""
    if not folder.keyframes.exists():
        return
    found = read_keyframes(folder.keyframes)
    for number, keyframe in enumerate(found.items):
        T = poses.by_frame.get(keyframe.index)
        if T is not None:
            found.T_world_keyframe[number] = se3.normalized(T)
    write_keyframes(folder.new_keyframes, found)
    folder.new_keyframes.replace(folder.keyframes)
