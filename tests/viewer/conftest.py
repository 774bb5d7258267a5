"""Results that all tests of viewers look at; they are only read."""

from __future__ import annotations

import pytest
from colored_results import ColoredResults, make_colored_results


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> ColoredResults:
    return make_colored_results(tmp_path_factory.mktemp("colored"))
