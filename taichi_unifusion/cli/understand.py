"""`unifusion understand`: frames -> surface, colour and a map of image-text features, in one pass."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from .options import for_mapping, open_recording
from .reconstruct import Reconstruct, fuse

if TYPE_CHECKING:
    from ..language import EncoderChoice


@dataclass(frozen=True)
class Understand(Reconstruct):
    """Map image-text features, such as CLIP's, onto the surface; then ask with `query`.

    Example: unifusion understand 7scenes my/redkitchen --every 10 --features
    clip:models/clip-vit-b16 --out results/kitchen

    Settings that `unifusion config --help` explains are options here too, for example
    --feature-map.voxel-size 0.05.
    """

    features: Annotated[str, arg(metavar="ENCODER")] = field(kw_only=True)
    """What makes features: clip:MODEL (a folder, or a name with --download), onnx:FILE.onnx,
    folder:PATH of saved ones, or points:FILE,POINTS.ply of features at points.
    """
    method: Literal["dense", "crops"] = field(default="dense", kw_only=True)
    """clip: features of every patch in one go, or of overlapping windows at several scales (slow,
    coarse).
    """
    short_side: Annotated[int, arg(metavar="PIXELS")] = field(default=336, kw_only=True)
    """clip, dense: shorter side of the image that the network sees."""
    patch: Annotated[int, arg(metavar="PIXELS")] = field(default=16, kw_only=True)
    """onnx: edge of a patch, for networks that give one feature a patch."""
    layout: Literal["auto", "hwc", "chw"] = field(default="auto", kw_only=True)
    """folder: order of height, width and channels in the files; auto tells by the image's shape."""
    feature_images: Literal["recorded", "registered"] = field(default="recorded", kw_only=True)
    """folder: whether the features were made of colour images as they were recorded, or as they were
    registered to depth. It matters where a colour camera of its own was found or given.
    """
    download: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Allow a CLIP model to be fetched from the Hugging Face hub; without it only what lies on this
    machine is used.
    """

    @property
    def image_encoder(self) -> EncoderChoice:
        """What makes features."""
        from ..language import EncoderChoice

        device = self.settings.device
        choices = {
            "clip": {
                "method": self.method,
                "short_side": self.short_side,
                "download": self.download,
                "device": device,
            },
            "onnx": {"patch": self.patch, "device": device},
            "folder": {"layout": self.layout, "images": self.feature_images},
        }.get(self.features.partition(":")[0], {})
        return EncoderChoice(self.features, choices)


def understand(options: Understand) -> int:
    """Frames -> maps -> mesh -> results folder."""
    options = replace(options, recording=for_mapping(options.recording))
    # opened first, so that an unreadable recording is reported before a network is loaded
    recording = open_recording(options.recording)
    choice = options.image_encoder
    return fuse(recording, options, choice.make())
