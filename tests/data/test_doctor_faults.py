"""The doctor on simulated vessels: planted faults are found, clean logs raise nothing
(scripts/bench/doctor.py has more seeds).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from planted import FAULTS, SHIPS, Fault, Ship, clean
from planted_channels import HARMLESS
from written_logs import trial

from residnet.core.log import Log
from residnet.data.doctor import Finding, inspect, inspect_together

_SEEDS = (101,)
# the mariner takes half of the time and adds nothing to the other ship
_VESSELS = [ship for ship in SHIPS if ship.name != "mariner"]


@cache
def trials(ship: str, seed: int) -> tuple[Log, ...]:
    return tuple(
        clean(
            next(one for one in SHIPS if one.name == ship),
            seed,
            ("zigzag", "three_two_one_one", "random_steps", "turning_circle"),
        )
    )


def told(logs: list[Log]) -> list[Finding]:
    found = [finding for log in logs for finding in inspect(log).findings]
    return [*found, *inspect_together(logs).findings]


def loud(logs: list[Log]) -> list[Finding]:
    return [finding for finding in told(logs) if finding.level != "note"]


@pytest.mark.parametrize("ship", _VESSELS, ids=lambda ship: ship.name)
@pytest.mark.parametrize("seed", _SEEDS)
def test_clean_logs_raise_nothing_above_a_note(ship: Ship, seed: int) -> None:
    logs = list(trials(ship.name, seed))
    assert [finding.text for log in logs for finding in loud([log])] == []
    assert [finding.text for finding in loud(logs)] == []


@pytest.mark.parametrize("ship", _VESSELS, ids=lambda ship: ship.name)
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_planted_faults_are_named(fault: Fault, ship: Ship) -> None:
    if ship.name not in fault.ships:
        pytest.skip(f"{ship.name} has nothing that {fault.name} could damage")
    for seed in _SEEDS:
        random = np.random.default_rng([seed, FAULTS.index(fault)])
        logs = list(trials(ship.name, seed))[:3]
        sick = fault.plant(ship, [logs[i] for i in random.permutation(3)], random)
        said = told(sick) if fault.name in HARMLESS else loud(sick)
        assert any(finding.code in fault.codes for finding in said), [
            finding.text for finding in said
        ]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rare", [("x", "y"), ("u", "v"), ("psi",), ("x", "y", "u", "v", "r")])
def test_rare_samples_are_looked_at_without_a_warning(rare: tuple[str, ...]) -> None:
    """Positions come once a second where headings come ten times."""
    log = trial()
    channels = dict(log.channels)
    for name in rare:
        values = np.full(len(log), np.nan)
        values[::10] = log[name][::10]
        channels[name] = values
    report = inspect(log.replace(channels=channels), ["cmd_port", "cmd_stbd"])
    assert report.name == log.name
