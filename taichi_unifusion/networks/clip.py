"""CLIP and SigLIP by transformers: dense image features without training, and texts.

`dense` is MaskCLIP (Zhou et al. 2022): the last attention layer passes on each patch's own value
instead of mixing patches, so that features stay in place. `crops` embeds overlapping windows at
several scales: slower, coarser, with more context.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FrameError, InputError, MissingDependency, check_choice
from ..files.atomic import read_bytes
from ..files.json_text import parse_json
from ..types import Frame
from .encoders import unit_length
from .image_input import normalized, resized, whole_patches
from .onnx_session import first_line

NORMALIZATION = {  # model type -> mean and standard deviation of the training images, if the folder has none
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
    "siglip": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
}
METHODS = ("dense", "crops")
SHORT_SIDE = 336  # pixels of the image that a network sees
CROP_SHARES = (1.0, 0.5, 0.33)  # edges of the windows over the image's shorter side
CROP_GRID = 24  # feature pixels along the shorter side
BATCH = 16


class ClipModel:
    """A loaded CLIP or SigLIP: both encoders."""

    def __init__(self, name: str, *, device: str = "auto", download: bool = False) -> None:
        self.torch, transformers = _import_torch()
        self.name = f"clip:{name}"
        self.device = self._choose_device(device)
        half = self.device == "cuda"
        try:
            config = transformers.AutoConfig.from_pretrained(name, local_files_only=not download)
            if config.model_type not in NORMALIZATION:
                raise InputError(
                    f"{name}: is a model of type '{config.model_type}', not one of {', '.join(NORMALIZATION)}"
                )
            dtype = self.torch.float16 if half else self.torch.float32
            model = transformers.AutoModel.from_pretrained(
                name, local_files_only=not download, dtype=dtype
            )
            self.tokenizer = transformers.AutoTokenizer.from_pretrained(
                name, local_files_only=not download
            )
        except InputError:
            raise
        except Exception as error:  # noqa: BLE001 (OSError, ValueError, and what the tokenizers raise)
            line = first_line(error)
            hint = "; --download fetches a model of that name from the Hugging Face hub"
            hint = "" if Path(name).exists() or download else hint
            raise FileError(
                f"{name}: no CLIP or SigLIP model that transformers can load here ({line}){hint}"
            ) from None
        self.kind, self.model = config.model_type, model.to(self.device).eval()
        self.patch = config.vision_config.patch_size
        self.window = config.vision_config.image_size
        self.text_length = config.text_config.max_position_embeddings
        self.mean, self.std = _normalization(name, self.kind)

    def _choose_device(self, device: str) -> str:
        check_choice("device", device, ("auto", "cpu", "cuda"))
        has_cuda = self.torch.cuda.is_available()
        if device == "cuda" and not has_cuda:
            raise MissingDependency(
                "device: this torch finds no CUDA; use device 'cpu', or install torch for CUDA"
            )
        return "cuda" if has_cuda and device != "cpu" else "cpu"

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(n, c), unit length."""
        found = []
        for first in range(0, len(texts), BATCH):
            tokens = self.tokenizer(
                list(texts[first : first + BATCH]),
                return_tensors="pt",
                truncation=True,
                padding="max_length",
                max_length=self.text_length,
            ).to(self.device)
            if self.kind == "siglip":
                tokens.pop("attention_mask", None)  # SigLIP was trained without a mask
            with self.torch.inference_mode():
                found.append(_pooled(self.model.get_text_features(**tokens)).float().cpu().numpy())
        return unit_length(np.concatenate(found))

    def pooled_features(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, c) of whole normalised images (n, 3, H, W)."""
        with self.torch.inference_mode():
            return (
                _pooled(self.model.get_image_features(pixel_values=self._tensor(images)))
                .float()
                .cpu()
                .numpy()
            )

    def dense_features(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, h, w, c) of normalised images (n, 3, H, W) whose sides are whole patches."""
        n, _, height, width = images.shape
        with self.torch.inference_mode():
            vision = self.model.vision_model
            out = vision(
                pixel_values=self._tensor(images),
                output_hidden_states=True,
                interpolate_pos_encoding=True,
            )
            tokens = (
                self._values_of_head(vision, out.last_hidden_state)
                if self.kind == "siglip"
                else self._values_of_last_layer(vision, out.hidden_states[-2])
            )
        return (
            tokens.float().cpu().numpy().reshape(n, height // self.patch, width // self.patch, -1)
        )

    def _values_of_last_layer(self, vision: Any, hidden: Any) -> Any:
        """CLIP: the last layer with each patch attending to itself alone, then norm and projection."""
        layer = vision.encoder.layers[-1]
        hidden = hidden + layer.self_attn.out_proj(
            layer.self_attn.v_proj(layer.layer_norm1(hidden))
        )
        hidden = hidden + layer.mlp(layer.layer_norm2(hidden))
        # without the class token
        return self.model.visual_projection(vision.post_layernorm(hidden[:, 1:]))

    def _values_of_head(self, vision: Any, hidden: Any) -> Any:
        """SigLIP: its pooling head, applied to each patch by itself."""
        head = vision.head
        attention, size = head.attention, hidden.shape[-1]
        values = self.torch.nn.functional.linear(
            hidden, attention.in_proj_weight[2 * size :], attention.in_proj_bias[2 * size :]
        )
        hidden = attention.out_proj(values)
        return hidden + head.mlp(head.layernorm(hidden))

    def _tensor(self, images: NDArray[np.float32]) -> Any:
        return self.torch.from_numpy(images).to(self.device, next(self.model.parameters()).dtype)

    def prepared(self, color: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
        """An image (H, W, 3) as the network takes it, (3, height, width); `size` is (width, height)."""
        image = normalized(resized(color, size), self.mean, self.std)
        return np.ascontiguousarray(image.transpose(2, 0, 1))


class ClipImageEncoder:
    """Features of a frame's colour image."""

    def __init__(self, model: ClipModel, method: str, short_side: int) -> None:
        self.model, self.method, self.short_side, self.name = model, method, short_side, model.name

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c), unit length; raises FrameError for a frame without colour."""
        if frame.color is None:
            raise FrameError(f"{frame.label}: has no colour image for CLIP")
        features = unit_length(
            self._dense(frame.color) if self.method == "dense" else self._crops(frame.color)
        )
        if not np.isfinite(features).any():
            raise FrameError(f"{frame.label}: {self.name} gives no finite feature")
        return features

    def _dense(self, color: NDArray[np.uint8]) -> NDArray[np.float32]:
        size = whole_patches(color, self.short_side, self.model.patch)
        return self.model.dense_features(self.model.prepared(color, size)[None])[0]

    def _crops(self, color: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Mean over the windows that hold a pixel, weighted by how near the pixel is to the
        window's centre.
        """
        height, width = color.shape[:2]
        h, w = (max(round(CROP_GRID * side / min(height, width)), 1) for side in (height, width))
        windows = [window for share in CROP_SHARES for window in _windows(height, width, share)]
        total, weights = np.float32(0), np.full((h, w, 1), 1e-6, np.float32)
        rows, columns = (np.arange(h) + 0.5) / h * height, (np.arange(w) + 0.5) / w * width
        for first in range(0, len(windows), BATCH):
            batch = windows[first : first + BATCH]
            images = np.stack(
                [
                    self.model.prepared(
                        np.ascontiguousarray(color[y : y + edge, x : x + edge]),
                        (self.model.window, self.model.window),
                    )
                    for y, x, edge in batch
                ]
            )
            for (y, x, edge), feature in zip(
                batch, unit_length(self.model.pooled_features(images)), strict=True
            ):
                share = np.outer(_tent(rows, y, edge), _tent(columns, x, edge))[..., None].astype(
                    np.float32
                )
                total = total + share * feature
                weights += share
        return total / weights


def clip_image_encoder(
    name: str,
    *,
    method: Literal["dense", "crops"] = "dense",
    short_side: int = SHORT_SIDE,
    device: str = "auto",
    download: bool = False,
) -> ClipImageEncoder:
    """Image encoder of a CLIP or SigLIP model, a folder or a name; raises InputError,
    FileError or MissingDependency.
    """
    check_choice("method", method, METHODS)
    if not 32 <= short_side <= 4096:
        raise InputError(f"short_side: must lie in 32..4096 pixels, got {short_side}")
    return ClipImageEncoder(_load(name, device, download), method, short_side)


def clip_text_encoder(name: str, *, device: str = "auto", download: bool = False) -> ClipModel:
    """Text encoder of the same."""
    return _load(name, device, download)


@lru_cache(maxsize=2)
def _load(name: str, device: str, download: bool) -> ClipModel:
    return ClipModel(name, device=device, download=download)


def _windows(height: int, width: int, share: float) -> list[tuple[int, int, int]]:
    """Squares (top, left, edge) of `share` of the shorter side that cover the image, each half over
    the next.
    """
    edge = max(round(share * min(height, width)), 1)
    corners = [
        np.linspace(0, side - edge, max(-(-2 * (side - edge) // edge), 0) + 1).round().astype(int)
        for side in (height, width)
    ]
    return [(int(y), int(x), edge) for y in corners[0] for x in corners[1]]


def _tent(places: NDArray, first: int, edge: int) -> NDArray:
    return np.maximum(1 - np.abs((places - first) / edge * 2 - 1), 0)


def _pooled(out: Any) -> Any:
    """The embedding, whether a version of transformers returns it alone or within an output."""
    return out if hasattr(out, "shape") else out.pooler_output


def _normalization(name: str, kind: str) -> tuple[Sequence[float], Sequence[float]]:
    file = Path(name) / "preprocessor_config.json"
    if file.is_file():
        try:
            values = parse_json(read_bytes(file))
            if "image_mean" in values and "image_std" in values:
                return values["image_mean"], values["image_std"]
        except ValueError as error:
            raise FileError(f"{file}: not JSON ({error})") from None
    return NORMALIZATION[kind]


def _import_torch():
    try:
        import torch  # pyright: ignore[reportMissingImports]  # optional
        import transformers  # pyright: ignore[reportMissingImports]  # optional
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"CLIP is run by transformers and torch: pip install 'taichi-unifusion[clip]' ({error})"
        ) from None
    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    return torch, transformers
