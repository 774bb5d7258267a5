"""What names and files hold cannot steer the terminal, nor can a poor one stop a command (C12)."""

from __future__ import annotations

import io
import logging
import sys

import pytest
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.terminal import PlainOutput, StderrHandler
from taichi_unifusion.errors import plain_text

EVIL = "\x1b]0;owned\x07\x1b[31mred"


def test_c12_control_characters_are_escaped_and_lines_stay():
    assert plain_text(f"a{EVIL}\x9bm\tb\nc\x7f") == (
        "a\\x1b]0;owned\\x07\\x1b[31mred\\x9bm\tb\nc\\x7f"
    )
    assert plain_text("Stühle, 椅子 🪑 — ok") == "Stühle, 椅子 🪑 — ok"


def test_c12_names_of_frames_are_shown_escaped(tmp_path, capsys):
    frames = make_frames(3)
    folder = write_folder(tmp_path / f"r{EVIL}", frames)
    (folder / "depth" / "1.png").rename(folder / "depth" / f"1{EVIL}\nunifusion: all is well.png")
    out = tmp_path / "out"
    cli.main(["reconstruct", "folder", str(folder), "--out", str(out), *FLAGS])
    cli.main(["info", str(out)])
    shown = capsys.readouterr()
    assert "\\x1b]0;owned\\x07" in shown.out + shown.err
    assert "\x1b" not in shown.out + shown.err and "\x07" not in shown.out + shown.err
    assert not any(line == "unifusion: all is well" for line in shown.err.splitlines())


def test_c12_warnings_are_one_line(capsys):
    record = logging.LogRecord(
        "taichi_unifusion", logging.WARNING, "", 1, "%s", (f"a\n{EVIL}",), None
    )
    StderrHandler().emit(record)
    assert capsys.readouterr().err == "unifusion: warning: a\\n\\x1b]0;owned\\x07\\x1b[31mred\n"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_c12_letters_that_a_terminal_lacks_are_escaped(encoding):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding)
    print("Stühle → \udcff", file=PlainOutput(stream))
    stream.flush()
    assert b"St" in raw.getvalue() and raw.getvalue().endswith(b"\\udcff\n")


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_closed_output_is_no_trouble(monkeypatch, closed):
    monkeypatch.setattr(sys, closed, None)
    assert cli.main(["config"]) == 0
    assert cli.main(["info", "nowhere"]) == 2
