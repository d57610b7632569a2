"""Faults of actuators, receivers and clocks on a vessel drawn at random.

scripts/bench/doctor.py has more of both.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from planted import Fault
from planted_channels import CHANNEL_FAULTS, Undecidable
from random_vessels import random_logs, ship_of

from residnet.core.log import Log
from residnet.data.channels import beyond_belief, fills, spike_cells, without_spikes
from residnet.data.doctor import inspect, inspect_together
from residnet.data.doctor.findings import run
from residnet.data.doctor.statistics import Record


@cache
def logs() -> tuple[Log, ...]:
    return tuple(random_logs("boat", 5, 1)[0])


@pytest.mark.parametrize("fault", CHANNEL_FAULTS, ids=lambda fault: fault.name)
def test_planted_faults_are_found(fault: Fault) -> None:
    random = np.random.default_rng(7)
    members = [logs()[1], logs()[0], logs()[2]]
    try:
        sick = fault.plant(ship_of("boat", members[0]), members, random)
    except Undecidable:
        pytest.skip(f"this vessel's logs cannot show {fault.name}")
    found = [*inspect(sick[0]).findings, *inspect_together([*sick, *members[1:]]).findings]
    loud = [finding for finding in found if finding.level != "note"]
    assert any(finding.code in fault.codes for finding in loud), [f.text for f in loud]


def test_clean_logs_have_nothing_above_a_note() -> None:
    found = [finding for log in logs() for finding in inspect(log).findings]
    found += inspect_together(logs()).findings
    assert [finding.text for finding in found if finding.level != "note"] == []


def test_a_spike_is_bridged_and_masked() -> None:
    log = logs()[0]
    assert spike_cells(log) == {}
    assert without_spikes(log) is log
    u = log["u"].copy()
    u[700] = -999.0
    clean = without_spikes(log.replace(channels={**log.channels, "u": u}))
    assert clean.meta["spikes"] == {"u": 1}
    assert np.flatnonzero(clean.masks["spike"]).tolist() == [700]
    assert clean["u"][700] == pytest.approx(0.5 * (u[699] + u[701]))


def test_fill_values_are_told_from_measurements() -> None:
    values = np.linspace(900.0, 1100.0, 201)
    assert not fills(values).any()
    values[3], values[7] = -9999.0, np.float32(9.96921e36)
    assert np.flatnonzero(fills(values)).tolist() == [3, 7]
    assert beyond_belief(np.array([3.0, 1e4, np.nan]), "m/s").tolist() == [False, True, False]


def twin(port: float, stbd: float, yaw: float, speed: float) -> Log:
    """A vessel with two propellers and no rudder at steady revolutions."""
    t = np.arange(600) * 0.1
    noise = np.random.default_rng(0)
    u = speed + 0.01 * noise.normal(size=t.size)
    r = yaw + 0.002 * noise.normal(size=t.size)
    n_port, n_stbd = (np.full(t.size, value) for value in (port, stbd))
    return Log("twin", t, {"u": u, "r": r, "n_port": n_port, "n_stbd": n_stbd})


@pytest.mark.parametrize(
    ("log", "said"),
    [
        (twin(-10.0, 30.0, -0.3, 0.8), []),  # it turns to port because one runs astern
        (twin(-20.0, 20.0, 0.0, 1.2), ["propeller_sign"]),  # it would turn, and does not
        (twin(-20.0, -20.0, 0.0, 1.2), ["propeller_sign"] * 2),
        (twin(34.0, 34.0, 0.0, 1.9), []),  # who does not steer does not turn
        (twin(1200.0, 600.0, -0.3, 1.2), ["unit", "unit"]),
        (twin(0.8, 30.0, -0.3, 0.9), []),  # one hardly turns, the other drives
    ],
)
def test_two_propellers_steer_by_their_difference(log: Log, said: list[str]) -> None:
    found = [*run("actuators", Record(log, ["n_port", "n_stbd"]))]
    assert [finding.code for finding in found] == said
