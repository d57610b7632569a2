"""Operating domain and excitation from training logs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from steered_logs import Steering, steered_log

from residnet.core.layout import SURGE_SWAY_YAW
from residnet.dynamics.domain import DomainCheck, log_domain_distance
from residnet.dynamics.domain_config import (
    MAX_TABLE_BYTES,
    OperatingDomain,
)
from residnet.identification.domain import _calibrate_limits, estimate_density, estimate_domain
from residnet.identification.excitation import assess_excitation
from residnet.physics.signals_config import SignalsConfig

STATES = ("x", "y", "psi", "u", "v", "r")


def prepared(log: Any, names: tuple[str, ...], **added: np.ndarray) -> Any:
    """A prepared log with what the domain reads."""
    channels = {**log.channels, **added}
    y = np.stack([channels[name] for name in STATES], axis=1)
    w = np.stack([channels[name] for name in names], axis=1)
    usable = np.ones(len(y), dtype=bool)
    return SimpleNamespace(y=y, smoothed=y, w=w, usable=usable, dof=SURGE_SWAY_YAW)


def flagged(domain: OperatingDomain, log: Any, names: tuple[str, ...]) -> float:
    """Return the share of samples outside the domain."""
    check = DomainCheck(domain, STATES, names, torch.float64)
    return float((~check(torch.from_numpy(log.y), torch.from_numpy(log.w))).double().mean())


def logs_of(steering: Steering, seeds: range, names: tuple[str, ...] = ("delta",)) -> list[Any]:
    return [prepared(steered_log(steering, seed), names) for seed in seeds]


def test_new_logs_of_the_same_kind_are_inside() -> None:
    signals = SignalsConfig(inputs=("delta",))
    domain = estimate_domain(logs_of("steps", range(6)), signals, 0.1)
    assert domain.channels == ("u", "v", "r", "delta")
    assert domain.degree == 2
    assert 8 * len(domain.factor) <= MAX_TABLE_BYTES
    shares = [flagged(domain, log, ("delta",)) for log in logs_of("steps", range(10, 16))]
    assert np.mean(shares) < 0.02


def test_ranges_have_a_margin_for_the_amplitudes_of_new_logs() -> None:
    signals = SignalsConfig(inputs=("delta",))

    def scaled_log(seed: int, amplitude: float) -> Any:
        log = steered_log("steps", seed)
        # the equation of the logs is linear, so that a scaled log is a log of another amplitude
        scaled = {name: amplitude * log.channels[name] for name in ("v", "r", "delta")}
        return prepared(log, ("delta",), **scaled)

    logs = [scaled_log(seed, a) for seed, a in enumerate((0.5, 0.6, 0.7, 0.8, 0.9, 0.8))]
    new_logs = [scaled_log(seed, a) for seed, a in enumerate((0.6, 0.97, 0.8, 1.0), start=10)]
    domain = estimate_domain(logs, signals, 0.1)
    margins = np.array([domain.range_margins[name] for name in ("u", "v", "r", "delta")])
    values = np.concatenate([np.column_stack((log.y[:, 3:], log.w)) for log in logs])
    new_values = np.concatenate([np.column_stack((log.y[:, 3:], log.w)) for log in new_logs])

    def share_beyond(margin: np.ndarray) -> float:
        lower = values.min(axis=0) - margin
        upper = values.max(axis=0) + margin
        return float(((new_values < lower) | (new_values > upper)).any(axis=1).mean())

    assert share_beyond(np.zeros(4)) > 0.02
    assert share_beyond(margins) < 0.005
    # the margin is no licence to extrapolate
    assert np.all(margins <= 0.75 * values.std(axis=0) + 1e-9)
    assert np.mean([flagged(domain, log, ("delta",)) for log in new_logs]) < 0.02


def test_the_log_distance_compares_with_the_training_data() -> None:
    signals = SignalsConfig(inputs=("delta",))
    logs = logs_of("steps", range(6))
    density = estimate_density(logs, signals)
    domain = estimate_domain(logs, signals, 0.1)
    assert (density.channels, density.factor) == (domain.channels, domain.factor)

    def distance(log: Any, amplitude: float) -> np.ndarray:
        y = log.y.copy()
        y[:, 4:] *= amplitude
        values = log_domain_distance(density, y, amplitude * log.w, STATES, ("delta",))
        assert values is not None
        return values

    # without the ridge the mean of q over the training data is the number of monomials; the ridge
    # removes the directions in which the speed, which hardly varies here, is collinear
    mean_square = np.mean([np.exp(2.0 * distance(log, 1.0)).mean() for log in logs])
    assert 0.8 < mean_square <= 1.0
    for log in logs_of("steps", range(10, 14)):
        assert distance(log, 1.0).mean() < 0.2
        assert distance(log, 4.0).mean() > 1.0
    assert log_domain_distance(OperatingDomain(n_logs=1), log.y, log.w, STATES, ("delta",)) is None


def test_limits_from_few_unlike_logs_hold_for_new_logs() -> None:
    random = np.random.default_rng(3)

    def draw_scores(n_logs: int) -> list[np.ndarray]:
        scales = np.exp(0.4 * random.standard_normal(n_logs))
        return [scale * np.abs(random.standard_normal(200)) for scale in scales]

    flagged_shares = []
    for _ in range(60):
        (limit,), _ = _calibrate_limits([draw_scores(8)], [1e-9], [np.inf])
        flagged_shares.append(np.mean([score > limit for score in draw_scores(20)]))
    # limits at the quantile of the eight logs themselves flag 1.3 % of the samples of new logs
    assert 0.005 < np.mean(flagged_shares) < 0.011


def test_a_log_of_another_kind_does_not_widen_the_domain() -> None:
    signals = SignalsConfig(inputs=("delta",))
    logs = logs_of("steps", range(5))
    domain = estimate_domain(logs, signals, 0.1)
    # a log at twice the speed, which no other log explains
    fast = logs_of("steps", range(5, 6))[0]
    fast.y[:, 3] *= 2.0
    mixed = estimate_domain([*logs, fast], signals, 0.1)
    n_features = round(len(mixed.factor) ** 0.5)
    # Markov's inequality: at most this for the distribution of the training logs itself
    assert mixed.limit <= n_features / 0.008 + 1e-6
    assert mixed.false_flags > domain.false_flags
    new_logs = logs_of("steps", range(10, 14))
    assert np.mean([flagged(mixed, log, ("delta",)) for log in new_logs]) < 0.02


def test_open_loop_is_outside_of_logs_of_a_controller() -> None:
    signals = SignalsConfig(inputs=("delta",))
    domain = estimate_domain(logs_of("controller", range(6)), signals, 0.1)
    assert [one.kind for one in domain.relations] == ["feedback"]
    same = [flagged(domain, log, ("delta",)) for log in logs_of("controller", range(10, 14))]
    assert np.mean(same) < 0.03
    driven = [flagged(domain, log, ("delta",)) for log in logs_of("steps", range(4))]
    assert np.mean(driven) > 0.9


def test_inputs_that_were_held_or_alike_have_a_relation() -> None:
    random = np.random.default_rng(0)
    names = ("n_port", "delta", "n_stbd", "trim")
    signals = SignalsConfig(inputs=("n_port", "delta"), unexcited=("n_stbd", "trim"))
    logs = []
    for seed in range(4):
        log = steered_log("steps", seed)
        n = np.repeat(random.uniform(6, 14, 30), 100)
        logs.append(prepared(log, names, n_port=n, n_stbd=n, trim=np.full(3000, 0.1)))
    domain = estimate_domain(logs, signals, 0.1)
    assert [(one.input, one.kind) for one in domain.relations] == [
        ("n_stbd", "proportional"),
        ("trim", "held"),
    ]
    assert flagged(domain, logs[0], names) < 0.02
    turned = prepared(
        steered_log("steps", 0),
        names,
        n_port=logs[0].w[:, 0],
        n_stbd=logs[0].w[:, 0] + 2.0,
        trim=np.full(3000, 0.1),
    )
    assert flagged(domain, turned, names) == 1.0
    file = assess_excitation({"train": logs}, signals, 0.1, domain, "test")
    assert {row.name: row.state for row in file.inputs} == {
        "n_port": "excited",
        "delta": "excited",
    }
    assert [row.text for row in file.directions if not row.is_excited] == [
        "differential thrust of n_port and n_stbd: not excited"
    ]


def test_collinear_inputs_have_a_relation() -> None:
    random = np.random.default_rng(0)
    names = ("n_port", "n_stbd", "delta")
    signals = SignalsConfig(inputs=names)
    logs = []
    for seed in range(5):
        n = np.repeat(random.uniform(6, 14, 30), 100)
        log = steered_log("steps", seed)
        n_port = n + 0.05 * random.standard_normal(3000)
        logs.append(prepared(log, names, n_port=n_port, n_stbd=n))
    domain = estimate_domain(logs[:4], signals, 0.1)
    assert [(one.input, one.channels) for one in domain.relations] == [("n_stbd", ("n_port",))]
    assert flagged(domain, logs[4], names) < 0.02
    apart = prepared(
        steered_log("steps", 4), names, n_port=logs[4].w[:, 0], n_stbd=logs[4].w[:, 0] - 0.5
    )
    assert flagged(domain, apart, names) > 0.95


def test_inputs_without_excitation_have_a_state() -> None:
    random = np.random.default_rng(0)
    names = ("n", "n_copy", "trim", "delta")
    logs = []
    for seed in range(4):
        n = np.repeat(random.uniform(6, 14, 30), 100)
        noisy = n + 0.01 * random.standard_normal(3000)
        log = steered_log("controller", seed)
        logs.append(prepared(log, names, n=n, n_copy=noisy, trim=np.full(3000, 0.1)))
    signals = SignalsConfig(inputs=names)
    file = assess_excitation({"train": logs, "test": logs}, signals, 0.1, None, "test")
    assert {row.name: row.state for row in file.inputs} == {
        "n": "collinear",
        "n_copy": "collinear",
        "trim": "held",
        "delta": "feedback",
    }
    assert file.closed_loop_test_inputs == ("delta",)
