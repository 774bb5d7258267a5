"""What a pipeline asks for images of a property and for a map of it, whatever makes them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from ..errors import InputError, shortened
from ..maps import BaseMap
from ..maps.settings import PropertySettings
from ..types import Frame


class Source(Protocol):
    """What makes an image of a property from a frame (f_im, Fig. 6), and a map for it."""

    @property
    def name(self) -> str: ...

    def add_to(self, frame: Frame) -> Frame: ...

    def make_map(self, frame: Frame) -> BaseMap: ...


class PropertySource(Source, Protocol):
    """A source whose map is made before the first frame."""

    def with_settings(self, settings: PropertySettings, scale: float) -> PropertySource: ...

    def make_map(self, frame: Frame | None = None) -> BaseMap: ...


def sources_by_name(sources: Iterable[Source]) -> dict[str, Source]:
    """The sources by their names; raises InputError for a name given twice, and for what is none."""
    named: dict[str, Source] = {}
    for source in sources:
        if not hasattr(source, "add_to"):
            raise InputError(
                f"properties: expected SurfaceProperty(...), got {shortened(source)}; names go into the "
                "settings, as Config(properties=('saliency',))"
            )
        if named.setdefault(source.name, source) is not source:
            raise InputError(
                f"property '{source.name}' is asked for twice; give one of them another name, as in "
                f"{source.name},name=other"
            )
    return named


def check_encoder(encoder: object) -> None:
    """Raise InputError for what cannot encode a frame's image; None, for no features, can stay."""
    if encoder is not None and not (
        hasattr(encoder, "name") and callable(getattr(encoder, "image_features", None))
    ):
        raise InputError(
            f"encoder: expected an object with a name and image_features(frame), got {shortened(encoder)}; "
            "language.make_image_encoder('clip:FOLDER') makes one"
        )
