"""What README, CONTRIBUTING and docs/ name is there: files, links, imports, commands and their options."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest
from places import ROOT

import taichi_unifusion as uf
from taichi_unifusion.cli import main as cli

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BESIDE = (ROOT, ROOT / "taichi_unifusion", ROOT / "benchmarks")  # what a page's paths begin at


def python_blocks(page: Path) -> list[ast.Module]:
    return [ast.parse(text) for text in re.findall(r"```python\n(.*?)```", page.read_text(), re.S)]


def command_lines(page: Path) -> list[list[str]]:
    """Words of the lines that call `unifusion`, in blocks and in backticks; continued lines joined."""
    text = page.read_text().replace("\\\n", " ")
    lines = re.findall(r"^    (?:\$ )?(unifusion .*)$", text, re.M)
    lines += re.findall(r"`(unifusion [^`\n]+)`", text)
    calls = (shlex.split(re.sub(r"[\[\]]", "", line), comments=True)[1:] for line in lines)
    return [words for words in calls if words and not words[0].startswith("-")]


@pytest.fixture(scope="module")
def help_of():
    """Help of a command, read once."""
    read: dict[str, str] = {}

    def text(command: str, capsys) -> str:
        if command not in read:
            assert cli.main([*command.split(), "--help"]) == 0
            read[command] = capsys.readouterr().out
        return read[command]

    return text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_in_a_page_imports_what_is_there(page: Path) -> None:
    for block in python_blocks(page):
        for node in ast.walk(block):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(uf.__name__):
                module = importlib.import_module(node.module)
                missing = [a.name for a in node.names if not hasattr(module, a.name)]
                assert not missing, f"{node.module} has no {missing}"
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "uf":
                assert node.attr in uf.__all__, f"uf.{node.attr} is not public"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_names_only_modules_files_and_links_that_are_there(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"\btaichi_unifusion(?:\.\w+)+", text):
        module, _, attribute = name.rpartition(".")
        if not hasattr(importlib.import_module(module), attribute):
            importlib.import_module(name)
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (page.parent / target).exists(), f"link to {target}"
    named = set(re.findall(r"`(?:python )?((?:\w+/)+(?:[\w.]+\.(?:py|yaml|json))?)[` ]", text))
    named |= set(re.findall(r"\bpython ((?:benchmarks|tests|scripts|apps)/[\w/.]+)", text))
    ours = {path.name for folder in BESIDE for path in folder.iterdir() if path.is_dir()}
    gone = [
        name
        for name in sorted(named)
        if name.partition("/")[0] in ours and not any((b / name).exists() for b in BESIDE)
    ]
    assert not gone


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_a_page_and_their_options_exist(page: Path, help_of, capsys) -> None:
    for words in command_lines(page):
        command = " ".join(words[:2] if words[0] == "evaluate" else words[:1])
        known = help_of(command, capsys) + help_of("config", capsys)
        for option in (w.partition("=")[0] for w in words[1:] if w.startswith("--")):
            assert option in known, f"{command} has no {option}"
