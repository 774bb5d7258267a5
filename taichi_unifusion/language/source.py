"""FeatureSource: an image encoder as a source of features for a map of them (Fig. 6 c)."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..maps import FeatureMap, FeatureSettings
from ..networks.encoders import ImageEncoder, feature_image
from ..types import Frame

FEATURES = "features"  # of the map, if nothing else is said


@dataclass(frozen=True)
class FeatureSource:
    """Features of every frame's image, for a map of their name; of its colour image as it was recorded
    where the encoder is `recorded`.
    """

    encoder: ImageEncoder
    settings: FeatureSettings = field(default_factory=FeatureSettings)
    name: str = FEATURES

    def add_to(self, frame: Frame) -> Frame:
        """The frame with its features; raises FrameError where it has none."""
        recorded = getattr(self.encoder, "recorded", False)
        view = frame.color_view if recorded else None
        return frame.with_features(self.name, feature_image(self.encoder, frame), view)

    def make_map(self, frame: Frame) -> FeatureMap:
        """An empty map for the features of such a frame, which say how many channels there are."""
        channels = frame.features[self.name].values.shape[2]
        return FeatureMap(self.name, channels, self.settings, source=self.encoder.name)
