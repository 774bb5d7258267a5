"""Window: consecutive frames that see the same voxels, summed up in one set of cells, and encoded,
fused and voted once: the local LIM of a window (Fig. 5, Sec. IV-E).

Sums are whole numbers, so frames of a window may come in any order, and one that is refused leaves
no trace. Noise d of the regression is a frame's: a voxel that n frames of the window saw is
regressed with n d.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import Arena, DeviceArray
from ..errors import UniFusionError
from ..geometry.se3 import distance, inverse
from ..kernels import ti
from ..kernels.patches import Patches, Targets
from ..types import Frame, PinholeCamera
from .kept_window import KeptCells, KeptFeatures, KeptViews, KeptWindow
from .lenses import lens_beside, nearly_same, through_lenses
from .local_lim import WINDOW_BYTES, CellArrays
from .open_part import OpenPart
from .property_group import MapGroup, Part
from .regression_map import RegressionMap
from .surface_map import SurfaceMap
from .value_scale import exponents_for, fits, steps_for

# A window ends where the camera has moved this far from its first frame [m, degrees]: from there
# fewer voxels are shared, and a window that a loop moves would bend.
FARTHEST_MOVE, LARGEST_TURN = 0.6, 30.0
GAP = 3  # a step between frames that is so many times the usual one ends a window
ROOM = 256 << 20  # bytes of a part's sums, or of depth images, beyond which a window ends
VOTE_PIECES = 40
NEVER = 2**31 - 1  # as the first block to add to
PIECE = 10_000  # blocks encoded at once, times the rank, and twice if samples carry normals


@dataclass(frozen=True)
class Piece:
    """Some milliseconds of the work that fuses a window."""

    name: str  # of the maps that it is for
    work: Callable[[], object]


Keep = Callable[[KeptWindow], None]


class FindPatches(Protocol):
    """Makes the patches of a frame, and sums them up in the cells of targets."""

    def __call__(self, targets: Targets, *, write: bool) -> Patches: ...


@dataclass
class Window:
    """Frames that are summed up. The first one is the keyframe; all carry the same, and were taken
    by the same camera, whose focal length and centre may change a little, as with autofocus.
    """

    T_world_keyframe: NDArray[np.float64]
    camera: PinholeCamera  # of the keyframe
    carried: frozenset[str]  # what each frame carries
    images: DeviceArray  # (K, H, W) [m] depth of the views
    parts: dict[tuple[str, ...], OpenPart]  # by the names of their maps
    others: bool  # whether other maps want patches too
    apart: bool = False  # it is kept, and not fused: nobody knows where it belongs yet
    T_camera_world: list[NDArray[np.float64]] = field(default_factory=list)  # of the views
    lenses: list[NDArray[np.float64]] = field(default_factory=list)  # as `lens_beside` has them
    frames: list[int] = field(default_factory=list)  # their places in the recording
    features: list[KeptFeatures] = field(default_factory=list)  # that they brought to other maps

    def __len__(self) -> int:
        """Frames summed up."""
        return len(self.T_camera_world)

    @property
    def full(self) -> bool:
        """Whether there is no room for another frame."""
        most = max((each.bytes for each in self.parts.values()), default=0)
        return len(self) == self.images.shape[0] or most > ROOM

    def is_near(self, frame: Frame) -> bool:
        """Whether a frame was taken by the same camera from about the same place."""
        moved, turned = distance(self.T_world_keyframe, frame.require_pose())
        near = moved <= FARTHEST_MOVE and np.degrees(turned) <= LARGEST_TURN
        return near and nearly_same(frame.camera, self.camera)

    def has_room_for(self, frame: Frame) -> bool:
        """Whether the values of a frame are of a size that can be summed with those before."""
        return all(
            fits(each.part.maps, each.cells.exponents, frame) for each in self.parts.values()
        )

    def add(self, frame: Frame, find: FindPatches, reach: float) -> tuple[Patches, dict[str, int]]:
        """Sum up a frame, whose depth image is already there; returns its patches, and by name how
        many voxels of a map were not in the window before.

        Patches within `reach` [m] of the camera are added to the cells of the surface and of the
        colours while they are made; other parts bin them afterwards. A frame without any is not
        added. Raises OutOfRange for points beyond a map's index range, CapacityError where a map
        would grow beyond safe memory; the window is then unchanged.
        """
        before = {names: each.cells for names, each in self.parts.items()}
        direct = [self._direct(names, frame, reach) for names in (("surface",), ("color",))]
        try:
            patches = self._sum_up(direct, find)
            for names, each in self.parts.items():
                if each not in direct and patches.total:
                    each.cells = each.part.binner.touch(each.cells, patches)
                each.part.expect(each.cells.count, each.cells.count - before[names].count)
        except UniFusionError:
            find(self._targets(direct, sign=-1), write=False)
            for names, each in self.parts.items():
                each.part.binner.forget(each.cells, before[names])
                each.cells = before[names]
            raise
        if patches.total == 0:
            return patches, {}
        for each in self.parts.values():
            if each not in direct:
                each.part.binner.add(each.cells, patches, each.part.carried(patches), len(self))
        self.T_camera_world.append(inverse(frame.require_pose()))
        self.lenses.append(lens_beside(frame.camera, self.camera))
        self.frames.append(frame.index)
        touched = {
            name: each.cells.count - before[names].count
            for names, each in self.parts.items()
            for name in names
        }
        return patches, touched

    def _direct(self, names: tuple[str, ...], frame: Frame, reach: float) -> OpenPart | None:
        """The part of surface or colour alone, if all that a frame may see lies in its range."""
        part = self.parts.get(names)
        if part is None or not part.part.binner.reaches(frame.require_pose(), reach):
            return None
        if part.cells.exponents:  # colours are added to these as they are
            return None
        return part if names != ("color",) or "color" not in frame.images else None

    def _targets(
        self, direct: Sequence[OpenPart | None], first: tuple[int, int] = (0, 0), sign: int = 1
    ) -> Targets:
        surface, color = [each and each.part.binner.target(each.cells) for each in direct]
        return Targets(len(self), surface, color, first, sign)

    def _sum_up(self, direct: Sequence[OpenPart | None], find: FindPatches) -> Patches:
        """Make a frame's patches and add them to the cells of some parts on the way; those of blocks
        that there was no room for come in a second round.
        """
        write = len(self.parts) > sum(each is not None for each in direct) or self.others
        room = [each.cells.arrays.room if each else 0 for each in direct]
        patches = find(self._targets(direct), write=write)
        for each, blocks in zip(direct, patches.blocks, strict=True):
            if each is not None:
                each.cells = replace(each.cells, count=blocks)
        if any(blocks > n for blocks, n in zip(patches.blocks, room, strict=True)):
            for each, n in zip(direct, room, strict=True):
                if each is not None:
                    each.cells.arrays.reserve_keys(each.cells.count, min(n, each.cells.count))
                    each.cells.arrays.reserve(each.cells.count, min(n, each.cells.count))
            first = [
                n if blocks > n else NEVER for blocks, n in zip(patches.blocks, room, strict=True)
            ]
            find(self._targets(direct, (first[0], first[1])), write=False)
        return patches

    def rehearse(self, names: tuple[str, ...]) -> None:
        """Fuse no voxel to the maps of a part: what that takes is compiled then, and no later frame
        waits for it.
        """
        part = self.parts[names]
        for piece in self._pieces(replace(part, cells=replace(part.cells, count=0))):
            piece.work()

    def close(self, keep: Keep | None = None) -> list[Piece]:
        """The work that fuses the window, in order; the sums are free for another one. `keep` is
        told in the end what it was; what is fused is then what is kept.
        """
        kept = {} if keep is None else self.parts
        cells = {names: each.kept_cells() for names, each in kept.items()}
        pieces = [piece for each in self.parts.values() for piece in self._pieces(each)]
        growth = [
            Piece(" + ".join(names), grow)
            for names, each in self.parts.items()
            for grow in each.part.grow_ahead(each.cells.count)
        ]
        for n, piece in enumerate(growth, 1):  # so that no frame does several of them
            pieces.insert(n * len(pieces) // (len(growth) + 1), piece)
        if keep is not None:
            pieces.append(Piece("keep", lambda: keep(self._kept(cells))))
        return pieces

    @property
    def surfaces(self) -> list[SurfaceMap]:
        """The maps in which rays vote."""
        maps = [each for part in self.parts.values() for each in part.part.maps]
        return [each for each in maps if isinstance(each, SurfaceMap) and each.settings.carve]

    def _kept(self, cells: Mapping[tuple[str, ...], KeptCells]) -> KeptWindow:
        T_keyframe_camera = inverse(np.array(self.T_camera_world) @ self.T_world_keyframe)
        views = KeptViews.of(self.images, self.camera, T_keyframe_camera, np.array(self.lenses))
        frames, features = tuple(self.frames), tuple(self.features)
        return KeptWindow(frames, self.T_world_keyframe, cells, views, features, self.apart)

    def _poses(self) -> NDArray[np.float32]:
        """(K, 3, 4) T_camera_world of the views, as the keyframe's camera would have to see them."""
        return through_lenses(np.array(self.T_camera_world), np.array(self.lenses))

    def _pieces(self, part: OpenPart) -> Iterator[Piece]:
        name, encoder = " + ".join(part.part.names), part.part.encoder
        binned = part.part.binner.close(part.cells, part.arena)
        part.cells.arrays.grow_ahead(part.cells.count)
        if self.apart:  # the sums are free, and nothing is fused
            return
        local = encoder.room(binned)
        step = PIECE // (encoder.layout.size * (2 if encoder.layout.derivatives else 1))
        for begin in range(0, max(binned.count, 1), step):
            end = min(begin + step, binned.count)
            yield Piece(name, partial(encoder.encode_blocks, binned, begin, end, local))
        yield Piece(name, partial(part.part.fuse, local))
        for each in self.surfaces:
            if each in part.part.maps:
                ends = np.linspace(0.0, 1.0 if binned.count else 0.0, VOTE_PIECES + 1)
                for share in pairwise(ends):
                    yield Piece(name, partial(self._vote, each, share))
        yield Piece(name, part.arena.grow_ahead)

    def _vote(self, surface: SurfaceMap, share: tuple[float, float]) -> None:
        """Let all views vote in a share of the voxels of a map, from and to."""
        slots = int(share[0] * surface.grid.count), int(share[1] * surface.grid.count)
        surface.vote(self.images, self.camera, self._poses(), slots)


class WindowFusion:
    """Sums frames up in windows of `size` frames at most, and fuses full ones piece by piece while the
    next one fills, so that no frame of a video waits for a whole window.

    A size of 1 fuses every frame by itself, at once. `keep` is told of every window that was fused,
    so that it can be taken out; `settle` is called whenever one was closed, before it is fused: then
    nothing is summed up, and voxels may come and go.
    """

    def __init__(
        self, size: int, keep: Keep | None = None, settle: Callable[[], None] = lambda: None
    ) -> None:
        self.size, self.keep, self.settle = size, keep, settle
        self.at_border: Callable[[], None] | None = None  # told when all frames are in the maps
        self.window: Window | None = None
        self._last: Window | None = None  # the window of the last frame, which may be closed
        self.pieces: deque[Piece] = deque()
        self._begun: Piece | None = None  # that was handed out, and is not done
        self._just_closed = False  # whether the work that ends a window was done in this frame
        self._rehearsals: list[Piece] = []  # for the first frame that has something for a part
        self._maps: set[RegressionMap] = set()  # that wait
        self.borders = (0, 0)  # where windows end: the last frame's place, and the usual step
        self._room: dict[tuple[str, ...], tuple[CellArrays, Arena]] = {}
        self._known: dict[tuple[str, ...], Part] = {}
        self._images: list[DeviceArray] = []  # of the open window, and of the one before

    def place(self, frame: Frame) -> tuple[DeviceArray, int]:
        """Images (K, H, W) and the one of them that a frame's depth belongs to; ends the window
        that it does not fit into.
        """
        if self.window is not None and not self._continues(self.window, frame):
            self.close()
        if self.window is None:
            if self.at_border is not None:
                self.run(len(self.pieces))
                self._release()
                self.at_border()
            return self._free_images(frame), 0
        return self.window.images, len(self.window)

    def add(
        self,
        frame: Frame,
        find: FindPatches,
        reach: float,
        groups: Sequence[MapGroup],
        others: bool,
    ) -> tuple[Patches, dict[str, int]]:
        """Sum up a frame that `place` was asked for, for the maps of `groups`; whether `others` want
        its patches too. Returns and raises as `Window.add`, with nothing changed where it raises.
        """
        parts = [part for group in groups for part in group.parts(frame)]
        new = [part.names for part in parts if part.names not in self._known]
        window = self.window or Window(
            frame.require_pose(),
            frame.camera,
            frame.carried,
            self._images[0],
            {part.names: self._open(part, frame) for part in parts},
            others,
            frame.apart,
        )
        patches, touched = window.add(frame, find, reach)
        if patches.total == 0:
            return patches, touched
        if self.size > 1:
            self._rehearsals = [
                Piece(" + ".join(names), partial(window.rehearse, names)) for names in new
            ]
        index, stride = self.borders
        stride = stride or (index and abs(frame.index - index))
        self.window, self._last, self.borders = window, window, (frame.index, stride)
        for part in parts:
            for each in part.maps:
                each.waiting = self
                self._maps.add(each)
        if window.full:
            self.close()
        return patches, touched

    def close(self) -> None:
        """End the window: what fuses it waits in `pieces`, after what was there before."""
        if self.window is not None:
            self.run(len(self.pieces))
            self._rehearsals.clear()  # they would take the arena from under the work itself
            self.pieces.extend(self.window.close(self.keep))
            self.window, self._just_closed = None, True
            self.settle()
            self._images.reverse()

    def due(self, frames: int = 0) -> Iterator[Piece]:
        """The pieces to do now, so that all are done when the next window is full, or in so many
        frames: none in the frame that ended a window, which has enough to do, unless it is one itself.
        """
        while self._rehearsals:
            yield self._rehearsals.pop(0)
        busy, self._just_closed = self._just_closed and self.size > 1 and not frames, False
        if busy:
            return
        frames_left = frames or self.size - (len(self.window) if self.window else 0)
        for _ in range(-(-len(self.pieces) // max(frames_left, 1))):
            self._begun = self.pieces.popleft()
            yield self._begun
            self._begun = None
        self._release()

    def run(self, count: int) -> None:
        """Do the next `count` pieces."""
        for _ in range(count):
            piece = self.pieces.popleft()
            try:
                piece.work()
            except Exception:
                self._begun = piece
                raise

    def try_again(self) -> None:
        """Let a piece that failed be the next to do; what it had done, it does again."""
        if self._begun is not None:
            self.pieces.appendleft(self._begun)
            self._begun = None

    def give_up(self) -> None:
        """Drop the frames that wait to be fused: the maps stay as they are."""
        self.pieces.clear()
        self._begun = self.window = None
        self._release()

    def flush(self) -> None:
        """Fuse all frames that were summed up."""
        self.close()
        self.run(len(self.pieces))
        self._release()

    def part(self, names: tuple[str, ...], groups: Sequence[MapGroup]) -> tuple[Part, CellArrays]:
        """Maps that are encoded together, and room to sum up what they take; none must be open."""
        if names not in self._known:
            self._known[names] = next(part for g in groups if (part := g.part_of(names)))
        return self._known[names], self._room_of(self._known[names])[0]

    def attach(self, features: Sequence[KeptFeatures]) -> None:
        """Keep what the last frame brought to maps of features with the window that it lies in."""
        if self._last is not None:
            self._last.features.extend(features)

    def _release(self) -> None:
        """Let go of the maps if nothing waits for them."""
        if self.window is None and not self.pieces:
            for each in self._maps:
                each.waiting = None
            self._maps.clear()

    def _continues(self, window: Window, frame: Frame) -> bool:
        index, stride = self.borders
        gap = stride and abs(frame.index - index) > GAP * stride
        same = frame.carried == window.carried and frame.apart == window.apart
        same = same and window.has_room_for(frame)
        return not gap and same and window.is_near(frame)

    def _open(self, part: Part, frame: Frame) -> OpenPart:
        arrays, arena = self._room_of(part)
        self._known[part.names] = part
        exponents = exponents_for(part.maps, frame)
        if self.keep is not None:
            for each in part.maps:
                each.grid.sum_exactly(steps_for(exponents))
        return OpenPart(part, part.binner.open(arrays, exponents), arena)

    def _room_of(self, part: Part) -> tuple[CellArrays, Arena]:
        if part.names not in self._room:
            self._room[part.names] = CellArrays(part.binner.width, WINDOW_BYTES), Arena()
        return self._room[part.names]

    def _free_images(self, frame: Frame) -> DeviceArray:
        """Room for the views of a window that begins; those of the one before may still vote."""
        count = min(self.size, max(ROOM // frame.depth.nbytes, 1))
        shape = (count, *frame.depth.shape)
        if not self._images or self._images[0].shape != shape:
            self.run(len(self.pieces))
            self._images = [ti.ndarray(ti.f32, shape) for _ in range(2 if self.size > 1 else 1)]
        return self._images[0]
