"""The doctor on simulated vessels: planted faults are found, clean logs raise nothing.

scripts/bench/doctor.py has more vessels and seeds.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from planted import FAULTS, KINDS, SHIPS, Fault, Ship, Undecidable, clean
from random_vessels import random_logs, ship_of

from residnet.core.log import Log
from residnet.quality import Finding, inspect_log, inspect_log_set

HOSTS = ("boat", "wam_v", "ferry")


@cache
def host(name: str) -> tuple[Ship, tuple[Log, ...]]:
    if name == "boat":
        logs = tuple(random_logs("boat", 5, 1)[0])
        return ship_of("boat", logs[0]), logs
    ship = next(ship for ship in SHIPS if ship.name == name)
    return ship, tuple(clean(ship, 101, KINDS))


def told(logs: list[Log], alone: int) -> list[Finding]:
    found = [finding for log in logs[:alone] for finding in inspect_log(log).findings]
    return [*found, *inspect_log_set(logs).findings]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.long] if name != "boat" else []) for name in HOSTS],
)
def test_inspect_log_of_clean_simulations_gives_notes_only(name: str) -> None:
    logs = list(host(name)[1])
    said = told(logs, len(logs))
    assert [finding.text for finding in said if finding.level != "note"] == []


# each fault on the boat where she can show it, on one of the two ships else; some on a second one
# among the long tests
BOTH = ("stuck actuator", "steering reversed", "lag of psi", "inputs late", "frozen sensor")
CASES = [
    pytest.param(fault, name, marks=[pytest.mark.long] if name != able[0] else [])
    for fault in FAULTS
    for able in [[name for name in HOSTS if name in fault.ships + fault.hosts]]
    for name in (able if fault.name in BOTH else able[:1])
]


@pytest.mark.parametrize(("fault", "name"), CASES, ids=lambda of: getattr(of, "name", of))
def test_inspect_log_reports_faults_planted_in_simulations(fault: Fault, name: str) -> None:
    ship, logs = host(name)
    random = np.random.default_rng([101, FAULTS.index(fault)])
    members = [logs[i] for i in random.permutation(3)]
    try:
        sick = fault.plant(ship, members, random)
    except Undecidable:
        pytest.skip(f"these logs cannot show {fault.name}")
    said = told([*sick, *members[1:]] if len(sick) == 1 else sick, 1)
    loud = [finding for finding in said if finding.level != "note" or fault.harmless]
    assert any(finding.code in fault.codes for finding in loud), [f.text for f in said]
