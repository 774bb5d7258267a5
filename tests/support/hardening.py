"""What must not break, by id; which tests show it, by the tests' names; and the table of docs/reliability.md.

python tests/support/hardening.py          writes the table into the page
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- table: written by tests/support/hardening.py -->", "<!-- end of the table -->"

# Capital letters: what a mapper must survive. Small ones: attacks on this program that once succeeded.
IDS = {
    "F1": "a depth image without readings",
    "F2": "NaN, infinite and negative depth",
    "F3": "65535 in depth",
    "F4": "one valid pixel",
    "F5": "colour and depth of different size",
    "F6": "wrong types and channels of images",
    "F7": "images that are cut, damaged or none",
    "F8": "16-bit depth read as 8-bit",
    "F9": "a wrong depth scale",
    "F10": "depth beyond the limit",
    "F11": "image headers that ask for gigabytes",
    "P1": "poses that are no poses",
    "P2": "mirrored, scaled, sheared rotations",
    "P3": "the same pose again and again",
    "P4": "camera-to-world against world-to-camera",
    "P5": "axes of OpenGL",
    "P6": "quaternions that are not of unit length",
    "P7": "missing, extra, unsorted and odd rows of poses",
    "P8": "jumps",
    "S1": "a frame that is missing",
    "S2": "fewer poses than frames",
    "S3": "times too far apart",
    "S4": "an empty folder",
    "S5": "a map of one frame",
    "S6": "a camera that never moves",
    "S7": "a camera that is carried away",
    "C1": "wrong calibration",
    "R1": "the limit of voxels",
    "R2": "memory that runs out",
    "R3": "Ctrl-C",
    "R4": "SIGTERM",
    "R5": "a full disk",
    "R6": "a folder that cannot be written",
    "R7": "kill -9",
    "R9": "frames put in and taken out again",
    "R10": "two runs into one folder",
    "M1": "map files that are cut",
    "M2": "flipped bits in map files",
    "M3": "other files and versions",
    "M4": "map files that lie",
    "M5": "archives that unpack to gigabytes",
    "M6": "pickles with a payload",
    "M7": "paths in names",
    "M8": "round trips to the bit",
    "M9": "map files of earlier versions",
    "M10": "numbers in map files that are not finite",
    "I1": "mutated files of every kind",
    "I2": "headers of .sens that lie",
    "I3": "encodings of images in bags",
    "I4": "recordings that are cut",
    "I5": "bombs and odd keys in YAML",
    "X1": "networks that are missing or damaged",
    "X2": "payloads in files of torch",
    "X3": "no GPU",
    "X4": "networks that answer NaN",
    "V1": "who can open the page of the viewer",
    "V3": "no screen",
    "V4": "exit codes",
    "N3": "other orders of frames",
    "N4": "spheres, planes and boxes",
    "N5": "the same bytes again",
    "N6": "bounds and overflow in kernels",
    "K1": "what an installation needs",
    "K2": "what an import takes",
    "c1": "several large maps in one process",
    "c2": "tensors that do not belong into a map",
    "c3": "manifests that lie about sizes",
    "c4": "settings of wrong types in map files",
    "c5": "errors that are not ours in the middle of a run",
    "c6": "files in a results folder that are not the run's",
    "c7": "properties that are called like other files",
    "c8": "arrays and JSON that lie or are cut",
    "c9": "threads, forks, copies, another ti.init",
    "c10": "runs that are killed while they write",
    "c11": "settings that cannot be",
    "c12": "control characters in names",
    "c13": "links in a results folder",
    "c14": "images larger than the camera's",
    "c15": "zero bytes in names, mixed polygons",
    "c16": "signals at the edges of a command",
    "c17": "values of any size, normals of any length",
    "c18": "order of frames and the cut of the surface",
    "c19": "debug mode",
}
# id -> why there is no test of that name
OPEN = {
    "R8": "`make soak`, too long for the suite",
    "V2": "the viewer takes no uploads",
    "N1": "counts of vertices are bounded by c18, not frozen",
    "N2": "every kernel has its twin in tests/support/reference*.py",
    "K3": "`python scripts/extras.py` installs every extra by itself; figures above",
    "K4": "py.typed is tested in test_packaging.py; types are checked by `make types`",
}
NAME = re.compile(r"^def (test_\w+)", re.M)
WORDS = re.compile(r"(?<![A-Za-z0-9])([A-Za-z]{1,2}[0-9]{1,2})(?![A-Za-z0-9])")


def tests_by_id() -> dict[str, list[str]]:
    """Id -> tests that have it in their name, as file: name."""
    found: dict[str, list[str]] = {key: [] for key in IDS}
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        for test in NAME.findall(file.read_text()):
            for word in WORDS.findall(test.removeprefix("test_").replace("_", " ")):
                key = word if word in found else word.upper()
                if key in found:
                    found[key].append(f"{file.relative_to(ROOT / 'tests')}: {test}")
    return found


def table() -> str:
    """The table of the page: id, what, number of tests and the first of them."""
    rows = ["| id | what | tests |", "|---|---|---|"]
    for key, tests in tests_by_id().items():
        files = list(dict.fromkeys(test.split(":")[0] for test in tests))
        rows.append(f"| {key} | {IDS[key]} | {len(tests)} in {', '.join(files[:3])} |")
    rows += [f"| {key} | {reason} | |" for key, reason in OPEN.items()]
    return "\n".join(rows)


def with_table(page: str) -> str:
    """The page with today's table."""
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return f"{head}{BEGIN}\n{table()}\n{END}{tail}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
    sys.exit(0)
