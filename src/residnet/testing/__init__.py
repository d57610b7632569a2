"""Contracts of every kind of part, to be run by residnet and by packages that add parts to it.

Each function takes a part and raises an `AssertionError` of one line where it breaks a contract:

    from residnet.testing import check_head
    from my_package.heads import TideConfig

    def test_my_head() -> None:
        check_head(TideConfig())
"""

from __future__ import annotations

from residnet.testing.checks import (
    check_bad_inputs,
    check_baseline,
    check_exporter,
    check_head,
    check_manoeuvre,
    check_reader,
    check_vessel,
    make_example_models,
    make_example_samples,
)

__all__ = [
    "check_bad_inputs",
    "check_baseline",
    "check_exporter",
    "check_head",
    "check_manoeuvre",
    "check_reader",
    "check_vessel",
    "make_example_models",
    "make_example_samples",
]
