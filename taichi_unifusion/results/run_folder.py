"""Where everything lies in the folder of a run: the only place that knows a file's name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..files.maps import is_foreign
from ..files.tiles import INDEX

MESH_SUFFIXES = ("ply", "glb", "obj")  # in the order in which meshes are written
NAMED = 5  # folders in a message


@dataclass(frozen=True)
class RunFolder:
    """The paths of a run's files; none of them need exist."""

    path: Path

    @property
    def record(self) -> Path:
        """What the run did, a RunRecord."""
        return self.path / "metrics.json"

    @property
    def config(self) -> Path:
        """Every setting of the run."""
        return self.path / "config.yaml"

    @property
    def trajectory(self) -> Path:
        """The poses of the frames used, in TUM's format."""
        return self.path / "trajectory.txt"

    @property
    def tracking(self) -> Path:
        """What a tracker says about every frame, as a table."""
        return self.path / "tracking.csv"

    @property
    def tracked_poses(self) -> Path:
        """The poses that a tracker found, those of unused frames too, in TUM's format."""
        return self.path / "tracking.txt"

    @property
    def windows(self) -> Path:
        """What the windows of the maps were fused from, a `WindowStore`."""
        return self.path / "windows.log"

    @property
    def new_windows(self) -> Path:
        """The same of a run that is not done."""
        return self.path / ".windows.log.tmp"

    @property
    def keyframes(self) -> Path:
        """What a camera that comes back another day finds its place by."""
        return self.path / "keyframes.log"

    @property
    def new_keyframes(self) -> Path:
        """The same of a run that is not done."""
        return self.path / ".keyframes.log.tmp"

    @property
    def color_camera(self) -> Path:
        """The colour camera that images were registered with, where there is one."""
        return self.path / "color_camera.yaml"

    @property
    def map_folder(self) -> Path:
        """Where the maps lie."""
        return self.path / "maps"

    def map(self, name: str) -> Path:
        """The map of that name."""
        return self.map_folder / f"{name}.safetensors"

    def tiled_map(self, name: str) -> Path:
        """The folder with the tiles of the map of that name."""
        return self.map_folder / name

    def saved_map(self, name: str) -> Path:
        """Where the map of that name lies, in tiles or in one file; need not exist."""
        return self.maps.get(name, self.map(name))

    @property
    def maps(self) -> dict[str, Path]:
        """The maps that exist, by name: files, or folders of tiles; safetensors of others are none."""
        found = sorted(self.map_folder.glob(self.map("*").name))
        files = {path.stem: path for path in found if not is_foreign(path)}
        tiled = {path.parent.name: path.parent for path in self.map_folder.glob(f"*/{INDEX}")}
        return dict(sorted({**files, **tiled}.items()))

    @property
    def foreign_maps(self) -> tuple[Path, ...]:
        """Files of others that lie where the maps do."""
        return tuple(filter(is_foreign, sorted(self.map_folder.glob(self.map("*").name))))

    @property
    def working_tiles(self) -> Path:
        """Where the maps of a run that keeps them in tiles lie until it is done."""
        return self.path / "unfinished-tiles"

    @property
    def shards(self) -> Path:
        """Where the partial maps of workers lie until a run is done."""
        return self.path / "shards"

    @property
    def features(self) -> Path:
        """The map of image-text features, which questions are put to."""
        return self.saved_map("features")

    @property
    def mesh(self) -> Path:
        """The mesh with everything that the maps know of its vertices."""
        return self.mesh_file("ply")

    def mesh_file(self, suffix: str) -> Path:
        """The mesh in one of MESH_SUFFIXES."""
        return self.path / f"mesh.{suffix}"

    @property
    def meshes(self) -> tuple[Path, ...]:
        """The mesh in every format."""
        return tuple(map(self.mesh_file, MESH_SUFFIXES))

    @property
    def preview(self) -> Path:
        """A picture of the mesh."""
        return self.path / "preview.png"

    def property_mesh(self, name: str, suffix: str) -> Path:
        """The mesh in the colours of a property, in one of MESH_SUFFIXES."""
        return self.path / f"{name}.{suffix}"

    def property_meshes(self, name: str) -> tuple[Path, ...]:
        """The mesh in the colours of a property, in every format."""
        return tuple(self.property_mesh(name, suffix) for suffix in MESH_SUFFIXES)

    def property_picture(self, name: str) -> Path:
        """A picture of that mesh, with a legend."""
        return self.path / f"{name}.png"

    def property_files(self, name: str) -> tuple[Path, ...]:
        """Everything that a run writes of a property beside its map."""
        return (*self.property_meshes(name), self.property_picture(name))

    @property
    def answers(self) -> Path:
        """The regions that a query found."""
        return self.path / "query.json"

    @property
    def answer_columns(self) -> Path:
        """The mesh with a column of relevance for each of several texts."""
        return self.answers.with_suffix(".ply")

    def answer_mesh(self, text: str) -> Path:
        """The mesh coloured by relevance to a text, which is given as a part of a file's name."""
        return self.path / f"query-{text}.ply"

    def answer_picture(self, text: str) -> Path:
        """A picture of that mesh."""
        return self.answer_mesh(text).with_suffix(".png")

    @property
    def segmentation(self) -> Path:
        """Shares and scores of the labels."""
        return self.path / "segmentation.json"

    @property
    def segmentation_mesh(self) -> Path:
        """The mesh with a label at every vertex."""
        return self.segmentation.with_suffix(".ply")

    @property
    def segmentation_picture(self) -> Path:
        """A picture of that mesh, with a legend."""
        return self.segmentation.with_suffix(".png")

    @property
    def page(self) -> Path:
        """The mesh as a page that opens in any browser, without a server."""
        return self.path / "page.html"

    def part(self, number: int) -> Path:
        """A part of the mesh that somebody cut out."""
        return self.path / f"part-{number}.ply"

    @property
    def unfinished(self) -> Path:
        """Where safe points of a run lie that is not done."""
        return self.path / "unfinished"

    @property
    def state(self) -> Path:
        """What the last safe point is."""
        return self.unfinished / "state.json"

    @property
    def journal(self) -> Path:
        """What the run did, a line a frame."""
        return self.unfinished / "steps.jsonl"

    @property
    def tracking_state(self) -> Path:
        """The poses that a tracker found, as a run needs them that goes on."""
        return self.unfinished / "tracking.json"

    @property
    def placement(self) -> Path:
        """Where a recording lies in the map that it is added to."""
        return self.unfinished / "placement.json"

    @property
    def placed_keyframes(self) -> Path:
        """The keyframes of both."""
        return self.unfinished / self.keyframes.name

    @property
    def safe_windows(self) -> Path:
        """What the windows of a safe point were fused from, and of windows after it."""
        return self.unfinished / self.windows.name

    def generation(self, number: int) -> Path:
        """Where the maps of a safe point lie."""
        return self.unfinished / f"generation-{number}"

    @property
    def generations(self) -> tuple[Path, ...]:
        """The safe points whose maps are there, maybe not all of them."""
        return tuple(self.unfinished.glob("generation-*"))

    @property
    def safe_maps(self) -> tuple[Path, ...]:
        """The maps of safe points."""
        names = (self.map("*").name, f"*/{INDEX}")
        found = [file for each in self.generations for name in names for file in each.glob(name)]
        return tuple(sorted(file.parent if file.name == INDEX else file for file in found))

    def config_in(self, generation: Path) -> Path:
        """The settings of a safe point."""
        return generation / self.config.name

    def map_in(self, generation: Path, name: str) -> Path:
        """A map of a safe point in one file."""
        return generation / self.map(name).name

    def sums_in(self, generation: Path, name: str) -> Path:
        """What a map of a safe point that can follow a loop holds and its file does not."""
        return generation / f"{name}.sums"

    def tiles_in(self, generation: Path, name: str) -> Path:
        """A map of a safe point in tiles."""
        return generation / name

    @property
    def lock(self) -> Path:
        """Says who writes into the folder now."""
        return self.path / "run.lock"

    @property
    def tracking_files(self) -> tuple[Path, ...]:
        """What a tracker leaves."""
        return self.tracking, self.tracked_poses

    @property
    def asked(self) -> tuple[Path, ...]:
        """The files that exist with the names of answers to questions; `ownership.answer_files` are
        those that are answers.
        """
        patterns = (self.answer_mesh("*"), self.answer_picture("*"))
        found = {file for pattern in patterns for file in self.path.glob(pattern.name)}
        known = (self.answers, self.answer_columns, *self.segmentation_files)
        found |= {file for file in known if file.exists()}
        return tuple(sorted(found))

    @property
    def segmentation_files(self) -> tuple[Path, ...]:
        """All that labelling leaves."""
        return self.segmentation, self.segmentation_mesh, self.segmentation_picture

    def run_files(self, maps: Iterable[str], formats: Iterable[str]) -> tuple[Path, ...]:
        """What a run writes that makes these maps and meshes in these formats."""
        maps, formats = tuple(maps), tuple(formats)
        shown = [name for name in maps if name not in ("surface", "color", "features")]
        files = [self.map(name) for name in maps] + [self.trajectory, self.config, self.record]
        files.append(self.color_camera)
        files += [self.mesh_file(suffix) for suffix in formats] + [self.preview]
        for name in shown:
            files += [self.property_mesh(name, suffix) for suffix in formats]
            files.append(self.property_picture(name))
        return tuple(files)

    def could_write(self, name: str) -> bool:
        """Whether a run or a question could have written a file of that name, relative to the
        folder.
        """
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\0" in name or len(path.parts) > 3:
            return False
        if len(path.parts) == 3:
            return self.path / path == self.tiled_map(path.parts[1]) / INDEX
        if len(path.parts) == 2:
            return self.path / path == self.map(path.stem)
        fixed = (self.record, self.config, self.trajectory, self.color_camera, self.answers)
        fixed = (*fixed, self.windows, self.keyframes)
        fixed = {file.name for file in (*fixed, *self.tracking_files, *self.segmentation_files)}
        return name in fixed or path.suffix[1:] in (*MESH_SUFFIXES, "png")

    @property
    def temporaries(self) -> tuple[Path, ...]:
        """What writing leaves behind where the process is ended at once."""
        folders = (self.path, self.map_folder, self.unfinished, *self.generations)
        return tuple(file for folder in folders for file in folder.glob(".*.tmp"))

    def relative(self, file: Path) -> str:
        """The name of a file in messages and records: relative to the folder."""
        return file.relative_to(self.path).as_posix()


def why_no_mesh(folder: RunFolder) -> str:
    """What to say of a folder without a mesh: maybe the results lie in folders in it."""
    inner = sorted(file.parent for file in folder.path.glob(f"*/{folder.mesh.name}"))
    if inner and not folder.maps:
        named = ", ".join(map(str, inner[:NAMED])) + ", ..." * (len(inner) > NAMED)
        return f"{folder.path}: is no results folder; those in it are {named}"
    return (
        f"{folder.mesh}: no such file; give a results folder, or make its mesh with: unifusion mesh "
        f"{folder.path}"
    )
