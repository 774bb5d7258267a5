"""Whether a release's version is the one that every file names; says which do not, and fails.

python scripts/check_version.py 0.2.0
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLACES = {
    "CITATION.cff": r'^version: "?([\w.]+)"?$',
    "CHANGELOG.md": r"^## \[(\d[\w.]*)\]",
}


def named_versions() -> dict[str, str | None]:
    """File -> the version that it names, None where it names none."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found = {
        name: re.search(pattern, (ROOT / name).read_text(), re.MULTILINE)
        for name, pattern in PLACES.items()
    }
    return {
        "pyproject.toml": project["version"],
        **{name: match[1] if match else None for name, match in found.items()},
    }


def main(version: str) -> None:
    wrong = {name: found for name, found in named_versions().items() if found != version}
    if wrong:
        listed = ", ".join(f"{name} says {found or 'nothing'}" for name, found in wrong.items())
        sys.exit(f"the release is {version}, but {listed}")


if __name__ == "__main__":
    main(sys.argv[1])
