"""Simulations and trainings whose size can only be a slip are refused before the work."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from mutations import at, put
from tiny_tasks import TINY_TASKS

from residnet.core.errors import ConfigError
from residnet.dynamics.simulated import MOST_STEPS, check_steps
from residnet.tasks.registry import load_task


def test_two_days_at_ten_steps_a_second_are_simulated_and_years_are_not() -> None:
    check_steps(2 * 86_400.0, 0.1)
    with pytest.raises(ValueError, match=f"at most {MOST_STEPS:,}"):
        check_steps(3.15e7, 0.1)


@pytest.mark.parametrize(
    ("task", "keys"),
    [
        ("simulated", ("data", "duration")),
        ("simulated", ("data", "trials", 0, "count")),
        ("flown", ("programme", "duration")),
        ("autopilot", ("test", "duration")),
        ("autopilot", ("policies", "policy", "training", "epochs")),
        ("measured", ("heads", "mlp", "hidden", 0)),
        ("measured", ("training", "mlp", "steps")),
        ("measured", ("training", "mlp", "one_step", "epochs")),
    ],
)
def test_a_million_times_as_much_is_a_slip(
    task: str, keys: tuple[str | int, ...], tmp_path: Path
) -> None:
    config: dict[str, Any] = copy.deepcopy(TINY_TASKS[task](tmp_path))
    given = at(config, keys)
    put(config, keys, "6e6 s" if isinstance(given, str) else given * 1_000_000)
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match=r"at most|less than or equal"):
        load_task(file)
