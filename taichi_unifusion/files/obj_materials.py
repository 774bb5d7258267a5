"""The materials of an OBJ file, with every texture found or said to be missing.

Readers of OBJ know a texture as "map_Kd NAME"; files also hold options before the name, another
system's separators, paths of another computer, or names of pictures that were left behind.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .atomic import read_bytes

# options of a texture -> how many words follow; pairs: at least, at most, as far as they are numbers
OPTIONS = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-bm": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-mm": 2,
    "-texres": 1,
    "-type": 1,
}
MOVES = ("-o", "-s", "-t")  # of texture coordinates, up to three numbers each
KEY = "map_Kd "  # how a texture is written here
NOTHING = {"-o": 0.0, "-s": 1.0, "-t": 0.0}  # the number that changes nothing


@dataclass(frozen=True)
class ObjMaterials:
    """The text of an OBJ's material files, as one, and sentences on what is missing."""

    text: str  # textures by their full path, without options
    textures: frozenset[str]  # these paths
    warnings: tuple[str, ...]


def read_obj_materials(path: Path) -> ObjMaterials:
    """All materials that the OBJ file at `path` names; FileError where the OBJ itself cannot be
    read.
    """
    warnings: list[str] = []
    lines: list[str] = []
    for file in _material_files(path):
        found = _find(path.parent, file)
        if found is None:
            warnings.append(f"{path}: its material file {file} is not there; surfaces are plain")
            continue
        for line in _text(found).splitlines():
            lines.append(_checked(line, found, warnings))
    textures = {line.removeprefix(KEY) for line in lines if line.startswith(KEY)}
    return ObjMaterials("\n".join(lines), frozenset(textures), tuple(dict.fromkeys(warnings)))


def _material_files(path: Path) -> list[str]:
    """The names after mtllib, of which one line may hold several."""
    names: list[str] = []
    for line in _text(path).splitlines():
        key, _, rest = line.strip().partition(" ")
        if key != "mtllib" or not rest.strip():
            continue
        whole = _unquoted(rest.strip())
        one = _find(path.parent, whole) is not None or " " not in whole
        names += [whole] if one else re.findall(r"\S.*?\.mtl\b", whole, re.IGNORECASE) or [whole]
    return list(dict.fromkeys(names))


def _checked(line: str, file: Path, warnings: list[str]) -> str:
    """A line of a material file, with the name of its texture as it lies there."""
    words = line.split()
    if len(words) < 2 or words[0].lower() != "map_kd":
        return line
    name, moved = _name_of_texture(line.strip()[len(words[0]) :].strip())
    found = _find(file.parent, name)
    if found is None:
        warnings.append(f"{file}: its texture {name} is not there; what it covers is plain")
        return ""
    if reason := _undecodable(found):
        warnings.append(f"{file}: its texture {found} cannot be read ({reason})")
        return ""
    if moved:
        warnings.append(f"{file}: '{' '.join(moved)}' of texture {name} is left out")
    return f"{KEY}{found.resolve()}"


def _name_of_texture(text: str) -> tuple[str, list[str]]:
    """The name after the options, blanks in it kept, and the options that move a texture."""
    moved: list[str] = []
    while (words := text.split(maxsplit=1))[0].lower() in (*OPTIONS, *MOVES) and len(words) > 1:
        option, text = words[0].lower(), words[1]
        taken: list[str] = []
        while len(taken) < OPTIONS.get(option, 3):
            first, *rest = text.split(maxsplit=1)
            if not rest or (option in MOVES and not _is_number(first)):
                break
            taken.append(first)
            text = rest[0]
        if option in MOVES and any(float(number) != NOTHING[option] for number in taken):
            moved += [option, *taken]
    return _unquoted(text), moved


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _unquoted(name: str) -> str:
    quoted = len(name) > 1 and name[0] == name[-1] and name[0] in "\"'"
    return name[1:-1] if quoted else name


def _find(folder: Path, name: str) -> Path | None:
    """The file of that name: as written, with this system's separators, or beside the file that
    names it, whatever the case of its letters.
    """
    forward = name.replace("\\", "/")
    for candidate in (name, forward, os.path.basename(forward)):
        if candidate and os.path.isfile(folder / candidate):
            return folder / candidate
    wanted = os.path.basename(forward).lower()
    beside = folder / os.path.dirname(forward)
    for place in (beside, folder):
        names: Sequence[str] = os.listdir(place) if os.path.isdir(place) else ()
        for other in sorted(names):
            if other.lower() == wanted:
                return place / other
    return None


def _undecodable(path: Path) -> str:
    """Why a picture cannot be read; empty if it can."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            image.load()
    except Exception as error:  # noqa: BLE001 - its decoders raise whatever they stumble over
        return str(error)[:120] or type(error).__name__
    return ""


def _text(path: Path) -> str:
    return read_bytes(path).decode("utf-8", "replace").replace("\t", " ")
