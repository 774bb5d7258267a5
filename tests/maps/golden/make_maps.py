"""Maps of every kind from two synthetic frames, as hashes.

`python tests/maps/golden/make_maps.py > tests/maps/golden/maps.json` renews what `test_golden.py` compares
with: only where a change is meant to change maps, in the same commit, which says why.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import tempfile
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

import taichi_unifusion as uf
from taichi_unifusion.maps import FeatureMap, PropertyGroup
from taichi_unifusion.maps.encoding import EncoderSettings, position_encoding

FRAMES = (0, 2)  # of a loop of 60: most of what one sees, the other sees too
SIZE = {"width": 320, "height": 240}
SAMPLES = {"gpis": "samples", "sample_distance": 0.3, "support_closing": 14}


def clouds() -> list[uf.PointCloud]:
    """Two views with colour, a property of one channel and a small feature image."""
    frames = uf.open_dataset("synthetic", **SIZE)
    made = []
    for index in FRAMES:
        frame = frames[index]
        grey = frame.color.astype(np.float32).mean(axis=2) / 255
        rows = frame.color[::16, ::16].astype(np.float32) / 255
        features = np.concatenate([np.cos(k * rows) for k in range(1, 12)], axis=2)  # (15, 20, 33)
        frame = frame.with_image("grey", grey).with_features("features", features)
        made.append(uf.preprocess(frame).transformed(frame.T_world_camera))
    return made


def maps(seen: list[uf.PointCloud]) -> dict[str, object]:
    """Every kind of map after both clouds; `removed` after the second was taken out again."""
    made = {
        "surface": uf.SurfaceMap(**SAMPLES),
        "surface-derivatives": uf.SurfaceMap(gpis="derivatives", support_closing=14),
        "surface-points": uf.SurfaceMap(sampling="points", voxel_size=0.1, **SAMPLES),
        "color": uf.PropertyMap("color", 3),
        "color-information": uf.PropertyMap("color", 3, fusion="information", voxel_size=0.05),
        "color-points": uf.PropertyMap("color", 3, sampling="points", voxel_size=0.1),
        "color-published": uf.PropertyMap("color", 3, prior="zero", margin=2, voxel_size=0.1),
        "features": FeatureMap("features", 33),
        "removed": uf.SurfaceMap(**SAMPLES),
        "removed-information": uf.PropertyMap("color", 3, fusion="information", voxel_size=0.1),
    }
    for cloud in seen:
        for each in made.values():
            each.integrate(cloud)
    made["removed"].remove(seen[1])
    made["removed-information"].remove(seen[1])
    shared = [
        uf.PropertyMap(name, channels, voxel_size=0.05)
        for name, channels in (("color", 3), ("grey", 1))
    ]
    group = PropertyGroup(shared)
    for cloud in seen:
        group.integrate(cloud)
    return made | {f"group-{each.name}": each for each in shared}


def sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:32]


def summary(array: np.ndarray) -> list[float]:
    """Length, mean and root mean square: what must agree, within rounding, on every machine."""
    values = array.astype(np.float64)
    return [float(len(array)), float(values.mean()), float(np.sqrt((values**2).mean()))]


def machine(encoding: np.ndarray) -> str:
    """What the last bit of a sum depends on: the processor, whose kind LLVM makes code for and whose
    instructions it uses, Taichi's compiler, the linear algebra library.
    """
    said: dict[str, str] = {}
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            said.setdefault(name.strip(), value.strip())
    kind = "-".join(said.get(name, "") for name in ("vendor_id", "cpu family", "model"))
    vectors = sorted(
        set(said.get("flags", platform.processor()).split())
        & {"avx", "avx2", "fma", "fma4", "xop", "avx512f", "avx512vl"}
    )
    return f"taichi {version('taichi')}, {kind} {'+'.join(vectors)}, encoding {sha256(encoding)}"


def arrays() -> dict[str, np.ndarray]:
    """Every tensor of every map, the mesh of the surface, and the colour at its vertices."""
    found = {}
    made = maps(clouds())
    with tempfile.TemporaryDirectory() as folder:
        for kind, each in made.items():
            path = Path(folder) / f"{kind}.safetensors"
            each.save(path)
            found |= {f"{kind}.{name}": tensor for name, tensor in load_file(path).items()}
    mesh = made["surface"].extract_mesh(3)
    found |= {
        "mesh.vertices": mesh.vertices,
        "mesh.faces": mesh.faces,
        "mesh.normals": mesh.normals,
    }
    found["mesh.color"] = np.asarray(made["color"].query(mesh.vertices))
    return found


def position_projection() -> np.ndarray:
    """The position encoding's matrix, which linear algebra libraries give to within rounding."""
    return position_encoding(EncoderSettings()).projection.astype(np.float32)


def main() -> None:
    """Print the hashes and summaries of this version on this machine."""
    uf.init("cpu", threads=1)
    found = arrays()
    json.dump(
        {
            "machine": machine(position_projection()),
            "hashes": {name: sha256(array) for name, array in sorted(found.items())},
            "summaries": {name: summary(array) for name, array in sorted(found.items())},
        },
        sys.stdout,
        indent=1,
    )


if __name__ == "__main__":
    main()
