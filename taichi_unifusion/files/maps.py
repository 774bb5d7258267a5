"""Map files: named arrays and a manifest in one .safetensors file, with checksums, read without
trust.

Layout (any safetensors library opens it): 8 bytes little-endian header length, a JSON header that
gives every tensor's type, shape and place, then the tensors' bytes without gaps. The header's
`__metadata__` holds our manifest, as JSON text, and the SHA-256 of that text; the manifest holds
the SHA-256 of every tensor. So a changed bit is found anywhere in the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MapCorrupt, UniFusionError
from .atomic import atomic_write, check_name, file_error

FORMAT = "taichi_unifusion LIM"
FORMAT_VERSION = 1
CONTAINER_KEYS = ("format", "format_version", "tensors")  # of the manifest
MAX_HEADER = 64 << 20  # [bytes]; ours have a few thousand
TENSOR_KEYS = {"dtype", "shape", "data_offsets"}  # of the header
MAX_DIMENSIONS = 8
# of one tensor, counting empty dimensions as 1, so that no product of sizes overflows
MAX_ELEMENTS = 1 << 48

# tensor -> type and shape, in the order of their bytes
Layout = dict[str, tuple[np.dtype, tuple[int, ...]]]

# keys of the header's __metadata__
_MANIFEST, _CHECKSUM = "taichi_unifusion", "taichi_unifusion_sha256"
_DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "U64": "<u8",
    "U32": "<u4",
    "U8": "|u1",
    "I8": "|i1",
}
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_FOREIGN = {  # how other files begin, for the message
    b"\x80": "a pickle, which can run code when it is read",
    b"PK\x03\x04": "a zip archive (.npz or .pt), which may hold a pickle",
    b"\x93NUMPY": "a NumPy .npy file, which may hold a pickle",
    b"\x89HDF": "an HDF5 file",
    b"ply": "a PLY mesh",
}


def write_map(
    path: str | os.PathLike[str], tensors: dict[str, NDArray], manifest: dict[str, Any]
) -> None:
    """Write arrays and a manifest of JSON values atomically.

    The container sets the manifest's keys `format`, `format_version` and `tensors` (shape, dtype,
    sha256 of each) itself. Raises InputError for types that a map file cannot hold, FileError where
    the file cannot be written.
    """
    arrays = {name: _storable(name, array) for name, array in tensors.items()}
    # large items first, so that every tensor is aligned
    arrays = dict(sorted(arrays.items(), key=lambda item: (-item[1].itemsize, item[0])))
    entries, header, offset = {}, {}, 0
    for name, array in arrays.items():
        code, shape = _CODES[array.dtype.str], list(array.shape)
        entries[name] = {
            "shape": shape,
            "dtype": array.dtype.name,
            "sha256": hashlib.sha256(_bytes_of(array)).hexdigest(),
        }
        header[name] = {
            "dtype": code,
            "shape": shape,
            "data_offsets": [offset, offset + array.nbytes],
        }
        offset += array.nbytes
    try:
        text = json.dumps(
            {**manifest, "format": FORMAT, "format_version": FORMAT_VERSION, "tensors": entries},
            allow_nan=False,
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: the manifest must hold finite numbers, text, lists and dicts only ({error})"
        ) from None
    metadata = {_MANIFEST: text, _CHECKSUM: hashlib.sha256(text.encode()).hexdigest()}
    head = json.dumps({"__metadata__": metadata, **header}).encode()
    head += b" " * (-len(head) % 8)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(len(head).to_bytes(8, "little") + head)
        for array in arrays.values():
            file.write(_bytes_of(array))


def read_map(
    path: str | os.PathLike[str], check: Callable[[dict[str, Any]], object] | None = None
) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """All arrays and the manifest (with the container's own keys, see `write_map`), each checked
    against its sum; `check` is given the manifest before a tensor is read, and may raise.

    Raises FileError where the file is missing or cannot be read, MapCorrupt where it is truncated,
    altered, of another version or not ours; nothing is allocated that the file's size does not
    cover.
    """
    with _open(path) as file:
        layout, manifest = _read_header(file, path)
        if check is not None:
            check(manifest)
        tensors = {}
        for name, (dtype, shape) in layout.items():
            array = np.empty(shape, dtype)
            buffer = _bytes_of(array)
            if file.readinto(buffer) != array.nbytes:
                raise MapCorrupt(f"{path}: the file ends within tensor '{name}'")
            if hashlib.sha256(buffer).hexdigest() != manifest["tensors"][name]["sha256"]:
                raise MapCorrupt(
                    f"{path}: tensor '{name}' does not match its checksum; the file was altered or damaged"
                )
            tensors[name] = array
    return tensors, manifest


def read_manifest(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The manifest alone, checked against its sum and the file's size; no tensor is read. Errors as
    in `read_map`.
    """
    with _open(path) as file:
        return _read_header(file, path)[1]


def is_foreign(path: str | os.PathLike[str]) -> bool:
    """Whether this is a sound safetensors file that somebody else wrote, as the weights of a network; a
    map that is damaged is not.
    """
    try:
        with _open(path) as file:
            size = os.fstat(file.fileno()).st_size
            length = int.from_bytes(file.read(8), "little")
            header = _parse_json(file.read(length)) if length <= min(size - 8, MAX_HEADER) else {}
    except (FileError, ValueError):
        return False
    metadata = header.pop("__metadata__", {})
    # ours have both keys: one changed bit leaves the other
    ours = not isinstance(metadata, dict) or {_MANIFEST, _CHECKSUM} & set(metadata)
    tensors = [isinstance(each, dict) and set(each) >= TENSOR_KEYS for each in header.values()]
    return bool(tensors) and all(tensors) and not ours


def _storable(name: str, array: NDArray) -> NDArray:
    """The array in memory order and little-endian, or InputError."""
    if not isinstance(name, str) or name == "__metadata__":
        raise InputError(f"map file: a tensor cannot be named {name!r}")
    little = np.asarray(array, order="C")
    little = little.astype(little.dtype.newbyteorder("<"), copy=False)
    if little.dtype.str not in _CODES or little.ndim > MAX_DIMENSIONS:
        raise InputError(
            f"map file: tensor '{name}' is {little.dtype} of {little.ndim} dimensions; a map file holds "
            f"up to {MAX_DIMENSIONS} dimensions of {', '.join(np.dtype(d).name for d in _CODES)}"
        )
    return little


def _bytes_of(array: NDArray[Any]) -> memoryview:
    """The memory of a contiguous array as bytes, not copied."""
    return array.reshape(-1).view(np.uint8).data


@contextmanager
def _open(path: str | os.PathLike[str]) -> Iterator[BufferedReader]:
    """The open file; what the system says while it is read becomes a FileError."""
    check_name(path)
    if Path(path).exists() and not Path(path).is_file():
        raise FileError(f"{path}: is not a regular file, so not a map file")
    try:
        with open(path, "rb") as file:
            yield file
    except FileNotFoundError:
        raise FileError(f"{path}: no such map file") from None
    except UniFusionError:
        raise
    except OSError as error:
        raise file_error("read", path, error) from error


def _read_header(
    file: BufferedReader, path: str | os.PathLike[str]
) -> tuple[Layout, dict[str, Any]]:
    """Type and shape of every tensor in the order of their bytes, and the manifest, all found
    consistent.
    """
    size = os.fstat(file.fileno()).st_size
    start = file.read(8)
    length = int.from_bytes(start, "little")
    if len(start) < 8 or length > min(size - 8, MAX_HEADER):
        raise MapCorrupt(f"{path}: {_what_it_is(file)}")
    try:
        header = _parse_json(file.read(length))
    except ValueError:  # not UTF-8, not JSON, a name twice, nested too deep
        raise MapCorrupt(f"{path}: {_what_it_is(file)}") from None
    metadata = header.pop("__metadata__", None)
    if not isinstance(metadata, dict) or not isinstance(metadata.get(_MANIFEST), str):
        raise MapCorrupt(
            f"{path}: a safetensors file, but not a map of taichi_unifusion (no manifest in it), or a damaged one"
        )
    manifest = _check_manifest(metadata, path)
    tensors = _check_layout(header, size - 8 - length, path)
    recorded = {
        name: (entry["dtype"], tuple(entry["shape"])) for name, entry in manifest["tensors"].items()
    }
    if recorded != {name: (dtype.name, shape) for name, (dtype, shape) in tensors.items()}:
        raise MapCorrupt(
            f"{path}: the manifest and the header disagree about the tensors; the file was altered or damaged"
        )
    return tensors, manifest


def _check_manifest(metadata: dict[str, Any], path: str | os.PathLike[str]) -> dict[str, Any]:
    """The parsed manifest: its sum, format and version are right and it describes tensors."""
    text = metadata[_MANIFEST]
    if (
        hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest() != metadata.get(_CHECKSUM)
        or len(metadata) != 2
    ):
        raise MapCorrupt(
            f"{path}: the manifest does not match its checksum; the file was altered or damaged"
        )
    try:
        manifest = _parse_json(text)
    except ValueError:
        raise MapCorrupt(f"{path}: the manifest is not JSON") from None
    if manifest.get("format") != FORMAT:
        raise MapCorrupt(
            f"{path}: a file of format {manifest.get('format')!r}; expected '{FORMAT}'"
        )
    version = manifest.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        newer = type(version) is int and version > FORMAT_VERSION
        raise MapCorrupt(
            f"{path}: a map file of version {version}, this program reads version {FORMAT_VERSION}; "
            + ("update taichi_unifusion" if newer else "build the map again")
        )
    entries = manifest.get("tensors")
    if not isinstance(entries, dict) or not all(
        isinstance(e, dict)
        and isinstance(e.get("shape"), list)
        and isinstance(e.get("dtype"), str)
        and isinstance(e.get("sha256"), str)
        for e in entries.values()
    ):
        raise MapCorrupt(
            f"{path}: the manifest does not describe its tensors by shape, dtype and sha256"
        )
    return manifest


def _check_layout(header: dict[str, Any], available: int, path: str | os.PathLike[str]) -> Layout:
    """Type and shape of every tensor: sizes agree with places, which cover the `available` bytes
    without gap or overlap.
    """
    placed = []
    for name, entry in header.items():
        match entry:
            case {"dtype": str(code), "shape": list(shape), "data_offsets": [begin, end]} if (
                len(entry) == 3
                and code in _DTYPES
                and len(shape) <= MAX_DIMENSIONS
                and all(type(n) is int and 0 <= n < MAX_ELEMENTS for n in (*shape, begin, end))
                and math.prod(max(n, 1) for n in shape) < MAX_ELEMENTS
            ):
                pass
            case _:
                raise MapCorrupt(
                    f"{path}: tensor '{name}' has an impossible type, shape or place: {str(entry)[:160]}"
                )
        dtype = np.dtype(_DTYPES[code])
        if math.prod(shape) * dtype.itemsize != end - begin:
            raise MapCorrupt(
                f"{path}: tensor '{name}' says shape {shape} of {dtype} but occupies {end - begin} bytes"
            )
        placed.append((begin, end, name, dtype, tuple(shape)))
    placed.sort(key=lambda item: item[:3])
    position = 0
    for begin, end, name, _, _ in placed:
        if begin != position:
            raise MapCorrupt(
                f"{path}: tensor '{name}' begins at byte {begin}, not at {position} where the one before it ends"
            )
        position = end
    if position != available:
        raise MapCorrupt(
            f"{path}: the file holds {available} bytes of tensors but its header announces {position}; "
            f"it is {'truncated' if position > available else 'damaged'}"
        )
    return {name: (dtype, shape) for _, _, name, dtype, shape in placed}


def _parse_json(text: str | bytes) -> dict[str, Any]:
    """A JSON object without repeated names; raises ValueError for anything else."""
    try:
        value = json.loads(
            text.decode("utf-8") if isinstance(text, bytes) else text, object_pairs_hook=_unique
        )
    except RecursionError:
        raise ValueError("nested too deep") from None
    if not isinstance(value, dict):
        raise ValueError("not an object")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a name is given twice")
    return dict(pairs)


def _what_it_is(file: BufferedReader) -> str:
    """Why this is no map file, in words."""
    file.seek(0)
    start = file.read(8)
    if not start:
        return "the file is empty"
    for magic, kind in _FOREIGN.items():
        if start.startswith(magic):
            return f"not a map file of taichi_unifusion: it begins like {kind}; it was not read"
    return "not a map file of taichi_unifusion, or a truncated or damaged one: its header makes no sense"
