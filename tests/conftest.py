"""The order of the files: dear ones first, so that two processes end together."""

from __future__ import annotations

import pytest

DEAR = (
    "contracts/test_every_part.py",
    "corpus/test_corpus.py",
    "tasks/test_refusals.py",
    "data/test_doctor_faults.py",
    "contracts/test_six.py",
    "physics/test_every_vessel.py",
    "identification/monitoring/test_monitor.py",
    "data/test_others.py",
    "tasks/test_fit.py",
    "export/test_formats.py",
    "control/test_course_plan.py",
    "training/test_current.py",
    "export/test_band.py",
    "tasks/test_simulate.py",
    "heads/test_symbolic.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files; `--dist loadfile` gives each to one process, which makes its fixtures."""
    order = {f"tests/{name}": number for number, name in enumerate(DEAR)}
    items.sort(key=lambda item: order.get(item.nodeid.partition("::")[0], len(DEAR)))
