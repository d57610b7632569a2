"""Logs that contradict each other are named with their cause, good ones are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fleets import CONTRADICTIONS, Fleet, drawn

from residnet.core.log import Log
from residnet.quality import Finding, inspect_log_set
from residnet.tasks.fit.config import FitConfig
from residnet.tasks.registry import load_task

# fleets that no limit was chosen on
_SEED = 11
_COUNT = 3


@pytest.fixture(scope="module", params=["boat", pytest.param("twin", marks=pytest.mark.long)])
def fleets(request: pytest.FixtureRequest) -> list[Fleet]:
    return drawn(request.param, _SEED, _COUNT)


def find_contradictions(logs: list[Log], fleet: Fleet) -> list[Finding]:
    findings = inspect_log_set(logs, fleet.inputs).findings
    return [finding for finding in findings if finding.code.startswith("contradicts")]


def test_find_consensus_on_clean_fleets_flags_no_log(fleets: list[Fleet]) -> None:
    assert [
        one.text for fleet in fleets[:2] for one in find_contradictions(fleet.logs, fleet)
    ] == []


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_rank_hypotheses_names_the_planted_cause(fleets: list[Fleet], what: str) -> None:
    hits = 0
    for number, fleet in enumerate(fleets):
        random = np.random.default_rng([_SEED, number])
        logs, at, cause = CONTRADICTIONS[what](fleet, random)
        logs = [log.replace(name=f"log_{i:02d}") for i, log in enumerate(logs)]
        name = f"log_{at[0]:02d}" if at else fleet.steering
        named = [one for one in find_contradictions(logs, fleet) if one.text.startswith(name)]
        hits += any(cause in one.code for one in named)
        # scripts/bench/fleets.py tells how often, over many more of them
        if hits == _COUNT - 1:
            return
    pytest.fail(f"{hits} of {_COUNT} named")


def test_rank_hypotheses_distinguishes_sign_offset_and_scale(fleets: list[Fleet]) -> None:
    fleet = fleets[0]
    name = fleet.steering
    changes = {
        "sign": (lambda x: -x, "the opposite sign"),
        "scale": (lambda x: 3.0 * x, "times as large"),
        "offset": (lambda x: x + 1.5 * np.std(x), "larger by -"),
    }
    for cause, (change, words) in changes.items():
        log = fleet.logs[2]
        channels = {**log.channels, name: change(log[name])}
        logs = [*fleet.logs[:2], log.replace(channels=channels), *fleet.logs[3:]]
        (one,) = [one for one in find_contradictions(logs, fleet) if one.text.startswith(log.name)]
        assert one.code == f"contradicts_{cause}"
        assert f"{name} would have to" in one.text
        assert words in one.text


def test_find_consensus_on_quickstart_flags_no_log() -> None:
    """Its constant inputs reach farther than most of its logs, which agree best without them."""
    task = load_task(Path("quickstart"))
    assert isinstance(task, FitConfig)
    logs = [log for members in task.load_logs().values() for log in members]
    assert find_contradictions(logs, Fleet("quickstart", logs, [], ("n_port", "n_stbd"), "")) == []


def _exchanged(log: Log) -> dict[str, np.ndarray]:
    return {"n_port": log["n_stbd"], "n_stbd": log["n_port"]}


def _reversed(log: Log) -> dict[str, np.ndarray]:
    return {"delta": -log["delta"]}


def _askew(log: Log) -> dict[str, np.ndarray]:
    """The sensor of the velocities is turned by 20 deg."""
    turned = (log["u"] + 1j * log["v"]) * np.exp(1j * np.radians(20.0))
    return {"u": turned.real, "v": turned.imag}


@pytest.mark.parametrize(
    ("kind", "change", "cause", "states"),
    [
        # a fleet of its own; faults of a boat are fast
        pytest.param(
            *("twin", _exchanged, "exchanged", ("x", "y", "psi", "r")), marks=pytest.mark.long
        ),
        ("boat", _reversed, "sign", ("psi", "u", "v", "r")),
        ("boat", _askew, "heading", ("psi", "u", "v", "r")),
    ],
)
def test_find_consensus_with_a_shared_fault_flags_all_logs_with_it(
    kind: str,
    change: Callable[[Log], dict[str, np.ndarray]],
    cause: str,
    states: tuple[str, ...],
) -> None:
    """A third of the logs share it; where none holds velocities, positions tell them."""
    (fleet,) = drawn(kind, 14, 1, fewest=9, most=9)
    logs = [
        log.replace(channels={name: log[name] for name in (*states, *fleet.inputs)})
        for log in fleet.logs
    ]
    assert find_contradictions(logs, fleet) == []
    wrong = [log.replace(channels={**log.channels, **change(log)}) for log in logs[:3]]
    named = find_contradictions([*wrong, *logs[3:]], fleet)
    assert sorted(one.text.split(":")[0] for one in named) == [log.name for log in logs[:3]]
    assert {one.code for one in named} == {f"contradicts_{cause}"}


def test_find_consensus_without_majority_says_so() -> None:
    fleet = drawn("boat", _SEED, _COUNT)[0]
    log = fleet.logs[1]
    channels = {**log.channels, fleet.steering: -log[fleet.steering]}
    assert find_contradictions(fleet.logs[:2], fleet) == []
    (one,) = find_contradictions([fleet.logs[0], log.replace(channels=channels)], fleet)
    assert "no more than half of the logs agree" in one.text


def test_find_consensus_with_surge_only_flags_a_weak_propeller() -> None:
    random = np.random.default_rng(3)
    t = np.arange(0.0, 120.0, 0.2)

    def surge(number: int, gain: float) -> Log:
        n = np.repeat(random.uniform(2.0, 8.0, t.size // 50), 50)
        u = np.zeros(t.size)
        for k in range(t.size - 1):
            u[k + 1] = u[k] + 0.2 * (0.02 * gain * n[k] ** 2 - 0.3 * u[k] * abs(u[k]))
        u += 0.01 * random.standard_normal(t.size)
        return Log(f"run_{number}", t, {"u": u, "n": n})

    logs = [surge(number, 1.0) for number in range(6)]
    fleet = Fleet("lake", logs, [], ("n",), "n")
    assert find_contradictions(logs, fleet) == []
    (one,) = find_contradictions([*logs, surge(6, 0.3)], fleet)
    assert one.text.startswith("run_6")


def test_rank_hypotheses_with_linked_rudders_names_both() -> None:
    fleet = drawn("boat", _SEED, _COUNT)[0]
    logs = []
    for number, log in enumerate(fleet.logs):
        rudders = dict.fromkeys(
            ("delta", "delta_stbd"), log["delta"] * (-1.0 if number == 2 else 1.0)
        )
        units = {**log.units, "delta_stbd": "rad"}
        logs.append(log.replace(channels={**log.channels, **rudders}, units=units))
    (one,) = inspect_log_set(logs, (*fleet.inputs, "delta_stbd")).find_by_code("contradicts_sign")
    assert one.text.startswith(logs[2].name)
    assert "delta and delta_stbd would have to have the opposite sign" in one.text


@pytest.mark.parametrize("name", ["azimuth", "delta"])
def test_is_only_extrapolating_with_new_inputs_gives_a_note(name: str) -> None:
    """A thruster turns round once where it had not; a rudder stalls at angles not held before."""
    random = np.random.default_rng(4)
    t = np.arange(0.0, 240.0, 0.5)
    logs = []
    for number in range(8):
        angle = np.repeat(random.uniform(-0.35, 0.35, t.size // 20), 20)
        if number == 7:
            angle = 0.05 * t if name == "azimuth" else np.where(t < 20.0, 0.2, 1.2)
        n = np.repeat(random.uniform(1.0, 3.0, t.size // 40), 40)
        lift = np.sin(angle) if name == "azimuth" else np.minimum(angle, 0.4)
        u, v, r = motion = np.zeros((3, t.size))
        for k in range(t.size - 1):
            thrust = 0.02 * n[k] ** 2
            drag = np.hypot(u[k], v[k])
            u[k + 1] = u[k] + thrust * np.cos(angle[k]) - 0.1 * u[k] * drag
            v[k + 1] = v[k] + thrust * lift[k] - 0.2 * v[k] * drag
            r[k + 1] = 0.9 * r[k] - 0.3 * thrust * lift[k]
        motion += 0.003 * random.standard_normal(motion.shape)
        logs.append(Log(f"run_{number}", t, {"u": u, "v": v, "r": r, "n": n, name: angle}))
    fleet = Fleet("ferry", logs, [], ("n", name), name)
    assert [one.text for one in find_contradictions(logs, fleet)] == []
    beyond = inspect_log_set(logs, fleet.inputs)
    assert [one.level for one in beyond.find_by_code("beyond_others")] == ["note"]


def test_find_dead_steering_in_gusts_reports_nothing(fleets: list[Fleet]) -> None:
    fleet = fleets[0]
    random = np.random.default_rng(5)
    logs = []
    for log in fleet.logs:
        # the heading is kept by hand within some degrees of the course
        gusts = np.convolve(random.normal(size=len(log) + 200), np.ones(201) / 201.0, "valid")
        psi = np.radians(4.0) * gusts / gusts.std()
        level = {name: np.full(len(log), float(np.median(log[name]))) for name in fleet.inputs}
        way = {"psi": psi, "r": np.gradient(psi, log.t), "v": 0.0 * psi}
        logs.append(log.replace(channels={**log.channels, **level, **way}))
    assert [
        one.text for one in find_contradictions(logs, fleet) if one.code == "contradicts_dead"
    ] == []


def test_find_consensus_ignores_a_log_of_one_sample(fleets: list[Fleet]) -> None:
    fleet = fleets[0]
    short = fleet.logs[0].select_rows(slice(1)).replace(name="short")
    assert find_contradictions([short, *fleet.logs], fleet) == find_contradictions(
        fleet.logs, fleet
    )


@pytest.mark.parametrize(("size", "speed"), [(2, 1.0), (10, 1.0), (400, 0.0)])
def test_find_consensus_ignores_short_logs_and_vessels_at_rest(size: int, speed: float) -> None:
    random = np.random.default_rng(0)
    t = 0.2 * np.arange(size)

    def log(name: str) -> Log:
        pose = {"x": speed * t, "y": 0.0 * t, "psi": 0.0 * t}
        return Log(name, t, {**pose, "delta": random.normal(0.0, 0.2, size)})

    codes = [one.code for one in inspect_log_set([log("a"), log("b"), log("c")]).findings]
    assert not any(code.startswith("contradicts") for code in codes)
