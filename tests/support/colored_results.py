"""A small results folder with features that anybody can check: which of three colours a block of
pixels leans to, with names as directions of colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion.cli import main as cli

NAMES = ("red", "green", "blue")


def color_features(color: np.ndarray) -> np.ndarray:
    """Features (H/4, W/4, 3) of an image (H, W, 3)."""
    height, width = color.shape[:2]
    blocks = color.reshape(height // 4, 4, width // 4, 4, 3).mean(axis=(1, 3)) / 255
    return (blocks - blocks.min(axis=2, keepdims=True) + 0.02).astype(np.float32)


@dataclass(frozen=True)
class ColoredResults:
    """Where the results lie, what they were made from, and the vectors of NAMES."""

    path: Path
    recording: Path
    embeddings: Path

    @property
    def text(self) -> str:
        """The text encoder, as the command line takes it."""
        return f"embeddings:{self.embeddings}"


def make_colored_results(folder: Path, frames: int = 3) -> ColoredResults:
    """Run `understand` on a few frames, with saliency as a property beside colour."""
    images = make_frames(frames)
    recording = write_folder(folder / "recording", images)
    (recording / "clip").mkdir()
    for i, frame in enumerate(images):
        np.save(recording / "clip" / f"{i}.npy", color_features(frame.color).astype(np.float16))
    embeddings = folder / "colors.npz"
    np.savez(embeddings, names=NAMES, vectors=np.eye(3))
    words = ["understand", "folder", str(recording), *FLAGS]
    words += ["--features", f"folder:{recording / 'clip'}"]
    (folder / "more.yaml").write_text("properties: [saliency]\n")
    words += ["--config", str(folder / "more.yaml")]
    assert cli.main([*words, "--out", str(folder / "results")]) == 0
    return ColoredResults(folder / "results", recording, embeddings)
