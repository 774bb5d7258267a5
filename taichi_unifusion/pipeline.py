"""Pipeline: posed frames -> surface LIM, colour LIM, a LIM for every other property, features among
them -> mesh (Fig. 7).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from . import runtime
from .config import Config
from .datasets.loading import load_ahead
from .errors import FrameError, InputError, PoseError, UniFusionError
from .language import ImageEncoder, feature_image
from .maps import BaseMap, LatentMap, PropertyMap, SurfaceMap
from .maps.property_group import group_maps
from .preprocessing import PreprocessSettings, preprocess
from .properties import SurfaceProperty, make_property
from .run_log import SKIP_REASONS, EmptyFrame, RunLog, RunResult, StepResult
from .types import Frame, Mesh

FEATURES = "features"  # name of the map of image-text features


class Pipeline:
    """Fuses frames into a surface map, a colour map, and a map for every property that the
    configuration or the caller names.

    With an image encoder also into a map of its features, named FEATURES.

        pipeline = Pipeline(Config(properties=("saliency",)))
        pipeline.run(open_dataset("7scenes", path)[::10])
        pipeline.extract_mesh().save("kitchen.ply")
    """

    def __init__(
        self,
        config: Config | None = None,
        properties: Iterable[SurfaceProperty] = (),
        encoder: ImageEncoder | None = None,
    ) -> None:
        self.config, self.encoder = config or Config(), encoder
        made = (make_property(text, self.config.property_map) for text in self.config.properties)
        self.sources = _by_name((*made, *properties))
        runtime.init(self.config.device, threads=self.config.threads or None)
        self.surface = SurfaceMap(self.config.surface)
        self.properties = {
            "color": PropertyMap("color", 3, self.config.color),
            **{
                name: PropertyMap(
                    name, source.channels, source.settings or self.config.property_map
                )
                for name, source in self.sources.items()
            },
        }
        self.groups = group_maps(self.properties.values())
        # until the first features say how many channels they have
        self.features: LatentMap | None = None

    @property
    def maps(self) -> dict[str, BaseMap]:
        """All maps by name, the surface first."""
        return {
            "surface": self.surface,
            **self.properties,
            **({} if self.features is None else {FEATURES: self.features}),
        }

    def step(self, frame: Frame) -> StepResult:
        """Fuse one frame; a property that the frame lacks, or does not allow to be made, is left
        out.

        Raises FrameError where the frame has no pose or no usable depth, OutOfRange where it lies
        beyond a map's index range, CapacityError where a map would grow beyond safe memory.
        """
        clock = StageClock()
        if frame.T_world_camera is None:
            raise PoseError(f"{frame.label}: there is no pose for this frame")
        frame, lacking = self._with_properties(frame, clock)
        with clock.stage("preprocess"):
            cloud = preprocess(frame, self.config.preprocess)
        if len(cloud) == 0:
            raise EmptyFrame(f"{frame.label}: {_why_empty(frame, self.config.preprocess)}")
        with clock.stage("transform"):
            cloud = cloud.transformed(frame.T_world_camera)
        with clock.stage("surface"):
            integrations = {"surface": self.surface.integrate(cloud)}
        for group in self.groups:
            if name := group.name_in(cloud):
                with clock.stage(name):
                    integrations |= group.integrate(cloud)
        if FEATURES in cloud.features:
            with clock.stage(FEATURES):
                integrations[FEATURES] = self.features.integrate(cloud)
        return StepResult(
            frame.index, frame.name, len(cloud), integrations, clock.milliseconds, lacking
        )

    def _with_properties(self, frame: Frame, clock: StageClock) -> tuple[Frame, dict[str, str]]:
        """The frame with an image of every property (f_im, Fig. 6), and by name why one cannot be
        had.
        """
        lacking = {}
        for name, source in self.sources.items():
            try:
                with clock.stage(f"{name} image"):
                    frame = frame.with_image(name, source.image(frame))
            except FrameError as error:
                lacking[name] = str(error)
                frame = frame.without_image(name)
        if self.encoder is not None:
            try:
                with clock.stage(f"{FEATURES} image"):
                    frame = frame.with_features(FEATURES, feature_image(self.encoder, frame))
                channels = frame.features[FEATURES].values.shape[2]
                if self.features is None:
                    self.features = LatentMap(
                        FEATURES, channels, self.config.feature_map, source=self.encoder.name
                    )
            except FrameError as error:
                lacking[FEATURES] = str(error)
        return frame, lacking

    def run(
        self,
        sequence: Sequence[Frame],
        *,
        strict: bool = False,
        stop: Callable[[], bool] = lambda: False,
        on_frame: Callable[[int, int], None] = lambda done, total: None,
    ) -> RunResult:
        """Fuse a sequence in order, skipping frames that cannot be used; `strict` ends the run at
        the first of them.

        `stop` is asked before every frame, `on_frame` told after it. What ends a run early is in
        the result, with all that was done until then; raises DatasetError only where not one frame
        could be used.
        """
        log, failure, interrupted = RunLog(sequence), None, False
        for i, load in enumerate(load_ahead(sequence)):
            if interrupted := stop():
                break
            waiting = time.perf_counter()
            try:
                frame = load()
                waited = time.perf_counter() - waiting
                log.check_depth_scale(frame)
                log.add_step(frame, self.step(frame), waited)
            except tuple(SKIP_REASONS) as error:
                log.add_skipped(i, error)
                failure = error if strict else None
            except UniFusionError as error:
                failure = error
            on_frame(i + 1, len(sequence))
            if failure:
                break
        return log.result(interrupted, failure)

    def extract_mesh(self, resolution: int | None = None) -> Mesh:
        """The mesh of all that was fused so far, coloured; `resolution` overrides the
        configuration's.
        """
        mesh = self.config.mesh
        return extract_mesh(
            self.surface,
            self.properties,
            mesh.resolution if resolution is None else resolution,
            mesh.min_area,
        )


def _by_name(properties: Iterable[SurfaceProperty]) -> dict[str, SurfaceProperty]:
    named: dict[str, SurfaceProperty] = {}
    for made in properties:
        if named.setdefault(made.name, made) is not made:
            raise InputError(
                f"property '{made.name}' is asked for twice; give one of them another name, as in "
                f"{made.name},name=other"
            )
    return named


def extract_mesh(
    surface: SurfaceMap,
    properties: Mapping[str, PropertyMap],
    resolution: int,
    min_area: float = 0.0,
) -> Mesh:
    """The surface as a mesh that carries every property that has data."""
    mesh = surface.extract_mesh(resolution, min_area)
    for name, source in properties.items():
        if len(source) and len(mesh.vertices):
            mesh = mesh.with_attribute(name, source.query(mesh.vertices))
    return mesh


@dataclass
class StageClock:
    """Milliseconds by stage, with the device's work included."""

    milliseconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        runtime.synchronize()
        self.milliseconds[name] = 1e3 * (time.perf_counter() - start)


def _why_empty(frame: Frame, settings: PreprocessSettings) -> str:
    readings = frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)]
    if not len(readings):
        return "the depth image holds no reading at all"
    if not ((readings >= settings.depth_min) & (readings <= settings.depth_max)).any():
        return (
            f"all depth readings lie outside {settings.depth_min:g}..{settings.depth_max:g} m "
            f"(median {np.median(readings):.3g} m); is the depth scale wrong? Else see preprocess.depth_min and depth_max"
        )
    return f"all {len(readings)} depth readings lie on edges, on grazing surfaces or too far apart"
