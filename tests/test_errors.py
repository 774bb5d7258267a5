"""The checks of a caller's words: choices, suggestions, and text or YAML as values."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from taichi_unifusion.errors import InputError, check_choice, convert, did_you_mean


@pytest.mark.parametrize(
    ("value", "wanted", "converted"),
    [
        ("0.5", float, 0.5),
        ("1e-3", float, 0.001),
        (2, float, 2.0),
        ("7", int, 7),
        ("1e3", int, 1000),
        (640.0, int, 640),
        ("true", bool, True),
        ("False", bool, False),
        (False, bool, False),
        ("a b", str, "a b"),
        ("~/x", Path, Path("~/x").expanduser()),
        ("color", Literal["depth", "color"], "color"),
        ("3", int | None, 3),
        (None, float | None, None),
        ("320x240", tuple[int, int], (320, 240)),
        ("0.5/0.25/1", tuple[float, float, float], (0.5, 0.25, 1.0)),
        ([0, "65535"], tuple[int, ...], (0, 65535)),
        (["ply", "obj"], tuple[Literal["ply", "obj"], ...], ("ply", "obj")),
    ],
)
def test_what_converts(value, wanted, converted):
    result = convert(value, wanted, "x")
    assert result == converted
    assert type(result) is type(converted)


@pytest.mark.parametrize(
    ("value", "wanted", "told"),
    [
        ("much", float, "x: expected a number, got 'much'"),
        ("nan", float, "x: expected a number, got 'nan'"),
        (float("inf"), float, "x: expected a number, got inf"),
        (True, float, "x: expected a number, got True"),
        ("0.5", int, "x: expected a whole number, got '0.5'"),
        (2**63, int, "x: expected a whole number"),
        # more digits than Python prints
        pytest.param(16**5000, int, "x: expected a whole number, got int", id="5000 digits"),
        pytest.param("9" * 5000, int, "x: expected a whole number", id="digits as text"),
        (1, bool, "x: expected true or false, got 1"),
        (5, str, "x: expected text, got 5"),
        ("", Path, "x: expected a file's name, got ''"),
        (None, float, "x: expected a number, got None"),
        ("colour", Literal["depth", "color"], "x: 'colour' is unknown .did you mean 'color'"),
        ("64", tuple[int, int], "x: expected WIDTHxHEIGHT, got '64'"),
        ("1/a", tuple[float, ...], "x: expected numbers with / between them, got '1/a'"),
        ("ply", tuple[Literal["ply"], ...], "x: expected a list, got 'ply'"),
        ([0, "a"], tuple[int, ...], r"x\[1\]: expected a whole number, got 'a'"),
        ([[1] * 50] * 50, float, "x: expected a number"),
    ],
)
def test_what_does_not_convert_is_said(value, wanted, told):
    with pytest.raises(InputError, match=told) as raised:
        convert(value, wanted, "x")
    assert len(str(raised.value)) < 200


def test_suggestions():
    known = ("surface", "color", "depth")
    assert did_you_mean("Surfce", known) == " (did you mean 'surface'?)"
    assert did_you_mean("xyz", known) == ""
    assert did_you_mean("colr", (*known, "colors"), at_most=2).endswith("'color' or 'colors'?)")
    check_choice("map", "color", known)
    with pytest.raises(InputError, match="map: 'x' is unknown, choose one of surface, color, dep"):
        check_choice("map", "x", known)
    with pytest.raises(InputError, match="did you mean 'depth'\\?\\); choose one of surface"):
        check_choice("map", "dept", known)
