"""The linear baseline of document 003: a linear system is found exactly, with its steady states."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_samples import sampled
from scipy.linalg import expm

from residnet.baselines.steering_config import LinearSteadyConfig
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.regression.estimator import Coefficient

NAMES = ("u", "v", "r", "tau_x", "tau_n")
# (33), (34) in SI (correction W11), the steering row with B = -A Phi
A = np.array([[-1.3191, 0, 0], [0, 0.0161, -0.2979], [0, 0.14462, -0.9860]])
PHI = np.array([[0.0028 / 1.3191, 0], [0, 2.23e-4], [0, 5.76e-4]])
BIAS = np.array([0.6836 / 1.3191, 0.002, 0.0225])
B, C = -A @ PHI, -A @ BIAS


def trials(noise: float = 0.0) -> Samples:
    """Exact runs of the linear system: five constant inputs, two of each dynamic kind."""
    rng = np.random.default_rng(0)
    dt = 0.5
    steps = 1000
    time = dt * np.arange(steps)
    one = np.ones(steps)
    # forces [2, T] of each
    parts = [("constant", ((100.0 + 120 * k) * one, (-200 + 90.0 * k) * one)) for k in range(5)]
    for k in range(2):
        square = np.sign(np.sin(2 * np.pi * time / (20 + 7 * k)))
        shaped = np.sign(np.sin(0.9 * time + k**2) + 0.3)
        parts += [
            ("zigzag", (300 * one, 250 * square)),
            ("three_two_one_one", (200 * one, 150 * shaped)),
            ("acceleration_deceleration", (300 + 200 * square, 0 * one)),
        ]
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:5], block[:3, 5] = A, B, C
    step = expm(block * dt)
    z = []
    target = []
    for _, forces in parts:
        tau, nu = np.stack(forces, axis=1), np.zeros((steps, 3))
        for k in range(steps - 1):
            nu[k + 1] = (step @ np.concatenate((nu[k], tau[k], [1.0])))[:3]
        z.append(np.concatenate((nu, tau), axis=1))
        target.append(nu @ A.T + tau @ B.T + C + noise * rng.normal(size=nu.shape))
    kinds = [kind for kind, _ in parts]
    t = np.tile(time, len(parts))
    whole = np.concatenate(z), np.concatenate(target)
    return sampled(*whole, NAMES, groups=len(parts), t=t, kinds=kinds)


def by_name(table: list[Coefficient]) -> dict[tuple[str, str], float]:
    return {(entry.axis[0], entry.term): entry.value for entry in table}


CONFIG = LinearSteadyConfig(settled=400.0)
TRUTH = {("u", "u"): A[0, 0], ("u", "tau_x"): B[0, 0], ("u", "1"): C[0]}
for i, axis in ((1, "v"), (2, "r")):
    columns = {"v": A[i, 1], "r": A[i, 2], "tau_n": B[i, 1], "1": C[i]}
    TRUTH |= {(axis, term): value for term, value in columns.items()}


def test_a_linear_system_is_found_exactly_with_its_steady_states() -> None:
    baseline = CONFIG.build(NAMES)
    found = by_name(CONFIG.fit_preferred(baseline, trials()))
    assert found == {key: pytest.approx(value, 1e-4, 1e-8) for key, value in TRUTH.items()}
    z = torch.from_numpy(np.random.default_rng(1).normal(size=(20, 5)) * [1, 0.3, 0.3, 300, 200])
    wanted = z[:, :3].numpy() @ A.T + z[:, 3:].numpy() @ B.T + C
    np.testing.assert_allclose(baseline(z), wanted, rtol=1e-4, atol=1e-6)
    (solution,) = CONFIG.fit_solutions(baseline, trials())
    constraints = solution.notes["steady_constraints"]
    for axis, (state, column) in enumerate((("u", 0), ("v", 1), ("r", 1))):
        assert constraints[state]["phi"] == pytest.approx(PHI[axis, column], rel=1e-4)
        assert constraints[state]["bias"] == pytest.approx(BIAS[axis], rel=1e-4)
    steady = solution.notes["steady_states"]
    surge = PHI[0, 0] * np.array(steady["tau_x"]) + BIAS[0]
    np.testing.assert_allclose(steady["u"], surge, rtol=1e-5)


def test_the_relation_holds_whatever_the_noise_and_errors_cover_the_truth() -> None:
    """Phi comes from the steady runs alone; noise in the accelerations moves A, and B with it."""
    table = CONFIG.fit_preferred(CONFIG.build(NAMES), trials(noise=0.05))
    found = by_name(table)
    a = np.array([[found[i, j] for j in "vr"] for i in "vr"])
    b = np.array([found[i, "tau_n"] for i in "vr"])
    np.testing.assert_allclose(np.linalg.solve(a, -b), PHI[1:, 1], rtol=1e-4)
    assert abs(a[1, 1] - A[2, 2]) > 1e-6
    for entry in table:
        off = abs(entry.value - TRUTH[entry.axis[0], entry.term])
        assert off < 5 * entry.standard_error + 1e-9


@pytest.mark.parametrize("model", ["nomoto", "nomoto_sideslip"])
def test_nomoto_keeps_the_steady_states_and_its_own_structure(model: str) -> None:
    config = LinearSteadyConfig.model_validate({"settled": 400.0, "steering_model": model})
    found = by_name(config.fit_preferred(config.build(NAMES), trials()))
    # whatever the time constant, the yaw rate settles where the constant manoeuvres did
    assert -found["r", "tau_n"] / found["r", "r"] == pytest.approx(PHI[2, 1], rel=1e-4)
    assert -found["r", "1"] / found["r", "r"] == pytest.approx(BIAS[2], rel=1e-4)
    assert ("r", "v") not in found
    assert ("v", "tau_n") not in found
    if model == "nomoto":
        assert found["v", "v"] == found["r", "r"]
    else:
        slope = PHI[1, 1] / PHI[2, 1]
        assert -found["v", "r"] / found["v", "v"] == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(
    ("left_out", "settled", "message"),
    [
        (("constant",), 400, r"at least 3 constant-input manoeuvres.*the data have 0"),
        ((), 600, "longer than 600 s"),
        (("acceleration_deceleration",), 400, "acceleration_deceleration"),
        (("zigzag", "three_two_one_one"), 400, "zigzag"),
    ],
)
def test_what_is_missing_is_named(left_out: tuple[str, ...], settled: float, message: str) -> None:
    samples = trials()
    config = LinearSteadyConfig(settled=settled)
    keep = torch.tensor([kind not in left_out for kind in samples.kinds])
    with pytest.raises(FitError, match=message):
        config.fit_preferred(config.build(NAMES), samples.select(keep[samples.group]))
