"""JSON of files that anybody may have written."""

from __future__ import annotations

import json
from typing import Any


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds; whatever is wrong with it, deep nesting included, is a ValueError."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("lists or objects within each other, thousands deep") from None
