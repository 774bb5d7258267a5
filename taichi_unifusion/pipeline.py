"""Pipeline: posed frames -> surface LIM, colour LIM, a LIM for every other property, features among
them -> mesh (Fig. 7).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import runtime
from .config import Config, checked
from .datasets.loading import check_sequence, first_frames, load_ahead
from .errors import FrameError, InputError, as_known, check_kind, strict
from .kernels.patches import Patches
from .language.source import FeatureSource
from .maps import BaseMap, FeatureMap, Integration, PropertyMap, SurfaceMap
from .maps.detail import sight_of, sizes_sentence
from .maps.follower import MapFollower
from .maps.kept_window import KeptWindow
from .maps.property_group import group_maps
from .maps.tiled_mesh import joined_mesh
from .maps.window import WindowFusion
from .maps.window_store import WindowStore
from .maps.working_set import make_memory
from .networks.encoders import ImageEncoder
from .preprocessing import find_patches, invert_depth, preprocess, why_empty
from .properties import SurfaceProperty, make_property
from .properties.sources import PropertySource, Source, check_encoder, sources_by_name
from .run_log import (
    SKIP_REASONS,
    EmptyFrame,
    RunLog,
    RunResult,
    RunSoFar,
    SkippedFrame,
    StageClock,
    StepResult,
)
from .types import Frame, Mesh, PinholeCamera

logger = logging.getLogger(__name__)


OnBorder = Callable[[RunLog, "Pipeline"], None]  # is told between two windows
# is told of a frame that was fused, what that did, and the pipeline
OnStep = Callable[[Frame, StepResult, "Pipeline"], None]


@strict
class Pipeline:
    """Fuses frames into a surface map, a colour map, and a map for every property that the
    configuration or the caller names; with an image encoder also into a map of its features.

        pipeline = Pipeline(Config(properties=("saliency",)))
        pipeline.run(open_dataset("7scenes", path)[::10])
        pipeline.extract_mesh().save("kitchen.ply")

    With `synchronize` off, the times of stages are those of launching them: CUDA may then overlap
    them. `keep` is told of every window that was fused. Where it is a `WindowStore`, the maps can
    follow a trajectory that changes: `pipeline.follower`. With `map_memory` in the configuration,
    maps are kept within it; what does not fit lies in the folder `tiles`, a folder a map, and
    `extract_mesh` goes through all of it. `maps`, by name, are gone on with, and tiles that are there.
    """

    def __init__(
        self,
        config: Config | None = None,
        properties: Iterable[SurfaceProperty] = (),
        encoder: ImageEncoder | None = None,
        *,
        synchronize: bool = True,
        keep: Callable[[KeptWindow], None] | None = None,
        tiles: str | Path | None = None,
        maps: Mapping[str, BaseMap] | None = None,
    ) -> None:
        self.config = config = checked(config)
        self.synchronize = synchronize
        made = [make_property(text, config.property_map) for text in config.properties]
        check_encoder(encoder)
        features = [FeatureSource(encoder, config.feature_map)] if encoder is not None else []
        self.sources: dict[str, Source] = sources_by_name((*made, *properties, *features))
        runtime.init(config.device, threads=config.threads or None)
        self.memory = make_memory(config.map_memory, tiles, goes_on=maps is not None)
        settle = self.memory.settle if self.memory else lambda: None
        self.fusion = WindowFusion(config.window, keep, settle)
        self.follower = MapFollower(self, keep) if isinstance(keep, WindowStore) else None
        if self.memory and self.follower:
            raise InputError(
                "map_memory: a map in tiles cannot follow a trajectory that changes; leave either the "
                "limit or the store of windows out"
            )
        self._maps: dict[str, BaseMap] = {}
        for name, each in (maps or {}).items():
            check_kind(f"maps: '{name}'", each, BaseMap, "; load_map reads one from a file")
        self._known = dict(maps or {})
        given = config.surface.voxel_size and config.color.voxel_size and not self.sources
        if config.voxel_size or given:  # nothing is left to choose
            self._make_maps(config.settled(()))

    def settle(self, frames: Iterable[Frame]) -> bool:
        """Choose the voxel sizes that fit these frames, as `Config.detail` says, and make the maps;
        whether they are there. They are not where no frame has a reading in range.

        `run` and `step` do so with their first frames.
        """
        if not self._maps:
            settings, frames = self.config.preprocess, tuple(frames)
            sight = sight_of(frames, settings.depth_min, settings.depth_max)
            if sight is None:
                return False
            self._make_maps(self.config.settled(frames))
            logger.info("%s", sizes_sentence(self.config.surface, self.config.color, sight))
        return True

    def _make_maps(self, config: Config) -> None:
        """Empty maps at the sizes of a settled configuration; those of features wait for the first
        features.
        """
        self.config = config
        known = self._known
        maps: list[BaseMap] = [
            known.pop("surface", None) or SurfaceMap(config.surface),
            known.pop("color", None) or PropertyMap("color", 3, config.color),
        ]
        for name, source in self.sources.items():
            if isinstance(source, FeatureSource):
                self.sources[name] = replace(source, settings=config.feature_map)
            else:
                sized = cast(PropertySource, source).with_settings(
                    config.property_map, config.scale
                )
                self.sources[name] = sized
                maps.append(known.pop(name, None) or sized.make_map())
        maps += known.values()
        self._maps = {each.name: each for each in maps}
        self.groups = group_maps(maps)
        if self.memory:
            self.memory.follow(self._maps)
        finest = min(each.voxel_size for each in maps)
        patch_size = min(config.preprocess.patch_size, finest / 2)
        self._preprocess = replace(config.preprocess, patch_size=patch_size)

    @property
    def maps(self) -> dict[str, BaseMap]:
        """All maps by name; whoever asks before the first frame gets those of a room."""
        if not self._maps:
            self._make_maps(self.config.settled(()))
        return self._maps

    @property
    def surface(self) -> SurfaceMap:
        """The map of the surface; see `maps`."""
        surface = self.maps["surface"]
        assert isinstance(surface, SurfaceMap)
        return surface

    def __repr__(self) -> str:
        maps = ", ".join(map(repr, self._maps.values()))
        return f"<Pipeline of {maps or 'maps that the first frame will size'}>"

    @property
    def properties(self) -> dict[str, PropertyMap]:
        """The maps whose values a mesh carries, by name."""
        return {name: each for name, each in self.maps.items() if isinstance(each, PropertyMap)}

    def step(self, frame: Frame) -> StepResult:
        """Fuse one frame; a property that the frame lacks, or does not allow to be made, is left
        out.

        Raises FrameError where the frame has no pose or no usable depth, OutOfRange where it lies
        beyond a map's index range, CapacityError where a map would grow beyond safe memory.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"Pipeline.step: expected a Frame, got {type(frame).__name__}")
        clock, live = StageClock(self.synchronize), runtime.current()
        T_world_camera = frame.require_pose()
        if not self.settle([frame]):
            raise EmptyFrame(f"{frame.label}: {why_empty(frame, self.config.preprocess)}")
        if not live.warm:  # once, also where the first frames turn out to be of no use
            logger.info("compiling kernels (once a process)")
            live.warm = True
        frame, lacking = self._with_properties(frame, clock)
        with clock.stage("preprocess"):
            images, view = self.fusion.place(frame)
            if self.memory:
                self.memory.see(frame)
            inverse = invert_depth(frame, self._preprocess, images, view)
        with clock.stage("sum"):
            find = partial(find_patches, frame, self._preprocess, inverse, T_world_camera)
            reach = self._preprocess.depth_max * frame.camera.longest_ray
            patches, touched = self.fusion.add(
                frame, find, reach, self.groups, bool(frame.features)
            )
        if patches.total == 0:
            raise EmptyFrame(f"{frame.label}: {why_empty(frame, self.config.preprocess)}")
        done = self._integrate_alone(frame, patches, clock)
        for piece in self.fusion.due():
            with clock.stage(piece.name):
                piece.work()
        done |= {
            name: Integration(patches.pixels, voxels, len(self.maps[name].grid))
            for name, voxels in touched.items()
        }
        if self.follower is not None:
            self.follower.earn()
            if self.fusion.window is None:
                with clock.stage("follow"):
                    self.follower.work()
        return StepResult(
            frame.index, frame.name, patches.pixels, done, clock.milliseconds, lacking
        )

    def _integrate_alone(
        self, frame: Frame, patches: Patches, clock: StageClock
    ) -> dict[str, Integration]:
        """Fuse a frame into the maps that do not take averages of several frames."""
        done: dict[str, Integration] = {}
        for name, each in self.maps.items():
            if isinstance(each, FeatureMap) and each.wants(frame):
                with clock.stage(name):
                    if self.fusion.keep is None:
                        done[name] = each.integrate_patches(patches)
                    else:
                        done[name], kept = each.integrate_and_keep(patches, fuse=not frame.apart)
                        self.fusion.attach([kept])
        alone = [group for group in self.groups if not group.sums_up]
        if not alone:
            return done
        if self.memory and self.fusion.window is None:
            self.memory.settle()
        with clock.stage("points"):
            settings = replace(self._preprocess, patch_size=0.0)
            cloud = preprocess(frame, settings).transformed(frame.require_pose())
        for group in alone:
            if names := group.names_in(cloud):
                with clock.stage(" + ".join(names)):
                    done |= group.integrate(cloud)
        return done

    def _flush(self) -> dict[str, float]:
        """Fuse the frames of the last window; milliseconds by stage."""
        clock = StageClock(self.synchronize)
        with clock.stage("sum"):
            self.fusion.close()
        for piece in self.fusion.due(frames=1):
            with clock.stage(piece.name):
                piece.work()
        return clock.milliseconds

    def flush(self) -> None:
        """Fuse the frames of the last window. Reading, saving or changing a map does so by itself."""
        self.fusion.flush()

    def _with_properties(self, frame: Frame, clock: StageClock) -> tuple[Frame, dict[str, str]]:
        """The frame with an image of every property (f_im, Fig. 6), and by name why one cannot be
        had.
        """
        lacking = {}
        if frame.color is None:
            lacking["color"] = f"{frame.label}: there is no colour image"
        for name, source in self.sources.items():
            try:
                with clock.stage(f"{name} image"):
                    frame = source.add_to(frame)
                if name not in self._maps:
                    self._maps[name] = source.make_map(frame)
                    self.groups = group_maps(self._maps.values())
                    if self.memory:
                        self.memory.follow(self._maps)
            except FrameError as error:
                lacking[name] = str(error)
                frame = frame.without_image(name)
        return frame, lacking

    def run(
        self,
        sequence: Sequence[Frame],
        *,
        strict: bool = False,
        stop: Callable[[], bool] = lambda: False,
        on_frame: Callable[[int, int], None] = lambda done, total: None,
        on_step: OnStep = lambda frame, step, pipeline: None,
        on_skip: Callable[[SkippedFrame], None] = lambda skipped: None,
        on_border: OnBorder | None = None,
        before: RunSoFar | None = None,
    ) -> RunResult:
        """Fuse a sequence in order, skipping frames that cannot be used; `strict` ends the run at
        the first of them.

        `stop` is asked before every frame, `on_frame` told after it how many there were, `on_step`
        after each that was fused what it did, `on_skip` which one was not used and why: there a
        viewer can look at the maps. `on_border` is told between two windows, when all frames so far
        are fused; with what the run did until then as `before`, and the maps and `fusion.borders` of
        that moment, another pipeline goes on and ends as if nothing had happened. What ends a run
        early, an error of any kind too, is in the result, with all that was done until then; raises
        it, or DatasetError, only where not one frame could be used.
        """
        check_sequence("Pipeline.run", sequence)
        self.settle(first_frames(sequence, stop) if not self._maps else ())
        log, failure, interrupted = RunLog(sequence, self.config.preprocess, before), None, False
        self.fusion.at_border = on_border and (lambda: on_border(log, self))
        for i, load in enumerate(load_ahead(sequence, log.done), log.done):
            if interrupted := stop():
                break
            waiting = time.perf_counter()
            try:
                frame = load()
                waited = time.perf_counter() - waiting
                log.check_depth_scale(frame)
                step = self.step(frame)
                log.add_step(frame, step, waited)
                on_step(frame, step, self)
            except tuple(SKIP_REASONS) as error:
                on_skip(log.add_skipped(i, error))
                failure = error if strict else None
            except Exception as error:  # noqa: BLE001 - none may cost the frames before it
                failure = self._ended_by(error)
            log.done = i + 1
            on_frame(i + 1, len(sequence))
            if failure:
                break
        self.fusion.at_border = None
        try:
            log.add_flush(self._flush())
        except Exception as error:  # noqa: BLE001
            failure = failure or self._ended_by(error)
            self.fusion.give_up()
        return log.result(interrupted, failure)

    def _ended_by(self, error: Exception) -> Exception:
        """The error that ends a run; what it kept from being fused is tried once more at the end."""
        logger.debug("the run ended early", exc_info=error)
        self.fusion.try_again()
        return as_known(error)

    def extract_mesh(
        self,
        resolution: int | None = None,
        *,
        bounds: ArrayLike | None = None,
        blocks: NDArray[np.int32] | None = None,
        flush: bool = True,
    ) -> Mesh:
        """The mesh of all that was fused so far, coloured; `resolution` and `bounds`, lowest and highest
        corner of a box [m], override the configuration's.

        With `blocks` (M, 3), what lies in these, small parts too; without `flush`, frames that wait to
        be fused are left out: see `SurfaceMap.extract_mesh`.
        """
        settings = self.config.mesh
        resolution = settings.resolution if resolution is None else resolution
        if bounds is None and blocks is None:
            bounds = settings.bounds
        if self.memory and blocks is None:
            return joined_mesh(self.memory, resolution, settings.min_area, bounds)
        return extract_mesh(
            self.surface,
            self.properties,
            resolution,
            settings.min_area if blocks is None else 0.0,
            bounds=bounds,
            blocks=blocks,
            flush=flush,
        )


def extract_mesh(
    surface: SurfaceMap,
    properties: Mapping[str, PropertyMap],
    resolution: int,
    min_area: float = 0.0,
    *,
    bounds: ArrayLike | None = None,
    blocks: NDArray[np.int32] | None = None,
    flush: bool = True,
) -> Mesh:
    """The surface as a mesh that carries every property that has data; `bounds`, `blocks` and
    `flush` as in `SurfaceMap.extract_mesh`.
    """
    mesh = surface.extract_mesh(resolution, min_area, bounds=bounds, blocks=blocks, flush=flush)
    for name, source in properties.items():
        if len(source.grid) and len(mesh.vertices):
            mesh = mesh.with_attribute(name, source.query(mesh.vertices, flush=flush))
    return mesh


def warm_up(config: Config | None = None) -> None:
    """Compile what a pipeline of these settings runs, which takes seconds, so that its first frame
    takes no longer than the others; its kernels are also kept on disk for the next process.
    """
    pipeline = Pipeline(config)
    depth = np.tile(np.linspace(0.8, 1.2, 64, dtype=np.float32), (48, 1))
    color = np.full((48, 64, 3), 128, np.uint8)
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    pipeline.step(Frame(depth, camera, color, np.eye(4)))
    pipeline.flush()
    pipeline.extract_mesh()
