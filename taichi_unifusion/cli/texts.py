"""Options of every command that asks a map of features, and what such a command reads of a results
folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ..errors import FileError, InputError

if TYPE_CHECKING:
    from ..language import TextEncoder
    from ..maps import LatentMap
    from ..types import Mesh, Trajectory


@dataclass(frozen=True)
class TextOptions:
    """Which map is asked, and what turns words into vectors."""

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion understand`."""
    text: Annotated[
        str | None,
        arg(metavar="ENCODER", help_behavior_hint="(default: the one that made the features)"),
    ] = field(default=None, kw_only=True)
    """Text encoder: clip:MODEL, onnx:FILE.onnx, or embeddings:FILE (.npz, or .npy with --names)."""
    names: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = field(
        default=None, kw_only=True
    )
    """Names of the vectors of an embeddings file: .txt, .csv or .json."""
    tokenizer: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = field(
        default=None, kw_only=True
    )
    """CLIP's byte-pair merges, for a text encoder in an ONNX file."""
    template: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="TEXT", help_behavior_hint="(default: five; give it once for each)"),
    ] = field(default=(), kw_only=True)
    """What a name is put into, at its {}, such as 'a photo of a {}'; embeddings are averaged over
    templates.
    """
    download: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Allow a CLIP model to be fetched from the Hugging Face hub; without it only what lies on this
    machine is used.
    """
    json: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Print JSON instead of tables."""
    device: Literal["auto", "cuda", "cpu"] = field(default="auto", kw_only=True)
    """Where to compute."""

    @property
    def templates(self) -> tuple[str, ...]:
        """The templates asked for, or the usual ones."""
        from ..language.prompts import TEMPLATES

        return self.template or TEMPLATES

    def encoder(self, source: str) -> TextEncoder:
        """The text encoder asked for, or the one that belongs to features of `source`; InputError
        where there is none.
        """
        from ..language import make_text_encoder

        text = self.text or (source if source.startswith("clip:") else None)
        if text is None:
            raise InputError(
                f"{self.dir}: its features come from {source or 'an unknown network'}; give the text encoder that "
                "belongs to them, with --text clip:MODEL, onnx:FILE.onnx or embeddings:FILE"
            )
        kind = text.partition(":")[0]
        options = {
            "clip": {"download": self.download, "device": self.device},
            "onnx": {"tokenizer": self.tokenizer, "device": self.device},
            "embeddings": {"names": self.names},
        }.get(kind, {})
        return make_text_encoder(text, **options)


@dataclass(frozen=True)
class Understood:
    """What a results folder holds for questions."""

    mesh: Mesh
    features: LatentMap
    trajectory: Trajectory | None


def read_understood(directory: Path, device: str) -> Understood:
    """Mesh, map of features and trajectory of a results folder; raises FileError where one is
    missing or damaged.
    """
    from .. import runtime
    from ..files.mesh_reading import read_mesh
    from ..files.trajectories import read_trajectory
    from ..maps import LatentMap
    from ..pipeline import FEATURES
    from ..results.run_folder import RunFolder

    folder = RunFolder(directory)
    file, mesh_file, poses = folder.map(FEATURES), folder.mesh, folder.trajectory
    if not file.exists():
        raise FileError(
            f"{directory}: no {folder.relative(file)} here; give the results folder of `unifusion understand`"
        )
    if not mesh_file.exists():
        raise FileError(
            f"{directory}: no {mesh_file.name} here; `unifusion mesh {directory}` makes it again"
        )
    mesh = read_mesh(mesh_file)
    if not len(mesh.vertices) or not len(mesh.faces):
        raise InputError(f"{mesh_file}: the mesh is empty, there is nothing to ask")
    runtime.init(device)
    return Understood(
        mesh, LatentMap.load(file), read_trajectory(poses) if poses.exists() else None
    )
