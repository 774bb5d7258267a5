"""A table as text: the paper's rows with ours below, what was done, and what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from paper_runs import Results
from paper_tables import NOTHING, ByExperiment, Table, more_rows, paper_rows


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A header and rows as a table; columns of numbers are aligned to the right."""
    header, *lines = rows
    numeric = [
        all(line[i][:1].isdigit() or line[i] == NOTHING for line in lines)
        for i in range(len(header))
    ]
    rule = ["---:" if right else "---" for right in numeric]
    return "\n".join(f"| {' | '.join(row)} |" for row in (header, rule, *lines))


def report(table: Table, found: Mapping[str, ByExperiment]) -> str:
    """The table, what else was measured, and which scenes failed or are not there."""
    header, *rows = paper_rows(table.number)
    for method, results in found.items():
        done = sum(len(each.done) for each in results.values())
        said = f"{method} ({done} scene{'s' * (done != 1)})"
        rows += [[said, *row[1:]] for row in table.rows(method, results, header)]
    title = f"\nTable {table.number}: {table.title}"
    blocks = ["\n".join([title, *_what_was_done(found)]), markdown([header, *rows])]
    if table.more:
        blocks.append("Ours, means over the scenes:\n\n" + markdown(more_rows(table, found)))
    for method, by_experiment in found.items():
        blocks += [
            _counted(f"{method}, {name}", results)
            for name, results in by_experiment.items()
            if results.done or results.failed
        ]
    return "\n\n".join(blocks)


def _what_was_done(found: Mapping[str, ByExperiment]) -> list[str]:
    """A line an experiment; those of methods that were run alike are one."""
    lines = [
        f"Ours, {name}: {said}."
        for by_experiment in found.values()
        for name, results in by_experiment.items()
        if results.done or results.failed
        for said in results.said
    ]
    return list(dict.fromkeys(lines))


def _counted(what: str, results: Results) -> str:
    if results.kept:
        return f"{what}: {len(results.done)} scenes, done before"
    total = len(results.done) + len(results.failed) + len(results.missing)
    text = f"{what}: {len(results.done)} of {total} scenes"
    if results.missing:
        text += f"; {len(results.missing)} not found: {_some(results.missing)}"
    if results.failed:
        text += f"; {len(results.failed)} failed: {_some(list(results.failed))}"
    return text


def _some(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
