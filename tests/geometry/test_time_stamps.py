"""Association by time stamp against trying all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry.time_stamps import associate, nearest

START = 1305031453.25  # [s]


def brute_force(a, b, max_difference):
    """All pairs within reach, nearest first, each stamp once."""
    pairs, used_a, used_b = [], set(), set()
    for _, i, j in sorted(
        (abs(x - y), i, j)
        for i, x in enumerate(a)
        for j, y in enumerate(b)
        if abs(x - y) <= max_difference
    ):
        if i not in used_a and j not in used_b:
            pairs.append((i, j))
            used_a.add(i)
            used_b.add(j)
    return sorted(pairs)


@pytest.mark.parametrize("seed", range(5))
def test_association_equals_trying_all_pairs(seed):
    rng = np.random.default_rng(seed)
    a, b = START + np.sort(rng.uniform(0, 2, 60)), START + np.sort(rng.uniform(0, 2, 50))
    pairs = associate(a, b, 0.03)
    assert [tuple(pair) for pair in pairs] == brute_force(a, b, 0.03)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)


def test_association_takes_the_earlier_of_two_equally_near_and_the_limit_itself():
    a = np.arange(200) / 32  # exact in binary, as are all differences
    b = a + 1 / 64  # every inner stamp has two partners equally near
    pairs = associate(a, b, 1 / 64)
    assert (
        [tuple(pair) for pair in pairs] == brute_force(a, b, 1 / 64) == [(i, i) for i in range(200)]
    )
    assert (
        len(associate(a[:1], a[:1] + 0.25, 0.25)) == len(associate(a[:1], a[:1] - 0.25, 0.25)) == 1
    )


def test_association_is_symmetric():
    rng = np.random.default_rng(9)
    a, b = np.sort(rng.uniform(0, 2, 60)), np.sort(rng.uniform(0, 2, 50))
    assert sorted(map(tuple, associate(a, b, 0.03))) == sorted(
        (i, j) for j, i in associate(b, a, 0.03)
    )


def test_nearest_equals_trying_all():
    rng = np.random.default_rng(4)
    for count in (1, 2, 30):
        stamps, query = np.sort(rng.uniform(0, 1, count)), rng.uniform(-0.5, 1.5, 40)
        np.testing.assert_array_equal(
            nearest(stamps, query), np.abs(stamps - query[:, None]).argmin(axis=1)
        )
