"""Settings in YAML: what surprises is refused, with the line, whoever reads them."""

from __future__ import annotations

from pathlib import Path

import pytest

from taichi_unifusion.config import load_config
from taichi_unifusion.datasets.camera_yaml import read_camera_yaml
from taichi_unifusion.errors import ConfigError, DatasetError, FileError, InputError
from taichi_unifusion.files.strict_yaml import MAX_BYTES, MAX_NESTING, read_yaml


@pytest.mark.parametrize(
    ("content", "values"),
    [
        (b"", None),
        (b"# nothing\n", None),
        (b"\xef\xbb\xbfa: 1\r\nb: [x, 2.5]\r\n", {"a": 1, "b": ["x", 2.5]}),
        ("a: 1".encode("utf-16"), {"a": 1}),
        (b"a:\n  b:\n    c: true\n", {"a": {"b": {"c": True}}}),
        (b"[" * MAX_NESTING + b"]" * MAX_NESTING, [[[[[[[[]]]]]]]]),
    ],
)
def test_plain_values(tmp_path, content, values):
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    assert read_yaml(path) == values


@pytest.mark.parametrize(
    ("read", "error"),
    [(read_yaml, InputError), (load_config, ConfigError), (read_camera_yaml, DatasetError)],
)
@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("x: 1\nfx: 2\nfx: 3\n", "line 3: not valid YAML .key 'fx' is given twice"),
        ("x: &a [1]\ny: *a\n", "line 2: not valid YAML .aliases are not allowed"),
        ("x: {<<: *b}\n", "line 1: not valid YAML .aliases"),
        ("\n" + "[" * 20_000, "line 2: not valid YAML .more than 8 nested values"),
        ("x: !!python/object/apply:os.getcwd []\n", "line 1: not valid YAML"),
        ("x: 2001-99-99\n", "not valid YAML .month must be"),
        ("x: \0\n", "not valid YAML .unreadable"),
        ("#" * (MAX_BYTES + 1), "is it another file?"),
    ],
)
def test_what_surprises_is_refused(tmp_path, read, error, content, told):
    path = tmp_path / "a.yaml"
    path.write_text(content)
    with pytest.raises(error, match=told) as raised:
        read(path)
    assert str(raised.value).startswith(str(path)) and len(str(raised.value)) < 500


def test_a_file_that_is_missing_is_said(tmp_path: Path):
    with pytest.raises(FileError, match="none.yaml: no such file"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(DatasetError, match="camera.yaml: no such file; it holds width, height"):
        read_camera_yaml(tmp_path / "camera.yaml")
