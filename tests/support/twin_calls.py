"""A pytest plugin: in a whole run, every kernel must have been launched by a test that also called
its slow twin, the function of the same name in one of the `reference*.py` beside this file.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import FunctionType

import pytest

FOLDER = Path(__file__).parent
PACKAGE = FOLDER.parents[1] / "taichi_unifusion"
# Bookkeeping without a twin: tests in kernels/test_index.py, kernels/test_binning.py and
# maps/test_meshing.py compare it with a dict, a set or a sum.
BOOKKEEPING = {
    "assign_slots",
    "claim_slots",
    "find_slots",
    "release_slots",
    "remove_slots",
    "clear_index",
    "count_leaves",
    "copy_rows",
    "forget_blocks",
    "gather_rows",
    "scatter_rows",
}

_called: set[str] = set()  # in the test that runs now: "kernel NAME", "twin NAME"


def kernel_names() -> set[str]:
    """Every kernel of the package."""
    names = set()
    for file in PACKAGE.rglob("kernels/*.py"):
        lines = file.read_text().splitlines()
        for decorator, definition in zip(lines, lines[1:], strict=False):
            if decorator == "@ti.kernel":
                names.add(definition.removeprefix("def ").partition("(")[0])
    return names


def record_twins() -> None:
    """Wrap the twins, before any test has imported them."""
    for file in sorted(FOLDER.glob("reference*.py")):
        module = import_module(file.stem)
        for name, function in vars(module).copy().items():
            if isinstance(function, FunctionType) and function.__module__ == module.__name__:
                setattr(module, name, _recording(f"twin {name}", function))


def _recording(entry: str, function: FunctionType):
    @functools.wraps(function)
    def recorded(*args, **kwargs):
        _called.add(entry)
        return function(*args, **kwargs)

    return recorded


def record_kernels() -> None:
    """Note every launch; a kernel of Taichi is an object that holds the function it was made of."""
    from taichi.lang import kernel_impl

    launch = kernel_impl.Kernel.__call__

    @functools.wraps(launch)
    def recorded(self, *args, **kwargs):
        _called.add(f"kernel {self.func.__name__}")
        return launch(self, *args, **kwargs)

    kernel_impl.Kernel.__call__ = recorded


def twin_names() -> set[str]:
    """Every function of the `reference*.py` beside this file."""
    return {
        line.removeprefix("def ").partition("(")[0]
        for file in FOLDER.glob("reference*.py")
        for line in file.read_text().splitlines()
        if line.startswith("def ")
    }


class TwinCalls:
    """Collects over all tests, also those of other processes, which kernels met their twins."""

    def __init__(self) -> None:
        self.met: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        _called.clear()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item):
        report = yield
        kernels = {entry.removeprefix("kernel ") for entry in _called if entry[:7] == "kernel "}
        met = {name for name in kernels if f"twin {name}" in _called}
        report.user_properties.append(("kernels met by their twins", sorted(met)))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        for name, value in report.user_properties:
            if name == "kernels met by their twins":
                self.met |= set(value)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(session.config, "workerinput") or not _is_whole(session):
            return
        self.missing = sorted(kernel_names() - BOOKKEEPING - self.met)
        if self.missing and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter) -> None:
        if missing := getattr(self, "missing", []):
            terminalreporter.section("kernels without a twin", red=True)
            terminalreporter.line(
                f"no test launched these and called the function of the same name in "
                f"reference*.py: {', '.join(missing)}"
            )


def _is_whole(session: pytest.Session) -> bool:
    """Whether all tests ran: none was named, chosen, left out or stopped early."""
    options = session.config.option
    named = session.config.args_source != pytest.Config.ArgsSource.TESTPATHS
    chosen = options.keyword or options.markexpr or options.deselect or options.ignore
    return not (named or chosen or options.collectonly or session.shouldstop or session.shouldfail)
