"""Map files of a hostile or buggy writer: sums are right, content is not; nothing is made of them."""

from __future__ import annotations

import copy
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from map_kinds import frames, integrated
from memory import peak_memory

from taichi_unifusion import PropertyMap, SurfaceMap, load_map
from taichi_unifusion.errors import InputError, MapCorrupt
from taichi_unifusion.files.maps import CONTAINER_KEYS, read_map, write_map
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.settings import FeatureSettings
from taichi_unifusion.maps.stored import read_description, read_stored
from taichi_unifusion.results import inspect

SMALL = {"encoder": EncoderSettings(rank=8, anchors=64), "noise": 0.3}
NAN, HUGE = float("nan"), 2**63


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """A sound file of every kind of map."""
    folder = tmp_path_factory.mktemp("maps")
    maps = {
        "surface": integrated(SurfaceMap(**SMALL), frames()[:1]),
        "uncarved": integrated(SurfaceMap(carve=False, **SMALL), frames()[:1]),
        "property": integrated(PropertyMap("rgb", 3, voxel_size=0.05, **SMALL), frames()[:1]),
        "latent": FeatureMap("clip", 16),
    }
    for name, each in maps.items():
        each.save(folder / f"{name}.safetensors")
    return {name: folder / f"{name}.safetensors" for name in maps}


def forged(source: Path, target: Path, change) -> Path:
    """A copy whose tensors and manifest `change` has gone over, sums and all made right again."""
    tensors, manifest = read_map(source)
    manifest = {k: v for k, v in copy.deepcopy(manifest).items() if k not in CONTAINER_KEYS}
    change(tensors, manifest)
    with pytest.MonkeyPatch.context() as patch:  # a liar writes NaN too
        patch.setattr("taichi_unifusion.files.maps.json.dumps", _dumps)
        write_map(target, tensors, manifest)
    return target


def _dumps(value, allow_nan=True):
    from json import JSONEncoder

    return JSONEncoder(allow_nan=True).encode(value)


def said(**values):
    """The manifest says these instead; names with __ lie within settings."""

    def change(tensors, manifest):
        for name, value in values.items():
            *within, key = name.split("__")
            place = manifest
            for part in within:
                place = place[part]
            place[key] = value

    return change


def held(**arrays):
    """The file holds these tensors instead or besides, each made of the number of voxels."""

    def change(tensors, manifest):
        tensors.update({name: make(len(tensors["keys"])) for name, make in arrays.items()})

    return change


def without(*names):
    def change(tensors, manifest):
        for name in names:
            tensors.pop(name, None) if name in tensors else manifest.pop(name)

    return change


def spoiled(name, place, value):
    def change(tensors, manifest):
        tensors[name][place] = value

    return change


ENCODER = "settings__encoder__"
LIES = [
    *(said(channels=c) for c in (10**6, 10**9, HUGE, 1e30, NAN, float("inf"), "3", 3.7, 0, -1, 4)),
    *(said(channels=c) for c in (True, None, [3], 3.0)),
    *(said(**{ENCODER + "anchors": a}) for a in (100_000, 10**7, HUGE, 2, -5, 64.0, "64", None)),
    *(said(**{ENCODER + "rank": r}) for r in (12.0, 200, 65, 0, -1, 12, "8", None, [8], HUGE)),
    *(said(**{ENCODER + "seed": s}) for s in (-1, 1.5, "0", HUGE, None, True)),
    *(said(**{ENCODER + "length_scale": x}) for x in (NAN, 1e-300, 0, -1, 1e300, "0.5", 101.0)),
    *(said(kind=k) for k in ([1], {}, None, 5, "", "Property", "surface", "latent")),
    *(said(name=n) for n in (5, [1], None, "", "a\x1b[31m", "x\0y", "long" * 200)),
    *(said(settings=s) for s in ("abc", [], None, 5, {"encoder": 5}, {"blend": "no"})),
    *(said(settings__blend=b) for b in ("no", [], 1, None)),
    *(said(settings__prior=p) for p in ("none", 5, None, "zero")),
    *(said(settings__voxel_size=v) for v in ("abc", True, 0, -1, 1e9, NAN, None)),
    *(said(settings__noise=v) for v in (0, -1, NAN, "1", 1e300)),
    *(said(settings__min_points=v) for v in (0, 1.5, HUGE, True)),
    *(said(settings__margin=v) for v in (0, 3, 1.0, True)),
    *(said(settings__sampling=v) for v in ("all", 5, [])),
    *(said(settings__fusion=v) for v in ("sum", "information", None)),
    *(said(voxels=v) for v in (0, -1, 1.0, HUGE, "5", None)),
    said(unknown=1),
    said(settings__unknown=1),
    said(**{ENCODER + "unknown": 1}),
    said(settings__carve=True),
    *(without(name) for name in ("kind", "name", "channels", "voxels", "settings")),
    *(without(name) for name in ("keys", "latents", "weights", "masks")),
    held(evidence=lambda n: np.full((n, 64), 100, np.int8)),
    held(sums=lambda n: np.zeros((n, 9), np.float32)),
    held(other=lambda n: np.zeros(3, np.float32)),
    held(keys=lambda n: np.array(5, np.int32)),
    held(keys=lambda n: np.zeros((n, 2), np.int32)),
    held(keys=lambda n: np.zeros((n, 3), np.int64)),
    held(keys=lambda n: np.zeros((n, 3), np.int32)),
    held(keys=lambda n: np.full((n, 3), 2**30, np.int32)),
    held(weights=lambda n: np.zeros(n, np.float32)),
    held(weights=lambda n: np.full(n, 0.5, np.float32)),
    held(weights=lambda n: np.ones(n + 1, np.float32)),
    held(weights=lambda n: np.ones((n, 1), np.float32)),
    held(masks=lambda n: np.zeros((n, 2), np.int32)),
    held(latents=lambda n: np.full((n, 9, 3), 3e38, np.float32)),
    held(latents=lambda n: np.zeros((n, 9, 2), np.float32)),
    held(latents=lambda n: np.zeros((n, 9, 3), np.float64)),
    spoiled("latents", (0, 0, 0), np.nan),
    spoiled("latents", (-1, -1, -1), np.inf),
    spoiled("weights", 0, -1.0),
    spoiled("weights", 0, np.nan),
    spoiled("keys", (0, 0), -(2**31)),
]
OTHER_KINDS = {
    "surface": [
        said(channels=3),
        said(name="other"),
        said(settings__support_closing=14.5),
        said(settings__gpis="all"),
        said(settings__carve=False),
        said(settings__min_evidence=NAN),
        without("evidence"),
    ],
    "uncarved": [
        held(evidence=lambda n: np.zeros((n, 64), np.int8)),
        said(settings__carve=True),
    ],
    "latent": [
        said(channels=10**9),
        said(settings__precision="int4"),
        said(settings__source=5),
        said(settings__sampling="points"),
        said(**{ENCODER + "rank": 1}),
    ],
}


def test_m4_lying_files_are_refused_in_little_memory(files, tmp_path):
    """C2, C3, C4 too: by the loader, by the description alone where that can know, and by info."""
    cases = [("property", lie) for lie in LIES]
    cases += [(kind, lie) for kind, lies in OTHER_KINDS.items() for lie in lies]
    assert len(cases) >= 111
    paths = [
        forged(files[kind], tmp_path / f"{n}.safetensors", lie)
        for n, (kind, lie) in enumerate(cases)
    ]
    wrong = []
    with peak_memory() as peak:
        for n, path in enumerate(paths):
            try:
                load_map(path)
                wrong.append(n)
            except MapCorrupt as error:
                assert str(path) in str(error) and len(str(error)) < 500
            if [type(problem) for problem in inspect(path).problems] != [MapCorrupt]:
                wrong.append(n)
    assert wrong == []
    assert peak.megabytes < 100


def test_c2_a_tensor_that_does_not_belong_is_named(files, tmp_path):
    path = forged(
        files["property"],
        tmp_path / "a",
        held(evidence=lambda n: np.full((n, 64), 100, np.int8)),
    )
    with pytest.raises(MapCorrupt, match="tensor 'evidence' does not belong"):
        read_description(path)


def test_c3_sizes_are_compared_before_anything_is_allocated(files, tmp_path):
    path = forged(files["property"], tmp_path / "a", said(channels=60))
    with pytest.raises(MapCorrupt, match=r"'latents' should be float32 \[\d+, 9, 60\], found"):
        load_map(path)


def test_c4_an_older_files_settings_have_todays_defaults_where_it_says_none(files, tmp_path):
    def forget(tensors, manifest):
        del manifest["settings"]["margin"]

    path = forged(files["property"], tmp_path / "a", forget)
    assert load_map(path).settings == load_map(files["property"]).settings


def test_m8_sound_files_are_described_as_they_are(files):
    for name, path in files.items():
        description, data = read_stored(path)
        assert description == read_description(path)
        loaded = load_map(path)
        assert (description.name, description.channels) == (loaded.name, loaded.channels)
        assert (description.settings, len(data)) == (loaded.settings, len(loaded))
        assert inspect(path).problems == () and (name == "latent") == (len(data) == 0)


def test_c3_maps_that_cannot_be_made_are_refused_at_the_door():
    for make, word in (
        (lambda: PropertyMap("a", 65), "channels must lie in 1..64.*FeatureMap"),
        (lambda: FeatureMap("a", 10**6), "channels must lie in 1..8192"),
        (lambda: PropertyMap("", 3), "name"),
        (lambda: PropertyMap(5, 3), "name"),
        (lambda: PropertyMap("a\n", 3), "name"),
    ):
        with pytest.raises(InputError, match=word):
            make()


def test_r1_rows_of_a_thousand_numbers_begin_with_little_memory():
    """Room for thousands of voxels at once would take gigabytes."""
    encoder = EncoderSettings(rank=20)
    with peak_memory() as peak:
        wide = FeatureMap("wide", 8192, FeatureSettings(precision="float32", encoder=encoder))
    assert wide.grid.capacity * wide.grid["slopes"].shape[1] * 4 <= 64 << 20
    assert peak.megabytes < 250


def test_M10_numbers_that_are_not_finite_are_found_when_a_map_is_loaded(files, tmp_path):
    for value in (np.nan, np.inf, 3e38):
        path = forged(files["property"], tmp_path / "a", spoiled("latents", (2, 1, 0), value))
        with pytest.raises(MapCorrupt, match="tensor 'latents' that are not finite, or too large"):
            load_map(path)


@pytest.mark.parametrize("kind", ["surface", "property"])
def test_M10_a_repaired_map_lacks_the_damaged_voxels_alone(kind, files, tmp_path, caplog):
    sound = load_map(files[kind]).voxels()

    def spoil(tensors, manifest):
        tensors["weights"][1] = -np.inf
        tensors["keys"][3, 0] = 2**30
        tensors["latents"][2, 1, 0] = np.nan

    path = forged(files[kind], tmp_path / "a", spoil)
    with pytest.raises(MapCorrupt, match="--repair"):
        load_map(path)
    found = load_map(path, repair=True)
    assert f"3 of {len(sound)} voxels are damaged and left out" in caplog.text
    left = np.setdiff1d(np.arange(len(sound)), [1, 2, 3])
    assert (found.voxels().keys == sound.keys[left]).all()
    for name, values in found.voxels().tensors.items():
        assert (values == sound.tensors[name][left]).all(), name
    found.save(tmp_path / "again")
    assert len(load_map(tmp_path / "again")) == len(left)


def test_M9_a_surface_of_before_sides_were_kept_apart(tmp_path):
    """Its settings say nothing of sides, and it has none."""
    path = tmp_path / "old.safetensors"
    written = integrated(SurfaceMap(two_sides=False, **SMALL), frames()[:1])
    manifest = {**written.manifest(), "voxels": len(written)}
    manifest["settings"] = {
        name: value for name, value in manifest["settings"].items() if name != "two_sides"
    }
    write_map(path, written.voxels().tensors, manifest)
    read = load_map(path)
    assert read.settings == written.settings and read.settings.two_sides is False
    np.testing.assert_array_equal(read.voxels().latents, written.voxels().latents)


def test_M9_a_file_of_version_1_is_read_for_ever(tmp_path):
    """Written byte by byte as version 1 has it, not by today's writer: do not renew it."""
    keys = np.array([[0, 0, 0], [0, 0, 1]], "<i4")
    arrays = {
        "keys": ("I32", "int32", keys),
        "latents": ("F32", "float32", np.full((2, 3, 1), 0.25, "<f4")),
        "weights": ("F32", "float32", np.array([4, 2], "<f4")),
        "masks": ("U32", "uint32", np.full((2, 2), 7, "<u4")),
    }
    header, entries, body = {}, {}, b""
    for name, (code, kind, array) in arrays.items():
        data = array.tobytes()
        place = [len(body), len(body) + len(data)]
        header[name] = {"dtype": code, "shape": list(array.shape), "data_offsets": place}
        digest = hashlib.sha256(data).hexdigest()
        entries[name] = {"shape": list(array.shape), "dtype": kind, "sha256": digest}
        body += data
    encoder = {"rank": 2, "anchors": 64, "length_scale": 0.4753, "seed": 0}
    settings = {"voxel_size": 0.1, "noise": 0.1, "min_points": 1, "sampling": "cells", "margin": 1}
    settings |= {"fusion": "mean", "prior": "mean", "blend": True, "encoder": encoder}
    manifest = {"kind": "property", "name": "heat", "channels": 1, "voxels": 2}
    manifest |= {"settings": settings, "format": "taichi_unifusion LIM", "format_version": 1}
    text = json.dumps({**manifest, "tensors": entries})
    metadata = {
        "taichi_unifusion": text,
        "taichi_unifusion_sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    head = json.dumps({"__metadata__": metadata, **header}).encode()
    path = tmp_path / "old.safetensors"
    path.write_bytes(len(head).to_bytes(8, "little") + head + body)
    old = load_map(path)
    assert (old.name, old.channels, old.voxel_size, len(old)) == ("heat", 1, 0.1, 2)
    data = old.voxels()
    assert np.array_equal(data.keys, keys) and (data.latents == 0.25).all()
    assert data.weights.tolist() == [4, 2] and (data.masks == 7).all()
    value = old.query(np.float32([[0.05, 0.05, 0.05]]))
    assert np.isfinite(value).all() and value[0, 0] != 0
