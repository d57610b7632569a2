"""The order of the files: dear ones first, so that two processes end together."""

from __future__ import annotations

import pytest

DEAR = (
    "tasks/test_fit.py",
    "export/test_formats.py",
    "test_api.py",
    "documents/test_force_residual.py",
    "contracts/test_every_part.py",
    "tasks/test_refusals.py",
    "data/test_one_drafter.py",
    "tasks/test_simulate.py",
    "documents/test_jervan2020.py",
    "control/test_course_plan.py",
    "identification/monitoring/test_monitor.py",
    "export/test_policies.py",
    "report/test_sections.py",
    "tasks/test_mutations.py",
    "training/test_refit.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files; `--dist loadfile` gives each to one process, which makes its fixtures."""
    order = {f"tests/{name}": number for number, name in enumerate(DEAR)}
    items.sort(key=lambda item: order.get(item.nodeid.partition("::")[0], len(DEAR)))
