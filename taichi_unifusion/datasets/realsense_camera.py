"""A RealSense camera, live: depth and colour as they are taken, registered by its own calibration.

Source of frames for `LiveFrames`; needs pyrealsense2 (extra `realsense`). Depth and colour are paired by
their time stamps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import DatasetError, InputError, MissingDependency, check_choice
from ..types import Frame
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .realsense_lens import sdk_distortion
from .sensor_rig import SensorRig

TIMEOUT = 5.0  # [s] without an image, after which the camera counts as gone
RECENT = 8  # colour images that wait for their depth image
OTHER_CLOCK = 1.0  # [s] between both time stamps; beyond it they are of two clocks


class RealsenseCamera:
    """Frames of a camera, one after the other; `device` is one of pyrealsense2, None: the first that is
    connected.

    `size` (width, height) and `fps` choose the streams that come nearest. `align` is as in the format
    `realsense`. Frames have no poses. Iterating ends with DatasetError where no image comes for 5 s.
    """

    warnings: tuple[str, ...] = ()

    def __init__(
        self,
        device: Any = None,
        *,
        align: str = "depth",
        size: tuple[int, int] = (640, 480),
        fps: int = 30,
        timeout: float = TIMEOUT,
    ) -> None:
        check_choice("align", align, ("depth", "color"))
        if min(*size, fps) < 1:
            raise InputError(f"realsense: size and fps must be positive, got {size} and {fps}")
        rs = _import_sdk()
        self.timeout = timeout
        device = _first_device(rs) if device is None else device
        profiles = _choose_profiles(rs, device, size, fps)
        self.rig = _rig(profiles, align)
        self.period = 1 / max(profiles["depth"].fps(), 1)
        self._queue = rs.frame_queue(2 * RECENT)
        self._closed = False
        self._sensors = _start(device, profiles.values(), self._queue)

    def close(self) -> None:
        """Stop the camera."""
        self._closed = True
        sensors, self._sensors = self._sensors, []
        for sensor in sensors:
            sensor.stop()
            sensor.close()

    def __iter__(self) -> Iterator[Frame]:
        try:
            for index, (depth, color) in enumerate(self._pairs()):
                yield self._frame(index, depth, color)
        finally:
            self.close()

    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        """Depth and colour images that belong together, colour None where there is none near."""
        colors: deque[Any] = deque(maxlen=RECENT)
        waiting = None
        while not self._closed:
            ok, image = self._queue.try_wait_for_frame(int(1000 * self.timeout))
            if self._closed:
                return
            if not ok:
                raise DatasetError(
                    f"realsense: no image for {self.timeout:g} s; is the camera still connected?"
                )
            depth = image.as_depth_frame()
            if not depth:
                colors.append(image)
            elif waiting is not None:
                yield waiting, self._partner(waiting, colors)
            waiting = depth or waiting
            if waiting is not None and (self.rig.color is None or _is_past(waiting, colors)):
                yield waiting, self._partner(waiting, colors)
                waiting = None

    def _partner(self, depth: Any, colors: deque[Any]) -> Any:
        """The colour image nearest in time, None where that is more than half a period off."""
        if not colors:
            return None
        time = depth.get_timestamp()
        best = min(colors, key=lambda image: abs(image.get_timestamp() - time))
        off = abs(best.get_timestamp() - time) / 1000
        if off > OTHER_CLOCK:
            return colors[-1]
        return best if off <= 0.75 * self.period else None

    def _frame(self, index: int, depth: Any, color: Any) -> Frame:
        metres = np.asarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
        picture = None if color is None else np.array(color.get_data(), np.uint8)
        metres, picture, _ = self.rig.register(metres, picture)
        time = depth.get_timestamp() / 1000
        return Frame(
            metres, self.rig.camera, picture, None, index, time, f"realsense frame {index}"
        )


def _is_past(depth: Any, colors: deque[Any]) -> bool:
    """Whether no colour image that is still to come can be nearer in time."""
    return bool(colors) and colors[-1].get_timestamp() >= depth.get_timestamp()


def _import_sdk() -> ModuleType:
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        if "libusb" in str(error):
            raise MissingDependency(
                "pyrealsense2 needs the system library libusb-1.0; run: apt-get install -y libusb-1.0-0"
            ) from None
        raise MissingDependency(
            "a RealSense camera needs the SDK: pip install 'taichi-unifusion[realsense]'"
        ) from None
    return pyrealsense2


def _first_device(rs: ModuleType) -> Any:
    devices = list(rs.context().query_devices())
    if not devices:
        raise DatasetError(
            "realsense: no camera is connected; plug one in (USB 3), or give the path of a recording"
        )
    return devices[0]


def _choose_profiles(
    rs: ModuleType, device: Any, size: tuple[int, int], fps: int
) -> dict[str, Any]:
    """The stream of depth, and of colour where there is one, nearest in size and rate."""
    wanted = {"depth": (rs.stream.depth, rs.format.z16), "color": (rs.stream.color, rs.format.rgb8)}
    chosen: dict[str, Any] = {}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            for name, (stream, form) in wanted.items():
                if profile.stream_type() != stream or profile.format() != form:
                    continue
                video = profile.as_video_stream_profile()
                best = chosen.get(name)
                if best is None or _distance(video, size, fps) < _distance(best, size, fps):
                    chosen[name] = video
    if "depth" not in chosen:
        raise DatasetError("realsense: the camera has no stream of depth images")
    return chosen


def _distance(profile: Any, size: tuple[int, int], fps: int) -> tuple[int, int]:
    return abs(profile.width() - size[0]) + abs(profile.height() - size[1]), abs(
        profile.fps() - fps
    )


def _start(device: Any, profiles: Any, queue: Any) -> list[Any]:
    """Start the sensors of these streams; those that were started."""
    started = []
    try:
        for sensor in device.query_sensors():
            ids = {profile.unique_id() for profile in sensor.get_stream_profiles()}
            own = [profile for profile in profiles if profile.unique_id() in ids]
            if own:
                sensor.open(own)
                sensor.start(queue)
                started.append(sensor)
    except RuntimeError as error:  # the SDK's own errors
        for sensor in started:
            sensor.stop()
            sensor.close()
        raise DatasetError(f"realsense: the camera cannot be started ({error})") from error
    return started


def _rig(profiles: dict[str, Any], align: str) -> SensorRig:
    depth, color = profiles["depth"], profiles.get("color")
    if color is None:
        if align == "color":
            raise DatasetError("realsense: align 'color' needs a stream of colour images")
        return SensorRig(_lens(depth, "depth"), None, None, align)
    extrinsics = depth.get_extrinsics_to(color)
    T_color_depth = np.eye(4)
    T_color_depth[:3, :3] = np.array(extrinsics.rotation, float).reshape(3, 3).T  # by columns
    T_color_depth[:3, 3] = extrinsics.translation
    return SensorRig(_lens(depth, "depth"), _lens(color, "color"), T_color_depth, align)


def _lens(profile: Any, what: str) -> LensCamera:
    own = profile.get_intrinsics()
    where = f"realsense {what}"
    camera = make_camera(where, (own.width, own.height), own.fx, own.fy, own.ppx, own.ppy)
    return LensCamera(camera, sdk_distortion(str(own.model), np.array(own.coeffs), where))
