"""From words to embeddings: prompt templates, what a query is measured against, and the relevance
of a feature to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..networks.encoders import TextEncoder, unit_length
from .embeddings import TextEmbeddings

TEMPLATES = (
    "{}",
    "a {}",
    "a photo of a {}",
    "a photo of a {} in a room",
    "there is a {} in the scene",
)
# What a query must beat: general words, and what is in every room. Those too similar to the query
# are left out.
NEGATIVES = (
    "object",
    "thing",
    "stuff",
    "texture",
    "other",
    "wall",
    "floor",
    "ceiling",
    "door",
    "window",
    "table",
    "chair",
    "cabinet",
    "bed",
    "sofa",
    "lamp",
    "painting",
    "box",
    "bag",
    "book",
    "shelf",
    "curtain",
    "carpet",
    "plant",
    "person",
)
SYNONYM = 0.9  # cosine above which two texts mean the same and do not compete
LOGIT_SCALE = 100.0  # learned by CLIP: cosines times this are logits


def embed(
    encoder: TextEncoder, texts: Sequence[str], templates: Sequence[str] = TEMPLATES
) -> NDArray[np.float32]:
    """Embeddings (n, c) of texts, the mean over the templates; a file of embeddings is asked for
    the bare names.
    """
    if not texts or not all(text.strip() for text in texts):
        raise InputError("query: a text is empty")
    if isinstance(encoder, TextEmbeddings):
        return encoder.text_features(texts)
    for template in templates:
        if template.count("{}") != 1:
            raise InputError(f"template: '{template}' needs one {{}} where the name goes")
    prompts = [template.replace("{}", text.strip()) for text in texts for template in templates]
    vectors = unit_length(encoder.text_features(prompts)).reshape(len(texts), len(templates), -1)
    return unit_length(vectors.mean(axis=1))


def competitors(
    encoder: TextEncoder,
    queries: NDArray[np.float32],
    negatives: Sequence[str] = (),
    templates: Sequence[str] = TEMPLATES,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Embeddings (m, c) of what queries (n, c) have to beat, and which of them (n, m) compete with
    which query.

    Those of NEGATIVES, as far as a file of embeddings holds them, beside what all its names have in
    common; and of `negatives`. One that is nearly the query itself does not compete. Raises
    InputError where nothing is left.
    """
    if isinstance(encoder, TextEmbeddings):
        usual = np.vstack(
            [
                encoder.anything,
                *(encoder.text_features([name]) for name in NEGATIVES if encoder.has(name)),
            ]
        )
    else:
        usual = embed(encoder, NEGATIVES, templates)
    rivals = np.vstack([usual, embed(encoder, negatives, templates)]) if negatives else usual
    competes = queries @ rivals.T < SYNONYM
    if not competes.any(axis=1).all():
        raise InputError(
            "query: nothing is left to compare with; give negatives that mean something else"
        )
    return rivals, competes


def relevance(
    similarity: NDArray[np.float32], strongest: NDArray[np.float32], scale: float = LOGIT_SCALE
) -> NDArray[np.float32]:
    """Relevance (N,) in 0..1 of a query: its softmax against the strongest of its rivals, both as
    cosines; 0.5 is a draw.
    """
    return (1 / (1 + np.exp(np.clip(-scale * (similarity - strongest), -80, 80)))).astype(
        np.float32
    )
