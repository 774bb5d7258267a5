"""Recordings of phones, written as their apps lay them out: a textured wall that a camera goes past.

Depth is exact and small, colour four times as large; both show the same view. Colour at a point is a
function of the point, so that it tells where a reader thinks that the point is.
"""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.geometry import se3
from taichi_unifusion.geometry.quaternions import rotation_to_quaternion
from taichi_unifusion.types import PinholeCamera

FRAMES = 4
LARGER = 4  # colour than depth
WALL = np.array([0.1, -0.15, -1.0, 1.5])  # n x + d = 0, faces the cameras


@dataclass(frozen=True)
class View:
    """A frame as it truly is."""

    depth: NDArray[np.float32]  # (h, w) [m]
    color: NDArray[np.uint8]  # (H, W, 3) RGB
    camera: PinholeCamera  # of colour
    T_world_camera: NDArray[np.float64]

    @property
    def T_arkit(self) -> NDArray[np.float64]:
        """Camera to world with ARKit's camera axes."""
        return self.T_world_camera @ se3.FLIP_YZ

    @property
    def millimetres(self) -> NDArray[np.uint16]:
        return np.rint(1000 * self.depth).astype(np.uint16)


def color_at(points: NDArray) -> NDArray[np.float64]:
    """RGB (..., 3) of 0..255 of points of the wall, smooth."""
    return 128 + 100 * np.sin(points @ np.array([[3.0, 1, 0], [0, 4, 1], [2, 2, 1]]) + [0, 1, 2])


def depth_of(camera: PinholeCamera, T_world_camera: NDArray) -> NDArray[np.float64]:
    """Distance of the wall along the axis of a camera, (H, W)."""
    plane = WALL @ T_world_camera  # in the camera
    return -plane[3] / (camera.rays() @ plane[:3])


def views(portrait: bool = False, count: int = FRAMES) -> list[View]:
    """Frames of a camera that moves and turns, with intrinsics that change a little."""
    size = (36, 48) if portrait else (48, 36)
    found = []
    for i in range(count):
        colored = PinholeCamera(
            *(LARGER * side for side in size),
            160.0 + i,
            160.0 + i,
            *(2 * side + 1 + i for side in size),
        )
        T = se3.exp(np.array([0.04 * i, 0.02 * i, 0.03 * i, 0.05 * i, -0.04 * i, 0.03 * i]))
        points = colored.rays() * depth_of(colored, T)[..., None] @ T[:3, :3].T + T[:3, 3]
        color = np.rint(color_at(points)).astype(np.uint8)
        depth = depth_of(colored.resized(*size), T).astype(np.float32)
        found.append(View(depth, color, colored, T))
    return found


def quaternion(T: NDArray) -> list[float]:
    """x y z w of a pose."""
    return rotation_to_quaternion(T[None, :3, :3])[0].tolist()


def jpeg(color: NDArray) -> bytes:
    return cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


def png(path: Path, image: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def write(path: Path, data: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())


def stored(data: bytes) -> bytes:
    """LZFSE of one stored block."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def _metadata(shots: list[View], own: bool = True) -> dict:
    first = shots[0]
    height, width = first.depth.shape
    camera = first.camera
    values = {
        "w": camera.width,
        "h": camera.height,
        "dw": width,
        "dh": height,
        "fps": 30,
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1],
        "poses": [[*quaternion(x.T_arkit), *x.T_arkit[:3, 3].tolist()] for x in shots],
        "frameTimestamps": [i / 30 for i in range(len(shots))],
        "cameraType": 1,
    }
    if own:
        values["perFrameIntrinsicCoeffs"] = [list(x.camera.intrinsics) for x in shots]
    return values


def write_r3d(folder: Path, shots: list[View], confidence: NDArray | None = None) -> Path:
    path = folder / "recording.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(_metadata(shots)))
        for i, shot in enumerate(shots):
            archive.writestr(f"rgbd/{i}.jpg", jpeg(shot.color))
            archive.writestr(f"rgbd/{i}.depth", stored(shot.depth.tobytes()))
            if confidence is not None:
                archive.writestr(f"rgbd/{i}.conf", stored(confidence.astype(np.uint8).tobytes()))
    return path


def write_record3d_export(folder: Path, shots: list[View]) -> Path:
    import OpenEXR

    root = folder / "EXR_RGBD"
    (root / "depth").mkdir(parents=True)
    write(root / "metadata.json", json.dumps(_metadata(shots)))
    for i, shot in enumerate(shots):
        write(root / "rgb" / f"{i}.jpg", jpeg(shot.color))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"R": shot.depth}) as file:
            file.write(str(root / "depth" / f"{i}.exr"))
    return folder


def write_polycam(
    folder: Path, shots: list[View], confidence: NDArray | None = None, corrected: bool = False
) -> Path:
    prefix = "corrected_" if corrected else ""
    for i, shot in enumerate(shots):
        stem, camera = f"{1442008525605 + 33333 * i}", shot.camera
        keys = {f"t_{r}{c}": float(shot.T_arkit[r, c]) for r in range(3) for c in range(4)}
        keys |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        keys |= {"width": camera.width, "height": camera.height, "blur_score": 100.0}
        root = folder / "keyframes"
        write(root / f"{prefix}cameras" / f"{stem}.json", json.dumps(keys))
        write(root / f"{prefix}images" / f"{stem}.jpg", jpeg(shot.color))
        png(root / "depth" / f"{stem}.png", shot.millimetres)
        if confidence is not None:
            levels = np.array([0, 127, 255], np.uint8)[confidence]
            png(root / "confidence" / f"{stem}.png", levels)
    return folder


def write_strayscanner(
    folder: Path, shots: list[View], confidence: NDArray | None = None, old: bool = False
) -> Path:
    """The video has one camera for all; `old`: .npy depth, and rows of nothing but poses."""
    write_video(folder / "rgb.mp4", [shot.color for shot in shots])
    camera = shots[0].camera
    rows = "\n".join(", ".join(map(str, row)) for row in camera.matrix)
    write(folder / "camera_matrix.csv", rows)
    lines = ["x, y, z, qx, qy, qz, qw" if old else "timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, shot in enumerate(shots):
        T = shot.T_world_camera
        pose = ", ".join(map(repr, [*T[:3, 3].tolist(), *quaternion(T)]))
        lines.append(pose if old else f"{100 + i / 60}, {i:06}, {pose}")
        if old:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{i:06}.npy", shot.millimetres)
        else:
            png(folder / "depth" / f"{i:06}.png", shot.millimetres)
        if confidence is not None:
            png(folder / "confidence" / f"{i:06}.png", confidence.astype(np.uint8))
    write(folder / "odometry.csv", "\n".join(lines))
    return folder


def write_video(path: Path, pictures: list[NDArray], codec: str = "libx265") -> None:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {
            "crf": "4",
            "x265-params": "log-level=none:pools=none:frame-threads=1",
            "preset": "ultrafast",
        }
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


APPLIED = np.array([[0, 1.0, 0, 0.5], [0, 0, 1.0, -0.2], [1.0, 0, 0, 0.1]])
APPLIED_SCALE = 1.7


def write_transforms(folder: Path, shots: list[View], kind: str = "nerfstudio") -> Path:
    """`kind`: nerfstudio (depth in millimetres, a transform applied), instant-ngp (depth in own
    units, names without suffixes, one camera for all), or fisheye (and brown): images of a lens.
    """
    applied = np.vstack([APPLIED, [0, 0, 0, 1]])
    values: dict = {"frames": []}
    if kind == "nerfstudio":
        values |= {"applied_transform": APPLIED.tolist(), "applied_scale": APPLIED_SCALE}
    if kind == "instant-ngp":
        values |= {"integer_depth_scale": 10 / 65535}
    if kind in LENSES:
        values |= LENSES[kind]
    for i, shot in enumerate(shots):
        camera, T, name = shot.camera, shot.T_arkit.copy(), f"images/frame_{i + 1:05}.png"
        frame: dict = {"fl_x": camera.fx, "fl_y": camera.fy, "w": camera.width, "h": camera.height}
        frame |= {"cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        if kind == "nerfstudio":
            T = applied @ T
            T[:3, 3] *= APPLIED_SCALE
        if kind == "instant-ngp":
            frame |= {"depth_path": f"depth/{i + 1}", "timestamp": i / 30}
            frame["file_path"] = name.removesuffix(".png")
            units = np.rint(shot.depth * 6553.5).astype(np.uint16)
            png(folder / "depth" / f"{i + 1}.png", units)
        else:
            frame |= {"depth_file_path": f"depth/frame_{i + 1:05}.png", "file_path": name}
            png(folder / "depth" / f"frame_{i + 1:05}.png", shot.millimetres)
        png(folder / name, shot.color[..., ::-1])
        frame["transform_matrix"] = T.tolist()
        values["frames"].append(frame)
    values["frames"].reverse()  # the order of the list means nothing
    write(folder / "transforms.json", json.dumps(values))
    return folder


LENSES = {
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.08, "k2": -0.02, "k3": 0.01, "k4": 0.0},
    "brown": {"camera_model": "OPENCV", "k1": -0.15, "k2": 0.03, "p1": 0.004, "p2": -0.003},
}


def through_lens(shot: View, kind: str) -> View:
    """The view as a camera with that lens takes it."""
    depth = distorted_depth(shot.camera.resized(*shot.depth.shape[::-1]), shot.T_world_camera, kind)
    rays = lens_rays(shot.camera, kind)
    plane = WALL @ shot.T_world_camera
    points = rays * (-plane[3] / (rays @ plane[:3]))[..., None]
    world = points @ shot.T_world_camera[:3, :3].T + shot.T_world_camera[:3, 3]
    color = np.rint(color_at(world)).astype(np.uint8)
    return View(depth.astype(np.float32), color, shot.camera, shot.T_world_camera)


def distorted_depth(camera: PinholeCamera, T_world_camera: NDArray, kind: str) -> NDArray:
    plane = WALL @ T_world_camera
    return -plane[3] / (lens_rays(camera, kind) @ plane[:3])


def lens_rays(camera: PinholeCamera, kind: str) -> NDArray[np.float64]:
    """(H, W, 3) rays with z = 1 of the pixels of a distorted image, by OpenCV's own inversion."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    k = LENSES[kind]
    if kind == "fisheye":
        numbers = np.array([k["k1"], k["k2"], k["k3"], k["k4"]])
        xy = cv2.fisheye.undistortPoints(pixels, camera.matrix, numbers)
    else:
        numbers = np.array([k["k1"], k["k2"], k["p1"], k["p2"]])
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        xy = cv2.undistortPoints(pixels, camera.matrix, numbers, criteria=criteria)
    xy = xy.reshape(camera.height, camera.width, 2)
    return np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)


def deflated(data: bytes) -> bytes:
    """Raw deflate, without a header."""
    packer = zlib.compressobj(wbits=-15)
    return packer.compress(data) + packer.flush()


def write_arkitscenes(
    folder: Path, shots: list[View], confidence: NDArray | None = None, every: int = 1
) -> Path:
    """Colour of depth's size; the trajectory has every so many-th frame."""
    rows = []
    for i, shot in enumerate(shots):
        stamp = f"{6845.123 + 0.0167 * i:.3f}"
        height, width = shot.depth.shape
        small = shot.camera.resized(width, height)
        name = f"41069021_{stamp}"
        shrunk = cv2.resize(shot.color, (width, height), interpolation=cv2.INTER_AREA)
        png(folder / "lowres_wide" / f"{name}.png", shrunk[..., ::-1])
        png(folder / "lowres_depth" / f"{name}.png", shot.millimetres)
        # the stamp of a camera may be a millisecond off
        late = f"41069021_{float(stamp) + 0.001:.3f}.pincam" if i % 2 else f"{name}.pincam"
        values = " ".join(map(repr, (width, height, *small.intrinsics)))
        write(folder / "lowres_wide_intrinsics" / late, values)
        if confidence is not None:
            png(folder / "confidence" / f"{name}.png", confidence.astype(np.uint8))
        if i % every == 0:
            T = se3.inverse(shot.T_world_camera)
            turn = cv2.Rodrigues(T[:3, :3])[0].ravel()
            rows.append(
                " ".join(map(repr, [float(stamp) + 0.002, *turn.tolist(), *T[:3, 3].tolist()]))
            )
    write(folder / "lowres_wide.traj", "\n".join(rows))
    return folder


# [pixels] the file says nothing of its images' size: that of an iPhone's depth
IPHONE = (256, 192)


def iphone_views(count: int = 3) -> list[View]:
    """Views whose depth is as large as ScanNet++ has it; colour is as large."""
    found = []
    for i, shot in enumerate(views(count=count)):
        camera = PinholeCamera(*IPHONE, 212.0 + i, 212.0 + i, 128.0, 95.0 + i)
        exact = depth_of(camera, shot.T_world_camera)
        T = shot.T_world_camera
        points = camera.rays() * exact[..., None] @ T[:3, :3].T + T[:3, 3]
        color = np.rint(color_at(points)).astype(np.uint8)
        found.append(View(exact.astype(np.float32), color, camera, T))
    return found


def write_scannetpp(folder: Path, shots: list[View], packing: str = "stream") -> Path:
    """`packing` of depth: stream (all as one), lz4 or deflate (each by itself)."""
    root, frames = folder / "iphone", {}
    write_video(root / "rgb.mkv", [shot.color for shot in shots])
    images = []
    for i, shot in enumerate(shots):
        camera = shot.camera
        frames[f"frame_{i:06}"] = {
            "aligned_pose": shot.T_world_camera.tolist(),
            "pose": np.eye(4).tolist(),
            "intrinsic": camera.matrix.ravel().tolist(),
            "timestamp": 100 + i / 60,
        }
        if packing == "lz4":
            import lz4.block

            images.append(lz4.block.compress(shot.millimetres.tobytes(), store_size=False))
        elif packing == "deflate":
            images.append(deflated(shot.depth.tobytes()))
    write(root / "pose_intrinsic_imu.json", json.dumps(frames))
    if packing == "stream":
        write(root / "depth.bin", deflated(b"".join(shot.depth.tobytes() for shot in shots)))
    else:
        write(root / "depth.bin", b"".join(struct.pack("<I", len(x)) + x for x in images))
    return folder


def write_matterport(folder: Path, shots: list[View], kind: str = "brown") -> Path:
    lens = LENSES[kind]
    for i, shot in enumerate(shots):
        name, camera = b"17DRP5sb8fy".hex().ljust(32, "0"), shot.camera
        units = np.rint(4000 * shot.depth).astype(np.uint16)
        png(folder / "matterport_depth_images" / f"{name}_d0_{i}.png", units)
        write(folder / "matterport_color_images" / f"{name}_i0_{i}.jpg", jpeg(shot.color))
        rows = "\n".join(" ".join(map(repr, row)) for row in shot.T_world_camera.tolist())
        write(folder / "matterport_camera_poses" / f"{name}_pose_0_{i}.txt", rows)
        numbers = (camera.width, camera.height, *camera.intrinsics)
        numbers += (lens["k1"], lens["k2"], lens["p1"], lens["p2"], 0.0)
        file = folder / "matterport_camera_intrinsics" / f"{name}_intrinsics_0.txt"
        write(file, " ".join(map(repr, numbers)))
    return folder


METRES_A_UNIT = 0.0254


def hypersim_views(count: int = 3) -> list[View]:
    """Views of a camera with a field of view of 60 degrees; colour is as large as depth."""
    found = []
    width, height = 48, 36
    focal = 0.5 * width / np.tan(np.pi / 6)
    camera = PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    for shot in views(count=count):
        T, exact = shot.T_world_camera, depth_of(camera, shot.T_world_camera)
        points = camera.rays() * exact[..., None] @ T[:3, :3].T + T[:3, 3]
        color = np.rint(color_at(points)).astype(np.uint8)
        found.append(View(exact.astype(np.float32), color, camera, T))
    return found


def write_hypersim(folder: Path, shots: list[View]) -> Path:
    import h5py

    def hdf5(path: Path, values: NDArray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(path, "w") as file:
            file["dataset"] = values

    write(
        folder / "_detail" / "metadata_scene.csv",
        f"parameter_name,parameter_value\nmeters_per_asset_unit,{METRES_A_UNIT}\n",
    )
    detail = folder / "_detail" / "cam_00"
    T = np.array([shot.T_arkit for shot in shots])
    hdf5(detail / "camera_keyframe_orientations.hdf5", T[:, :3, :3])
    hdf5(detail / "camera_keyframe_positions.hdf5", T[:, :3, 3] / METRES_A_UNIT)
    for i, shot in enumerate(shots):
        distance = shot.depth * np.linalg.norm(shot.camera.rays(), axis=-1)
        geometry = folder / "images" / "scene_cam_00_geometry_hdf5"
        hdf5(geometry / f"frame.{i:04}.depth_meters.hdf5", distance.astype(np.float16))
        preview = folder / "images" / "scene_cam_00_final_preview"
        write(preview / f"frame.{i:04}.tonemap.jpg", jpeg(shot.color))
    return folder
