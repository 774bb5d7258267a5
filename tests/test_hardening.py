"""Every id of what must not break has a test with it in its name, and the page says which."""

from __future__ import annotations

import hardening


def test_every_id_has_a_test():
    assert [key for key, tests in hardening.tests_by_id().items() if not tests] == []
    assert not set(hardening.IDS) & set(hardening.OPEN)


def test_the_page_has_a_row_for_every_id_and_names_files_that_are_there():
    """The table itself is renewed by python tests/support/hardening.py."""
    rows = [line.split("|")[1:4] for line in hardening.PAGE.read_text().splitlines() if "|" in line]
    named = {row[0].strip(): row[2] for row in rows}
    assert {*hardening.IDS, *hardening.OPEN} <= set(named)
    for key in hardening.IDS:
        for file in named[key].partition(" in ")[2].split(", "):
            assert (hardening.ROOT / "tests" / file.strip()).is_file(), key
