"""Trackers of Open3D and OpenCV, frames in, camera-to-first-camera poses out; none of them closes
loops.
"""

from __future__ import annotations

import numpy as np

import taichi_unifusion as uf

DEPTH_MAX = 5.0
MODEL_VOXEL = 0.01  # [m]


class FrameToFrame:
    """Chains the motions between neighbouring frames."""

    def __init__(self, camera: uf.PinholeCamera) -> None:
        self.camera, self.before, self.T, self.poses = camera, None, np.eye(4), {}

    def track(self, frame: uf.Frame) -> None:
        now = self.prepare(frame)
        if self.before is not None:
            self.T = self.T @ self.motion(now, self.before)
        self.before, self.poses[frame.index] = now, self.T.copy()

    def finish(self) -> dict[int, np.ndarray]:
        return self.poses


class TensorHybrid(FrameToFrame):
    """Open3D's tensor RGB-D odometry, hybrid."""

    def prepare(self, frame: uf.Frame):
        import open3d as o3d

        depth = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.depth)))
        color = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.color)))
        return o3d.t.geometry.RGBDImage(color, depth)

    def motion(self, source, target) -> np.ndarray:
        import open3d as o3d

        odometry = o3d.t.pipelines.odometry
        return odometry.rgbd_odometry_multi_scale(
            source,
            target,
            o3d.core.Tensor(self.camera.matrix),
            o3d.core.Tensor(np.eye(4)),
            1.0,
            DEPTH_MAX,
            [odometry.OdometryConvergenceCriteria(n) for n in (6, 3, 1)],
            odometry.Method.Hybrid,
            odometry.OdometryLossParams(),
        ).transformation.numpy()


class LegacyHybrid(FrameToFrame):
    """Open3D's legacy RGB-D odometry, hybrid Jacobian."""

    def prepare(self, frame: uf.Frame):
        import open3d as o3d

        return o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(np.ascontiguousarray(frame.color)),
            o3d.geometry.Image(np.ascontiguousarray(frame.depth)),
            depth_scale=1.0,
            depth_trunc=DEPTH_MAX,
        )

    def motion(self, source, target) -> np.ndarray:
        import open3d as o3d

        c, options = self.camera, o3d.pipelines.odometry.OdometryOption(depth_max=DEPTH_MAX)
        found, T, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            source,
            target,
            o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx, c.cy),
            np.eye(4),
            o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
            options,
        )
        return T if found else np.eye(4)


class OpenCv(FrameToFrame):
    """cv2.Odometry on RGB-D (OpenCV 5, or 4.x with contrib)."""

    def __init__(self, camera: uf.PinholeCamera) -> None:
        import cv2

        super().__init__(camera)
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(camera.matrix.astype(np.float32))
        settings.setMaxDepth(DEPTH_MAX)
        self.odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )

    def prepare(self, frame: uf.Frame):
        import cv2

        depth = np.where((frame.depth > 0) & (frame.depth < DEPTH_MAX), frame.depth, np.nan).astype(
            np.float32
        )
        made = cv2.OdometryFrame(depth, np.ascontiguousarray(frame.color[..., ::-1]))
        self.odometry.prepareFrame(made)
        return made

    def motion(self, source, target) -> np.ndarray:
        found, T = self.odometry.compute(source, target)
        return T if found and np.isfinite(T).all() else np.eye(4)


class FrameToModel:
    """Open3D's dense SLAM: every frame against its TSDF."""

    def __init__(self, camera: uf.PinholeCamera) -> None:
        import open3d as o3d

        self.K, self.T, self.poses = o3d.core.Tensor(camera.matrix), np.eye(4), {}
        self.model = o3d.t.pipelines.slam.Model(
            MODEL_VOXEL, 16, 10000, o3d.core.Tensor(np.eye(4)), o3d.core.Device("CPU:0")
        )
        self.input = o3d.t.pipelines.slam.Frame(
            camera.height, camera.width, self.K, o3d.core.Device("CPU:0")
        )
        self.raycast = o3d.t.pipelines.slam.Frame(
            camera.height, camera.width, self.K, o3d.core.Device("CPU:0")
        )

    def track(self, frame: uf.Frame) -> None:
        import open3d as o3d

        depth = np.where(
            (frame.depth > 0) & (frame.depth < DEPTH_MAX), 1000 * frame.depth, 0
        ).astype(np.uint16)
        self.input.set_data_from_image("depth", o3d.t.geometry.Image(o3d.core.Tensor(depth)))
        self.input.set_data_from_image(
            "color", o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.color)))
        )
        if self.poses:
            found = self.model.track_frame_to_model(
                self.input, self.raycast, 1000.0, DEPTH_MAX, 0.07
            )
            self.T = self.T @ found.transformation.cpu().numpy()
        self.poses[frame.index] = self.T.copy()
        self.model.update_frame_pose(len(self.poses) - 1, o3d.core.Tensor(self.T))
        self.model.integrate(self.input, 1000.0, DEPTH_MAX, 8.0)
        self.model.synthesize_model_frame(self.raycast, 1000.0, 0.1, DEPTH_MAX, 8.0, False)

    def finish(self) -> dict[int, np.ndarray]:
        return self.poses


def colored_icp(target: uf.Frame, source: uf.Frame, guess: np.ndarray) -> np.ndarray:
    """Open3D's colored ICP over three scales, as its tutorial has it, clouds and normals included."""
    import open3d as o3d

    def cloud(frame: uf.Frame):
        c = frame.camera
        image = LegacyHybrid(c).prepare(frame)
        return o3d.geometry.PointCloud.create_from_rgbd_image(
            image, o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        )

    clouds, T = (cloud(source), cloud(target)), guess
    for radius, iterations in ((0.04, 50), (0.02, 30), (0.01, 14)):
        down = [points.voxel_down_sample(radius) for points in clouds]
        for points in down:
            points.estimate_normals(
                o3d.geometry.KDTreeSearchParamHybrid(radius=2 * radius, max_nn=30)
            )
        T = o3d.pipelines.registration.registration_colored_icp(
            *down,
            radius,
            T,
            o3d.pipelines.registration.TransformationEstimationForColoredICP(),
            o3d.pipelines.registration.ICPConvergenceCriteria(1e-6, 1e-6, iterations),
        ).transformation
    return T
