"""Several scenes as one: side by side or over one another, with one scale for what they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .scene import UNKNOWN, Layer, Legend, Scene, SceneMesh

APART = 0.15  # of the width of a result: the gap to the next one beside it
SAME_UP = float(np.cos(np.radians(5)))  # of two that were found in the same world
SHARED = ", one scale for all"  # at the end of a legend's label


def beside(scenes: Sequence[Scene]) -> Scene:
    """Several scenes in one, from left to right, each upright: one whose world has another up than that
    of the first is turned. Boxes and labels go along with their meshes.
    """
    first = scenes[0]
    placed, place = [], 0.0
    right = _right_of(first)
    for scene in (first, *(_upright_as(first, each) for each in scenes[1:])):
        corners = np.array(np.meshgrid(*scene.bounds().T)).reshape(3, -1).T @ right
        low, high = float(corners.min()), float(corners.max())
        T = np.eye(4)
        T[:3, 3] = (place - low) * right if placed else 0
        place = (high if not placed else place + high - low) + APART * (high - low)
        placed.append(scene.placed(T))
    return overlaid(placed)


def _upright_as(first: Scene, other: Scene) -> Scene:
    """The other scene with its floor and its up where the first has them, if their worlds differ."""
    if float(first.up @ other.up) > SAME_UP:
        return other
    return other.placed(np.linalg.inv(first.T_up_world) @ other.T_up_world)


def overlaid(scenes: Sequence[Scene]) -> Scene:
    """Several scenes in one, each where it is, on shared scales; up is that of the first."""
    scenes = with_shared_scales(scenes)
    return Scene(
        ", ".join(scene.name for scene in scenes),
        tuple(mesh for scene in scenes for mesh in scene.meshes),
        tuple(camera for scene in scenes for camera in scene.cameras),
        tuple(box for scene in scenes for box in scene.boxes),
        tuple(label for scene in scenes for label in scene.labels),
        scenes[0].T_up_world,
    )


def _right_of(scene: Scene) -> NDArray[np.float64]:
    """(3,) unit, level: to the right of whoever looks by `overview`."""
    eye, center = scene.overview()
    right = np.cross(center - eye, scene.up)
    return right / np.linalg.norm(right)


def with_shared_scales(scenes: Sequence[Scene]) -> list[Scene]:
    """The scenes with their layers on shared scales, see `share_scales`."""
    meshes = iter(share_scales([mesh for scene in scenes for mesh in scene.meshes]))
    return [replace(scene, meshes=tuple(next(meshes) for _ in scene.meshes)) for scene in scenes]


def share_scales(meshes: Sequence[SceneMesh]) -> tuple[SceneMesh, ...]:
    """The meshes with one range of values, or one list of classes, for each layer that several have:
    the legend of one of them is that of all. A mesh that this changes nothing of is the same object.
    """
    layers: dict[str, list[Layer]] = {}
    for mesh in meshes:
        for layer in mesh.layers:
            layers.setdefault(layer.name, []).append(layer)
    shared = {name: _shared_legend(same) for name, same in layers.items()}
    return tuple(_on_legends(mesh, shared) for mesh in meshes)


def _on_legends(mesh: SceneMesh, legends: dict[str, Legend | None]) -> SceneMesh:
    changed = [
        _recolored(layer, legend)
        for layer in mesh.layers
        if (legend := legends[layer.name]) is not None and not _is_same(layer.legend, legend)
    ]
    return mesh.with_layers(changed) if changed else mesh


def _shared_legend(layers: Sequence[Layer]) -> Legend | None:
    """The legend of all layers of a name; None where they have the same one, or can have none: they
    are no values, or of different kinds.
    """
    legends = [layer.legend for layer in layers if layer.legend is not None]
    if len(legends) < len(layers) or any(layer.values is None for layer in layers):
        return None
    kinds = {
        (layer.values.shape[1], bool(legend.names), layer.shaded)  # type: ignore[union-attr]
        for layer, legend in zip(layers, legends, strict=True)
    }
    first = legends[0]
    if len(kinds) > 1 or layers[0].shaded or all(_is_same(first, each) for each in legends[1:]):
        return None
    label = first.label.removesuffix(SHARED) + SHARED
    if first.names:
        colors = {
            name: color
            for legend in reversed(legends)
            for name, color in zip(legend.names, legend.colors, strict=True)
        }
        names = tuple(dict.fromkeys(name for legend in legends for name in legend.names))
        return Legend(label, np.stack([colors[name] for name in names]), names=names)
    low, high = min(each.low for each in legends), max(each.high for each in legends)
    return Legend(label, first.colors, low, high)


def _is_same(one: Legend | None, other: Legend) -> bool:
    return (
        one is not None
        and (one.label, one.low, one.high, one.names)
        == (other.label, other.low, other.high, other.names)
        and np.array_equal(one.colors, other.colors)
    )


def _recolored(layer: Layer, legend: Legend) -> Layer:
    """The values of a layer in the colours of another legend."""
    assert layer.values is not None and layer.legend is not None
    values, known = layer.values, np.isfinite(layer.values).all(axis=1)
    if legend.names:
        places = np.array([legend.names.index(name) for name in layer.legend.names], np.float32)
        values = np.full_like(layer.values, np.nan)
        values[known] = places[layer.values[known].astype(int)]
    colors = np.tile(np.array(UNKNOWN, np.uint8), (len(values), 1))
    colors[known] = _colors_of(values[known], legend)
    return replace(layer, colors=colors, values=values, legend=legend)


def _colors_of(values: NDArray, legend: Legend) -> NDArray[np.uint8]:
    """The colours (N, 3) that a legend gives to values (N, c)."""
    if legend.names:
        return legend.colors[values[:, 0].astype(int)]
    share = np.clip((values - legend.low) / (legend.high - legend.low), 0, 1)
    if len(legend.colors):
        place = share[:, 0] * (len(legend.colors) - 1)
        rows = np.arange(len(legend.colors))
        share = np.stack([np.interp(place, rows, column / 255) for column in legend.colors.T], 1)
    return (255 * share + 0.5).astype(np.uint8)
