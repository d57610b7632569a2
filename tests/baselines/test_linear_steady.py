"""The linear baseline of document 003: a linear system is found exactly, with its steady states."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from residnet.baselines.steering import LinearSteadyConfig
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.regression.estimator import Coefficient

NAMES = ("u", "v", "r", "tau_x", "tau_n")
# (33), (34) in SI (correction W11), the steering row with B = -A Phi
A = np.array([[-1.3191, 0, 0], [0, 0.0161, -0.2979], [0, 0.14462, -0.9860]])
PHI = np.array([[0.0028 / 1.3191, 0], [0, 2.23e-4], [0, 5.76e-4]])
BIAS = np.array([0.6836 / 1.3191, 0.002, 0.0225])
B, C = -A @ PHI, -A @ BIAS


def trials(settled: float = 400.0, noise: float = 0.0) -> Samples:
    """Exact runs of the linear system: five constant inputs, two of each dynamic kind."""
    rng = np.random.default_rng(0)
    parts: list[tuple[str, np.ndarray]] = []
    dt, steps = 0.5, 1000
    time = dt * np.arange(steps)
    for k in range(5):
        parts.append(("constant", np.tile([100.0 + 120 * k, -200 + 90.0 * k], (steps, 1))))
    for k in range(2):
        square = np.sign(np.sin(2 * np.pi * time / (20 + 7 * k)))
        parts.append(("zigzag", np.stack((np.full(steps, 300.0), 250 * square), axis=1)))
        parts.append(
            (
                "three_two_one_one",
                np.stack(
                    (np.full(steps, 200.0), 150 * np.sign(np.sin(0.9 * time + k**2) + 0.3)), axis=1
                ),
            )
        )
        parts.append(
            ("acceleration_deceleration", np.stack((300 + 200 * square, np.zeros(steps)), axis=1))
        )
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:5], block[:3, 5] = A, B, C
    step = expm(block * dt)
    z, target, group, t = [], [], [], []
    for number, (_, tau) in enumerate(parts):
        nu = np.zeros((steps, 3))
        for k in range(steps - 1):
            nu[k + 1] = (step @ np.concatenate((nu[k], tau[k], [1.0])))[:3]
        z.append(np.concatenate((nu, tau), axis=1))
        target.append(nu @ A.T + tau @ B.T + C + noise * rng.normal(size=nu.shape))
        group.append(np.full(steps, number))
        t.append(time)
    joined = (torch.from_numpy(np.concatenate(part)) for part in (z, target, group, t))
    x, y, groups, times = joined
    return Samples(x, y, groups, times, tuple(kind for kind, _ in parts), NAMES)


def by_name(table: list[Coefficient]) -> dict[tuple[str, str], float]:
    return {(entry.axis[0], entry.term): entry.value for entry in table}


def test_a_linear_system_is_found_exactly() -> None:
    config = LinearSteadyConfig(settled=400.0)
    baseline = config.build(NAMES)
    found = by_name(config.fit(baseline, trials()))
    truth = {("u", "u"): A[0, 0], ("u", "tau_x"): B[0, 0], ("u", "1"): C[0]}
    for i, axis in ((1, "v"), (2, "r")):
        truth |= {
            (axis, "v"): A[i, 1],
            (axis, "r"): A[i, 2],
            (axis, "tau_n"): B[i, 1],
            (axis, "1"): C[i],
        }
    assert set(found) == set(truth)
    for key, value in truth.items():
        assert found[key] == pytest.approx(value, rel=1e-4, abs=1e-8), key
    z = torch.from_numpy(np.random.default_rng(1).normal(size=(20, 5)) * [1, 0.3, 0.3, 300, 200])
    np.testing.assert_allclose(
        baseline(z), z[:, :3].numpy() @ A.T + z[:, 3:].numpy() @ B.T + C, rtol=1e-4, atol=1e-6
    )


def test_the_relation_holds_whatever_the_noise() -> None:
    """Phi comes from the steady runs alone; noise in the accelerations moves A, and B with it."""
    config = LinearSteadyConfig(settled=400.0)
    found = by_name(config.fit(config.build(NAMES), trials(noise=0.05)))
    a = np.array([[found[i, j] for j in "vr"] for i in "vr"])
    b = np.array([found[i, "tau_n"] for i in "vr"])
    np.testing.assert_allclose(np.linalg.solve(a, -b), PHI[1:, 1], rtol=1e-4)
    assert abs(a[1, 1] - A[2, 2]) > 1e-6


def test_errors_of_the_fit_cover_the_truth() -> None:
    config = LinearSteadyConfig(settled=400.0)
    for entry in config.fit(config.build(NAMES), trials(noise=0.02)):
        i = "uvr".index(entry.axis[0])
        truth = (
            C[i]
            if entry.term == "1"
            else (
                A[i, "uvr".index(entry.term)]
                if entry.term in "uvr"
                else B[i, ("tau_x", "tau_n").index(entry.term)]
            )
        )
        assert abs(entry.value - truth) < 5 * entry.error + 1e-9


def test_steady_states_and_phi_stand_in_the_notes() -> None:
    config = LinearSteadyConfig(settled=400.0)
    (solution,) = config.solutions(config.build(NAMES), trials())
    found = solution.notes["steady_constraints"]
    for axis, state in enumerate("uvr"):
        column = 0 if state == "u" else 1
        assert found[state]["phi"] == pytest.approx(PHI[axis, column], rel=1e-4)
        assert found[state]["bias"] == pytest.approx(BIAS[axis], rel=1e-4)
    steady = solution.notes["steady_states"]
    np.testing.assert_allclose(
        steady["u"], PHI[0, 0] * np.array(steady["tau_x"]) + BIAS[0], rtol=1e-5
    )


@pytest.mark.parametrize("model", ["nomoto", "nomoto_sideslip"])
def test_nomoto_keeps_the_steady_states_and_its_own_structure(model: str) -> None:
    config = LinearSteadyConfig.model_validate({"settled": 400.0, "steering_model": model})
    found = by_name(config.fit(config.build(NAMES), trials()))
    # whatever the time constant, the yaw rate settles where the constant manoeuvres did
    assert -found["r", "tau_n"] / found["r", "r"] == pytest.approx(PHI[2, 1], rel=1e-4)
    assert -found["r", "1"] / found["r", "r"] == pytest.approx(BIAS[2], rel=1e-4)
    assert ("r", "v") not in found
    if model == "nomoto":
        assert found["v", "v"] == found["r", "r"]
        assert ("v", "tau_n") not in found
    else:
        slope = PHI[1, 1] / PHI[2, 1]
        assert -found["v", "r"] / found["v", "v"] == pytest.approx(slope, rel=1e-4)
        assert ("v", "tau_n") not in found


def without(samples: Samples, kinds: tuple[str, ...]) -> Samples:
    keep = torch.tensor([kind not in kinds for kind in samples.kinds])
    return samples.where(keep[samples.group])


def test_what_is_missing_is_named() -> None:
    samples = trials()
    config = LinearSteadyConfig(settled=400.0)
    with pytest.raises(FitError, match=r"at least 3 constant-input manoeuvres.*the data have 0"):
        config.fit(config.build(NAMES), without(samples, ("constant",)))
    with pytest.raises(FitError, match="longer than 600 s"):
        LinearSteadyConfig(settled=600.0).fit(config.build(NAMES), samples)
    with pytest.raises(FitError, match="acceleration_deceleration"):
        config.fit(config.build(NAMES), without(samples, ("acceleration_deceleration",)))
    with pytest.raises(FitError, match="zigzag"):
        config.fit(config.build(NAMES), without(samples, ("zigzag", "three_two_one_one")))
