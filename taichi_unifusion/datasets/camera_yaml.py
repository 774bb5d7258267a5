"""`camera.yaml` of a `folder` recording: the depth images' camera, their unit, and where the poses
are. Strict.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

import yaml

from ..errors import DatasetError
from ..files.images import INVALID_DEPTH
from ..types import PinholeCamera
from .intrinsics import make_camera

MAX_BYTES = 16_384  # a camera takes ten lines; more is another file
MAX_NESTING = 3  # a list among the keys has 2
# a number to people and YAML 1.2, text to YAML 1.1
EXPONENT = re.compile(r"[-+]?\d+(?:\.\d*)?[eE][-+]?\d+")
EXPECTED = {
    "int": "a whole number",
    "float": "a number",
    "str | None": "the name of a file or folder",
    "tuple[int, ...]": "a list of whole numbers",
}


@dataclass(frozen=True)
class CameraFile:
    """The keys of camera.yaml, their types and their defaults."""

    width: int  # [pixels] of the depth images
    height: int
    fx: float  # [pixels]
    fy: float
    cx: float
    cy: float
    depth_scale: float = 1000.0  # units a metre of integer depth images
    depth_invalid: tuple[int, ...] = INVALID_DEPTH  # units that mean no reading
    poses: str | None = None  # file or folder beside camera.yaml

    def camera(self, source: str) -> PinholeCamera:
        """The pinhole camera; an impossible one is a DatasetError naming its source."""
        return make_camera(source, (self.width, self.height), self.fx, self.fy, self.cx, self.cy)


def read_camera_yaml(path: Path) -> CameraFile:
    """Read and check the file; DatasetError names the key that is unknown, missing or of another
    type.
    """
    values = _load(path)
    known = {field.name: field for field in fields(CameraFile)}
    for key in values:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            raise DatasetError(
                f"{path}: unknown key '{str(key)[:40]}'{f', did you mean {near[0]}?' if near else ''} "
                f"(keys: {', '.join(known)})"
            )
    missing = [
        name for name, field in known.items() if field.default is MISSING and name not in values
    ]
    if missing:
        raise DatasetError(f"{path}: no {', '.join(missing)} in it")
    return CameraFile(
        **{key: _convert(values[key], known[key].type, f"{path}: {key}") for key in values}
    )


def _load(path: Path) -> dict:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DatasetError(f"{path}: larger than {MAX_BYTES} bytes, this is no camera file")
        text = path.read_text(encoding="utf-8-sig")
        _check_plain(text, path)
        values = yaml.safe_load(text)
    except FileNotFoundError:
        raise DatasetError(
            f"{path}: no such file; it holds width, height, fx, fy, cx, cy of the depth images, "
            "see docs/formats.md"
        ) from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error
    except DatasetError:
        raise
    except (
        yaml.YAMLError,
        ValueError,
    ) as error:  # ValueError: a date with month 99, an integer of thousands of digits
        mark = getattr(error, "problem_mark", None)
        raise DatasetError(
            f"{path}{f' line {mark.line + 1}' if mark else ''}: not valid YAML"
        ) from error
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: expected lines of the form 'fx: 525.0'")
    return values


def _check_plain(text: str, path: Path) -> None:
    """Refuse aliases and deep nesting: no camera needs them, and with them a small file can keep a
    parser busy for ever.
    """
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(
            event, yaml.CollectionEndEvent
        )
        if isinstance(event, yaml.AliasEvent) or depth > MAX_NESTING:
            raise DatasetError(
                f"{path} line {event.start_mark.line + 1}: YAML aliases and nested values are not allowed here"
            )


def _convert(value: object, wanted: str, where: str) -> object:
    """The value as the field's type; of anything nested only the type is named in messages."""
    if isinstance(value, str) and EXPONENT.fullmatch(value):
        value = float(value)
    number = isinstance(value, float) or (
        isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    )
    if wanted == "int" and number and float(value).is_integer():
        return int(value)
    if wanted == "float" and number:
        return float(value)
    if wanted == "str | None" and (value is None or isinstance(value, str)):
        return value
    if wanted == "tuple[int, ...]" and isinstance(value, list):
        return tuple(_convert(item, "int", f"{where}[{i}]") for i, item in enumerate(value))
    shown = (
        f"'{value[:40]}'" if isinstance(value, str) else value if number else type(value).__name__
    )
    raise DatasetError(f"{where}: expected {EXPECTED[wanted]}, got {shown}")
