"""The house: which files and rooms there are, and that imports go downwards only."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "taichi_unifusion"
# What every part uses, and the method itself; everything else lies in a folder, a room.
LOOSE_FILES = {"__init__", "types", "errors", "runtime", "config", "preprocessing", "pipeline"} | {
    "run_log",
    "__main__",
    "kernel_cache",
    "device_arrays",
}
# From the ground up. A room imports from lower floors alone, also where it imports within functions.
FLOORS = [
    {"errors"},
    {"kernel_cache", "device_arrays", "geometry"},
    {"runtime"},
    {"kernels"},
    {"types"},
    {"files"},
    {"preprocessing", "maps", "rendering"},
    {"networks"},
    {"datasets"},
    {"run_log"},
    {"tracking", "language", "evaluation"},
    {"config"},
    {"properties"},
    {"pipeline"},
    {"results"},
    {"viewer", "cluster"},
    {"cli"},
    {"__main__"},
]
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
# `Mesh.save` writes a file; what it imports knows nothing of `types`.
ALLOWED = {("types", "files.meshes")}
MOST_LINES = 430  # of a file


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in PACKAGE.rglob("*.py")}
INNER = sorted(set(MODULES) - {""})


def imports_of(name: str) -> set[str]:
    """Our modules that a module names in an import, wherever that stands."""
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        above = package.split(".") if package else []
        base = ".".join([*above[: len(above) - node.level + 1], *filter(None, [node.module])])
        for alias in node.names:
            inner = f"{base}.{alias.name}".strip(".")
            found.add(inner if inner in MODULES else base)
    return found - {name}


def room_of(name: str) -> str:
    return name.partition(".")[0]


def test_every_file_has_a_room():
    loose = {path.stem for path in PACKAGE.glob("*.py")}
    assert loose == LOOSE_FILES
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] != "_"}
    assert rooms <= set(FLOOR_OF), "a new room needs a floor"
    assert all((PACKAGE / room / "__init__.py").exists() for room in rooms)


@pytest.mark.parametrize("name", INNER)
def test_imports_go_downwards(name):
    upwards = {
        other
        for other in imports_of(name)
        if room_of(other) != room_of(name)
        and other  # the package itself: its version
        and FLOOR_OF[room_of(other)] >= FLOOR_OF[room_of(name)]
        and (name, other) not in ALLOWED
    }
    assert upwards == set()


def test_no_circle():
    """Not even one that lazy imports hide."""
    graph, done = {name: imports_of(name) - {""} for name in INNER}, set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for other in sorted(graph[name]):
                visit(other, (*path, name))
            done.add(name)

    for name in INNER:
        visit(name, ())


def test_taichi_is_taken_from_kernels():
    """Imported first by anybody else, it would not read what the runtime sets for it."""
    others = [name for name in INNER if "kernels" not in name.split(".")]
    assert [name for name in others if "taichi" in _imported_at_once(name)] == []


def test_files_stay_small():
    long = {name: lines for name in INNER if (lines := _lines(name)) > MOST_LINES}
    assert long == {}


def _imported_at_once(name: str) -> set[str]:
    body = ast.parse(MODULES[name].read_text()).body
    return {alias.name for node in body if isinstance(node, ast.Import) for alias in node.names}


def _lines(name: str) -> int:
    return len(MODULES[name].read_text().splitlines())
