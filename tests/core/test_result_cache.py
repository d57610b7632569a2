"""Results of dear functions are computed once for equal arguments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from residnet.core.result_cache import cache_results


@dataclass(frozen=True)
class Channel:
    """A channel of an example."""

    name: str
    values: np.ndarray


class Doubler:
    """A function with a count of its calls."""

    def __init__(self, max_bytes: int) -> None:
        self.n_calls = 0

        @cache_results(max_bytes)
        def double(
            values: np.ndarray, factor: float = 2.0, channels: tuple[Channel, ...] = ()
        ) -> dict[str, np.ndarray]:
            self.n_calls += 1
            if factor < 0.0:
                raise ValueError("negative")
            return {"values": factor * values, **{c.name: c.values for c in channels}}

        self.double = double


def test_cached_function_computes_equal_arguments_once() -> None:
    doubler = Doubler(10_000)
    first = doubler.double(np.arange(5.0), channels=(Channel("a", np.ones(2)),))
    second = doubler.double(np.arange(10.0)[:5], channels=(Channel("a", np.ones(2)),))
    assert doubler.n_calls == 1
    np.testing.assert_array_equal(first["values"], second["values"])
    np.testing.assert_array_equal(second["a"], np.ones(2))


@pytest.mark.parametrize(
    ("values", "factor", "channels"),
    [
        (np.array([0.0, 1.0, 2.5]), 2.0, ()),
        (np.arange(3), 2.0, ()),
        (np.arange(3.0)[:, None], 2.0, ()),
        (np.arange(3.0), 2.5, ()),
        (np.arange(3.0), 2.0, (Channel("a", np.ones(1)),)),
    ],
)
def test_cached_function_computes_other_arguments_again(
    values: np.ndarray, factor: float, channels: tuple[Channel, ...]
) -> None:
    doubler = Doubler(10_000)
    doubler.double(np.arange(3.0), 2.0)
    result = doubler.double(values, factor, channels)
    assert doubler.n_calls == 2
    np.testing.assert_array_equal(result["values"], factor * values)


def test_changes_of_a_result_do_not_reach_the_cache() -> None:
    doubler = Doubler(10_000)
    doubler.double(np.ones(3))["values"][:] = np.nan
    doubler.double(np.ones(3))["values"][:] = np.nan
    np.testing.assert_array_equal(doubler.double(np.ones(3))["values"], np.full(3, 2.0))


def test_cache_removes_the_results_that_were_unused_for_longest() -> None:
    doubler = Doubler(2 * 80)
    for start in (0.0, 1.0, 0.0, 2.0):
        doubler.double(start + np.arange(10.0))
    assert doubler.n_calls == 3
    doubler.double(np.arange(10.0))
    assert doubler.n_calls == 3
    doubler.double(1.0 + np.arange(10.0))
    assert doubler.n_calls == 4


def test_a_result_larger_than_the_cache_is_not_stored() -> None:
    doubler = Doubler(79)
    for _ in range(2):
        doubler.double(np.arange(10.0))
    assert doubler.n_calls == 2


def test_an_error_is_raised_again() -> None:
    doubler = Doubler(10_000)
    for _ in range(2):
        with pytest.raises(ValueError, match="negative"):
            doubler.double(np.ones(2), -1.0)
    assert doubler.n_calls == 2


def test_an_argument_without_digest_is_refused() -> None:
    doubler = Doubler(10_000)
    with pytest.raises(TypeError, match="no digest"):
        doubler.double(np.ones(2), object())  # type: ignore[arg-type]
