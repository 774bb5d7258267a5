"""CLIP and SigLIP through transformers: small random models, saved by the test and loaded as a
user's would be.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from taichi_unifusion import Frame, PinholeCamera
from taichi_unifusion.errors import FileError, FrameError, InputError
from taichi_unifusion.language import feature_image, make_image_encoder, make_text_encoder
from taichi_unifusion.language.prompts import embed
from taichi_unifusion.networks import clip
from taichi_unifusion.networks.tokenizer import _BYTE_LETTERS

torch = pytest.importorskip("torch", reason="needs torch: pip install torch transformers")
transformers = pytest.importorskip(
    "transformers", reason="needs transformers: pip install torch transformers"
)

UNIT = 1e-5
BATCHED = 1e-4  # sums in another order
PATCH = 8
TEXT = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "vocab_size": 600,
    "max_position_embeddings": 20,
    "bos_token_id": 1,
    "eos_token_id": 2,
    "pad_token_id": 2,
}
VISION = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 3,
    "num_attention_heads": 2,
    "image_size": 64,
    "patch_size": PATCH,
}


def save_tokenizer(folder) -> None:
    letters = [letter + end for letter in _BYTE_LETTERS.values() for end in ("", "</w>")]
    tokens = dict.fromkeys(["!", "<|startoftext|>", "<|endoftext|>", *letters, "so", "fa</w>"])
    (folder / "vocab.json").write_text(
        json.dumps({token: number for number, token in enumerate(tokens)})
    )
    (folder / "merges.txt").write_text("#version: 0.2\ns o\nf a</w>\n")
    transformers.CLIPTokenizer(
        str(folder / "vocab.json"), str(folder / "merges.txt")
    ).save_pretrained(folder)


@pytest.fixture(scope="module", params=["clip", "siglip"])
def folder(request, tmp_path_factory):
    """A model of random weights, with its tokenizer."""
    folder = tmp_path_factory.mktemp("models") / request.param
    torch.manual_seed(0)
    if request.param == "clip":
        model = transformers.CLIPModel(
            transformers.CLIPConfig(projection_dim=24, text_config=TEXT, vision_config=VISION)
        )
    else:
        model = transformers.SiglipModel(
            transformers.SiglipConfig(
                text_config={**TEXT, "projection_size": 32}, vision_config=VISION
            )
        )
    for parameter in model.parameters():  # as initialised, a layer hardly changes anything
        parameter.data += 0.1 * torch.randn_like(parameter)
    model.save_pretrained(folder)
    save_tokenizer(folder)
    return folder


def frame(color) -> Frame:
    height, width = color.shape[:2]
    return Frame(
        np.ones((height, width), np.float32),
        PinholeCamera(width, height, 50, 50, width / 2, height / 2),
        color=color,
    )


def picture(seed=0, height=48, width=64):
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)


def test_dense_features_have_the_shape_of_the_image(folder):
    encoder = make_image_encoder(f"clip:{folder}", short_side=96, device="cpu")
    found = feature_image(encoder, frame(picture()))
    texts = make_text_encoder(f"clip:{folder}", device="cpu").text_features(["a sofa", "b", "c"])
    assert found.shape == (12, 16, texts.shape[1]) and texts.shape[0] == 3
    assert (
        np.abs(np.linalg.norm(found, axis=2) - 1).max() < UNIT
        and np.abs(np.linalg.norm(texts, axis=1) - 1).max() < UNIT
    )


def test_dense_features_lie_at_their_pixels(folder):
    """What changes in one corner of the image changes the features there most."""
    encoder = make_image_encoder(f"clip:{folder}", short_side=96, device="cpu")
    color = np.full((48, 64, 3), 128, np.uint8)
    plain = encoder.image_features(frame(color))
    for row, column in ((5, 9), (1, 14)):
        changed = color.copy()
        # a patch is 4 x 4 pixels of the frame
        changed[4 * row : 4 * row + 4, 4 * column : 4 * column + 4] = (255, 0, 60)
        change = np.linalg.norm(encoder.image_features(frame(changed)) - plain, axis=2)
        assert np.unravel_index(change.argmax(), change.shape) == (row, column)


def test_crops_lie_at_their_pixels(folder):
    encoder = make_image_encoder(f"clip:{folder}", method="crops", device="cpu")
    color = np.full((48, 64, 3), 128, np.uint8)
    plain = encoder.image_features(frame(color))
    assert plain.shape[:2] == (24, 32)
    changed = color.copy()
    changed[34:44, 48:60] = (255, 0, 60)
    change = np.linalg.norm(encoder.image_features(frame(changed)) - plain, axis=2)
    row, column = np.unravel_index(change.argmax(), change.shape)
    assert abs(row - 19) <= 4 and abs(column - 27) <= 4


def test_a_batch_gives_what_each_gives_alone(folder):
    model = make_text_encoder(f"clip:{folder}", device="cpu")
    words = [f"word {chr(97 + i % 26)}{i}" for i in range(2 * clip.BATCH + 3)]
    some = [0, 17, 34]
    assert (
        np.abs(
            model.text_features(words)[some] - model.text_features([words[i] for i in some])
        ).max()
        < BATCHED
    )
    images = np.stack([model.prepared(picture(seed), (64, 48)) for seed in range(3)])
    assert (
        np.abs(model.dense_features(images)[1] - model.dense_features(images[1:2])[0]).max()
        < BATCHED
    )
    assert embed(model, ["sofa"]).shape == (1, model.text_features(["sofa"]).shape[1])


def test_half_precision_is_used_on_a_gpu_alone(folder):
    model = make_text_encoder(f"clip:{folder}")
    wanted = torch.float16 if torch.cuda.is_available() else torch.float32
    assert next(model.model.parameters()).dtype == wanted


def test_a_pooled_dense_network_knows_its_own_head(folder):
    """For one single patch, attending to itself alone is what attention does: dense and pooled
    agree for SigLIP's head.
    """
    model = make_text_encoder(f"clip:{folder}", device="cpu")
    if model.kind != "siglip":
        pytest.skip("CLIP pools at a token of its own")
    image = model.prepared(picture(), (PATCH, PATCH))[None]
    dense = model.dense_features(image)
    with torch.inference_mode():
        pooled = model.model.vision_model(
            torch.from_numpy(image), interpolate_pos_encoding=True
        ).pooler_output.numpy()
    assert dense.shape[:3] == (1, 1, 1) and np.abs(dense[0, 0, 0] - pooled[0]).max() < BATCHED


def test_what_is_no_model_is_said(tmp_path, folder):
    with pytest.raises(FileError, match="--download"):
        make_image_encoder("clip:nobody/no-such-model")
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises((InputError, FileError), match="bert|no CLIP"):
        make_image_encoder(f"clip:{tmp_path}")
    for options in ({"method": "blur"}, {"short_side": 3}, {"device": "tpu"}):
        with pytest.raises(InputError):
            make_image_encoder(f"clip:{folder}", **options)
    with pytest.raises(FrameError, match="no colour"):
        make_image_encoder(f"clip:{folder}", device="cpu").image_features(
            Frame(np.ones((4, 4), np.float32), PinholeCamera(4, 4, 4, 4, 2, 2))
        )
