"""What a stranger meets before the first frame: set-up (K1), imports and --help (K2), and what the
repository holds.
"""

from __future__ import annotations

import ast
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "taichi_unifusion"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

# K2; of processor time, the best of three: so that other programs on the machine do not decide
MAX_IMPORT_S = 1.5
# each more than a second of import, none needed to reconstruct
HEAVY = {"torch", "open3d", "trimesh", "viser", "fast_simplification"}
MAX_FILE_BYTES = 1 << 20
MAX_REPOSITORY_BYTES = 6 << 20
IMPORT_NAMES = {
    "lazy_loader": "lazy-loader",
    "cv2": "opencv-python-headless",
    "skimage": "scikit-image",
    "yaml": "pyyaml",
    "PIL": "pillow",
    "dask_jobqueue": "dask-jobqueue",
    "fast_simplification": "fast-simplification",
    "pxr": "usd-core",
    "backports": "backports-zstd",
    "OpenEXR": "openexr",
    "liblzfse": "pyliblzfse",
}


# ---- K2: imports ----


def modules_after(code: str) -> tuple[set[str], float]:
    """Top-level modules that a fresh interpreter holds after `code`, and its processor time, start
    included [s].
    """
    report = (
        "import json, sys\n"
        "print(json.dumps(sorted({n.partition('.')[0] for n in sys.modules})), file=sys.stderr)"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stderr.splitlines()[-1])), seconds


def run_main(*arguments: str) -> str:
    """Code that does what the console script `unifusion` does, and survives its exit."""
    module, function = PROJECT["scripts"]["unifusion"].split(":")
    return (
        f"import sys; sys.argv = {['unifusion', *arguments]!r}\nfrom {module} import {function}\n"
        f"try:\n    code = {function}()\nexcept SystemExit as stop:\n    code = stop.code\nassert not code, code"
    )


@pytest.mark.parametrize(
    "code", ["import taichi_unifusion", run_main("--help")], ids=["import", "help"]
)
def test_K2_import_and_help_are_quick_and_leave_taichi_alone(code: str) -> None:
    runs = [modules_after(code) for _ in range(3)]
    assert not runs[0][0] & (HEAVY | {"taichi"})
    assert min(seconds for _, seconds in runs) < MAX_IMPORT_S


def test_K2_every_public_name_resolves_without_heavy_imports() -> None:
    modules, _ = modules_after(
        "import taichi_unifusion as uf\nassert uf.__all__\nfor name in uf.__all__: getattr(uf, name)"
    )
    assert not modules & HEAVY


def third_party_imports(body: list[ast.stmt]) -> set[str]:
    """Top-level names of the installed packages that these statements import, functions and classes
    included.
    """
    names = set()
    for node in (inner for statement in body for inner in ast.walk(statement)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names - set(sys.stdlib_module_names) - {PACKAGE.name}


def test_every_import_is_a_declared_dependency() -> None:
    def declared(requirements: list[str]) -> set[str]:
        return {re.match(r"[\w.-]+", requirement)[0].lower() for requirement in requirements}

    core = declared(PROJECT["dependencies"])
    anywhere = core.union(*map(declared, PROJECT["optional-dependencies"].values()))
    undeclared = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        body = ast.parse(path.read_text()).body
        at_import = third_party_imports(
            [s for s in body if isinstance(s, ast.Import | ast.ImportFrom)]
        )
        lacking = {n for n in at_import if IMPORT_NAMES.get(n, n) not in core}
        lacking |= {n for n in third_party_imports(body) if IMPORT_NAMES.get(n, n) not in anywhere}
        if lacking:
            undeclared[str(path.relative_to(ROOT))] = sorted(lacking)
    assert not undeclared


# ---- K1: set-up, with the machine's Python and apt replaced by ones that lack something ----


@pytest.fixture
def bare_clone(tmp_path: Path) -> Path:
    """A clone's set-up files beside an `apt-get` and a `sudo` that refuse."""
    clone = tmp_path / "a clone"
    (clone / "scripts").mkdir(parents=True)
    for name in ("pyproject.toml", "Makefile", "scripts/setup.sh"):
        shutil.copy(ROOT / name, clone / name)
    for name in ("apt-get", "sudo"):
        write_program(tmp_path / "bin" / name, "exit 1")
    return clone


def write_program(path: Path, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return path


def python_with(folder: Path, module: str, source: str) -> Path:
    """This Python with one module of its library replaced."""
    (folder / "modules").mkdir()
    (folder / "modules" / f"{module}.py").write_text(source)
    return write_program(
        folder / "python", f"PYTHONPATH='{folder}/modules' exec '{sys.executable}' \"$@\""
    )


def run_setup(clone: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    path = f"{clone.parent / 'bin'}{os.pathsep}{os.environ['PATH']}"
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHON"}
    script = ["bash", str(clone / "scripts" / "setup.sh")]
    return subprocess.run(
        script,
        env={**inherited, "PATH": path, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def test_K1_unsuitable_python_is_named_with_the_suitable_ones(bare_clone: Path) -> None:
    source = "import sys; sys.version_info = (3, 10, 0, 'final', 0)"
    old_python = python_with(bare_clone.parent, "sitecustomize", source)
    done = run_setup(bare_clone, PYTHON=str(old_python))
    assert done.returncode == 1
    assert str(old_python) in done.stderr and "3.11, 3.12 or 3.13" in done.stderr
    assert done.stderr.count("\n") == 1 and not (bare_clone / ".venv").exists()


@pytest.mark.parametrize(
    ("module", "package"), [("ensurepip", r"python3\.1[123]-venv"), ("ctypes", "libx11-6")]
)
def test_K1_missing_system_package_is_one_sentence_with_the_command(
    bare_clone: Path, module: str, package: str
) -> None:
    python = python_with(bare_clone.parent, module, "raise ImportError")
    done = run_setup(bare_clone, PYTHON=str(python))
    assert done.returncode == 1
    assert re.search(rf"run: (sudo )?apt-get install -y .*{package}", done.stderr.splitlines()[-1])
    assert "Traceback" not in done.stderr and not (bare_clone / ".venv").exists()


def test_K1_finished_setup_is_left_alone_until_the_project_changes(bare_clone: Path) -> None:
    """Also: an Open3D that cannot be had is one sentence, not a failure. The environment's pip only
    says that it was called.
    """
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", bare_clone / ".venv"], check=True
    )
    pip = next((bare_clone / ".venv").glob("lib/python3*/site-packages")) / "pip"
    pip.mkdir()
    (pip / "__main__.py").write_text("print('pip called')")
    first = run_setup(bare_clone)
    assert first.returncode == 0 and "pip called" in first.stderr
    assert first.stderr.count("Open3D does not import") == 1
    second = run_setup(bare_clone)
    assert (second.returncode, second.stdout, second.stderr) == (0, "", "")
    with (bare_clone / "pyproject.toml").open("a") as project:
        project.write("\n")
    assert "pip called" in run_setup(bare_clone).stderr


# ---- what the repository holds ----


@pytest.fixture(scope="module")
def tracked_files() -> list[Path]:
    if not shutil.which("git"):
        pytest.skip("git is not installed")
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if not listing.stdout:
        pytest.skip("not a git clone with tracked files")
    return [path for name in listing.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def test_repository_stays_small(tracked_files: list[Path]) -> None:
    sizes = {str(path.relative_to(ROOT)): path.stat().st_size for path in tracked_files}
    assert {name: size for name, size in sizes.items() if size > MAX_FILE_BYTES} == {}
    assert sum(sizes.values()) < MAX_REPOSITORY_BYTES


def test_no_tracked_file_names_a_place_on_somebodys_machine(tracked_files: list[Path]) -> None:
    personal = re.compile(
        rb"(?:^|[\s\"'`(=:,])(/(?:home|root|Users|work|workspace|mnt)/[A-Za-z0-9_.-]+)",
        re.MULTILINE,
    )
    found = {
        str(path.relative_to(ROOT)): personal.findall(path.read_bytes()) for path in tracked_files
    }
    assert {name: places for name, places in found.items() if places} == {}


def test_typing_marker_lies_in_the_package() -> None:
    assert (PACKAGE / "py.typed").is_file()
