"""What every data set is: a sequence of frames, each loaded when indexed; slices are views."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import overload

from ..types import Frame


class Dataset(ABC, Sequence[Frame]):
    """Frames of one recording: `dataset[i]` loads frame i (or raises FrameError), `dataset[a:b:n]`
    is a view.

    `name` is the format and the path, for messages. Opening is cheap: it lists files, reads poses
    and intrinsics, and raises DatasetError where there is nothing to read. `warnings` holds
    sentences about what is unusual but usable.
    """

    name: str
    warnings: tuple[str, ...] = ()
    no_poses: str = ""  # why no frame has a pose; empty if some have one
    # loading launches kernels, and two threads must not launch kernels at once
    runs_kernels: bool = False

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def load(self, index: int) -> Frame:
        """Load frame `index` of 0..len-1."""

    def without_poses(self) -> Dataset:
        """A view without poses, so that frames with broken poses still load. Default: unchanged."""
        return self

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> DatasetView: ...

    def __getitem__(self, index):
        if isinstance(index, slice):
            return DatasetView(self, range(len(self))[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        return self.load(index % len(self))

    def __iter__(self) -> Iterator[Frame]:
        return (self.load(i) for i in range(len(self)))


class DatasetView(Dataset):
    """Some frames of another data set, loaded from it when asked for."""

    def __init__(self, dataset: Dataset, indices: range) -> None:
        self.dataset, self.indices = dataset, indices
        self.name, self.warnings, self.no_poses = dataset.name, dataset.warnings, dataset.no_poses

    def __len__(self) -> int:
        return len(self.indices)

    def load(self, index: int) -> Frame:
        return self.dataset.load(self.indices[index])

    def without_poses(self) -> DatasetView:
        return DatasetView(self.dataset.without_poses(), self.indices)
