"""Taichi starts once for all tests; data sets that the repository cannot hold are found or skipped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import twin_calls
from places import DATA, DEVICE

import taichi_unifusion as uf


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        # this process runs tests, and does not only hand them out
        twin_calls.record_twins()  # before a test imports them
        twin_calls.record_kernels()
    config.pluginmanager.register(twin_calls.TwinCalls())
    config.addinivalue_line(
        "markers", "data: reads a real recording; skipped where it is not at hand"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "data" in getattr(item, "fixturenames", ()):
            item.add_marker("data")


@pytest.fixture(scope="session", autouse=True)
def runtime():
    """The one Taichi of the process, on the CPU unless UNIFUSION_TEST_DEVICE says otherwise."""
    return uf.init(DEVICE)


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """Folder of a named recording, or a skip that says where it was looked for."""

    def folder(name: str) -> Path:
        if not (DATA / name).is_dir():
            pytest.skip(f"no {name} in {DATA}; set UNIFUSION_DATA to a folder that has it")
        return DATA / name

    return folder
