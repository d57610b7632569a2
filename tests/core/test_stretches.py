"""Contiguous stretches against a search sample by sample."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from residnet.core.stretches import stretch_bounds, stretch_numbers, stretches


def one_by_one(labels: list[int]) -> list[tuple[int, int]]:
    found, place = [], 0
    for label, group in itertools.groupby(labels):
        length = len(list(group))
        if label >= 0:
            found.append((place, place + length))
        place += length
    return found


@pytest.mark.parametrize("seed", range(20))
def test_numbers(seed: int) -> None:
    random = np.random.default_rng(seed)
    labels = np.repeat(random.integers(-1, 3, size=12), random.integers(1, 4, size=12))
    expected = one_by_one(labels.tolist())
    starts, stops = stretches(labels)
    assert list(zip(starts.tolist(), stops.tolist(), strict=True)) == expected
    numbers, (begins, ends) = stretch_numbers(labels), stretch_bounds(labels)
    for place, label in enumerate(labels.tolist()):
        if label < 0:
            assert (numbers[place], begins[place], ends[place]) == (-1, place, place)
        else:
            begin, end = expected[numbers[place]]
            assert begin <= place < end
            assert (begins[place], ends[place]) == (begin, end)


def test_flags() -> None:
    flags = np.array([True, True, False, True, False, False, True])
    starts, stops = stretches(flags)
    assert starts.tolist() == [0, 3, 6]
    assert stops.tolist() == [2, 4, 7]
    assert stretch_numbers(flags).tolist() == [0, 0, -1, 1, -1, -1, 2]


@pytest.mark.parametrize("labels", [np.zeros(0, dtype=bool), np.zeros(0, dtype=int)])
def test_nothing_holds_no_stretch(labels: np.ndarray) -> None:
    assert [part.tolist() for part in stretches(labels)] == [[], []]
    assert stretch_numbers(labels).size == 0


def test_no_flag_is_no_stretch() -> None:
    assert stretches(np.zeros(4, dtype=bool))[0].size == 0
