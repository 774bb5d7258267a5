"""Scripts of one's own, as those in apps/: arguments and errors in a sentence, exit codes."""

from __future__ import annotations

import runpy
import sys

import pytest
from places import ROOT

from taichi_unifusion.cli.script import run_script
from taichi_unifusion.errors import InputError

APPS = sorted((ROOT / "apps").glob("*.py"))


def words(first: str, second: str = "", *more: str) -> None:
    if first == "wrong":
        raise InputError("it is wrong")
    if first == "stop":
        raise KeyboardInterrupt
    if first == "large":
        raise MemoryError
    if first == "bug":
        raise KeyError(first)


@pytest.mark.parametrize("app", APPS, ids=lambda app: app.stem)
@pytest.mark.parametrize("arguments", [(), tuple("abcdefgh"), ("--help",)])
def test_apps_say_how_they_are_called(app, arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [app.name, *arguments])
    if app.stem == "clip" and len(arguments) > 3:
        return  # takes any number of texts
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(app), run_name="__main__")
    out, err = capsys.readouterr()
    if arguments == ("--help",):
        assert ended.value.code == 0 and f"python apps/{app.name}" in out and not err
    else:
        assert ended.value.code == 2 and not out
        (line,) = err.splitlines()
        assert f"got {len(arguments)} argument" in line


@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        (["fine"], 0, ""),
        (["fine", "a", "b", "c"], 0, ""),
        (["wrong"], 2, "unifusion: error: it is wrong"),
        ([], 2, "expected FIRST [SECOND] [MORE ...], got 0 arguments"),
        (["stop"], 130, "stopped"),
        (["large"], 2, "memory has run out"),
    ],
)
def test_a_script_ends_with_a_sentence_and_a_code(given, code, said, capsys):
    assert run_script(words, given) == code
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == (code != 0)


def test_a_bug_of_a_script_keeps_its_traceback():
    with pytest.raises(KeyError):
        run_script(words, ["bug"])
