"""Contract checks of all kinds of parts, for the tests of residnet and of third-party packages.

Each function checks a part and raises an `AssertionError` of one line if it violates a contract:

    from residnet.testing import check_head
    from my_package.heads import TideConfig

    def test_my_head() -> None:
        check_head(TideConfig())
"""

from __future__ import annotations

from residnet.testing.checks import (
    check_baseline,
    check_head,
    check_manoeuvre,
    check_reader,
    check_vessel,
    make_example_models,
    make_example_samples,
)
from residnet.testing.export_checks import check_bad_inputs, check_exporter

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
