"""Contiguous stretches against a search sample by sample."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from residnet.core.stretches import find_run_bounds, find_runs, number_runs


@pytest.mark.parametrize("seed", range(5))
def test_find_runs_equals_a_reference_loop(seed: int) -> None:
    random = np.random.default_rng(seed)
    labels = np.repeat(random.integers(-1, 3, size=12), random.integers(1, 4, size=12))
    expected = []
    place = 0
    for label, group in itertools.groupby(labels.tolist()):
        stop = place + len(list(group))
        expected += [(place, stop)] if label >= 0 else []
        place = stop
    starts, stops = find_runs(labels)
    assert list(zip(starts.tolist(), stops.tolist(), strict=True)) == expected
    numbers = number_runs(labels)
    (begins, ends) = find_run_bounds(labels)
    for place, label in enumerate(labels.tolist()):
        if label < 0:
            assert (numbers[place], begins[place], ends[place]) == (-1, place, place)
        else:
            begin, end = expected[numbers[place]]
            assert begin <= place < end
            assert (begins[place], ends[place]) == (begin, end)


def test_find_runs_of_flags_returns_true_samples() -> None:
    flags = np.array([True, True, False, True, False, False, True])
    assert [part.tolist() for part in find_runs(flags)] == [[0, 3, 6], [2, 4, 7]]
    assert number_runs(flags).tolist() == [0, 0, -1, 1, -1, -1, 2]
    for nothing in (flags & False, flags[:0], np.zeros(0, dtype=int)):
        assert [part.tolist() for part in find_runs(nothing)] == [[], []]
    assert number_runs(flags[:0]).size == 0
