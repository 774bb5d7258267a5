"""The tables of `speed.py`, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from speed_sides import OpenTsdf, Times

HEADER = (
    *("every", "frames", "side", "wall [ms]", "CPU [ms]", "wall ratio", "CPU ratio"),
    *("worst / mean, wall", "worst / mean, CPU"),
    *("mesh wall [ms]", "mesh CPU [ms]", "mesh wall ratio", "mesh CPU ratio"),
)


def rows_of(every: int, times: Mapping[str, Times]) -> list[list[str]]:
    """Rows of the table; ratios are to Open3D, "-" without it."""
    peer = times.get(OpenTsdf.name)
    rows = []
    for name, one in times.items():
        ratios = ["-"] * 4
        if peer is not None:
            ratios = [f"{r:.2f}" for r in (*one.mean / peer.mean, *one.mesh / peer.mesh)]
        rows.append(
            [
                *(str(every), str(len(one.frames)), name),
                *(f"{ms:.1f}" for ms in one.mean),
                *ratios[:2],
                *(f"{multiple:.1f}" for multiple in one.worst),
                *(f"{ms:.0f}" for ms in one.mesh),
                *ratios[2:],
            ]
        )
    return rows


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a table; columns of numbers are aligned to the right."""
    numeric = [
        all(row[i][:1].isdigit() or row[i] == "-" for row in rows) for i in range(len(header))
    ]
    rule = ["---:" if right else "---" for right in numeric]
    return "\n".join(f"| {' | '.join(row)} |" for row in (header, rule, *rows))
