"""Offsets planted in some logs of a made vessel: a refit that looks for them finds them and the
vessel, and costs nothing where there are none.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from made_system import QUADRATIC, SCALES, SIGNALS, STEP, THETA, trials
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline, RegressorsConfig
from residnet.data.prepare import Prepared, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.zero import ZeroHead
from residnet.training.refit import RefitConfig, Refitted, refit

ROWS: dict[Literal["u", "v", "r"], tuple[str, ...]] = {
    "u": ("u", "u|u|", "tau_x"),
    "v": ("v", "r", "tau_n", "v|v|", "u r"),
    "r": ("v", "r", "tau_n", "r|r|"),
}
SPREAD, LOGS = np.array([0.0, 0.05, 0.04]), 8
# noise is white at 0.1 s, and that of the state that a window starts with lasts longer
CONFIG = {"horizon": 8.0, "every": 8.0, "prior": 0.0, "correlation": 0.2, "robust": 0.02}
BOTH = {"v": "estimated", "r": "estimated"}


def planted(seed: int) -> np.ndarray:
    """Offsets [L, 3] in sway and yaw, their mean zero."""
    drawn = np.random.default_rng([seed, 5]).normal(size=(LOGS, 3))
    return (drawn - drawn.mean(0)) / drawn.std(0) * SPREAD


def refitted(
    logs: list[Prepared], offsets: dict[str, str] | None
) -> tuple[Tensor, Tensor, Refitted]:
    """Coefficients less the vessel's own, in ROWS' order [P], their standard errors [P], and the
    refit, from least squares on.
    """
    signals = SIGNALS.build()
    baseline = RegressorBaseline(list(ROWS.values()), signals.names)
    model = HybridDynamics(signals, baseline, ZeroHead(), STEP, "heun")
    known = samples(logs, signals)
    RegressorsConfig(terms=ROWS).fit(baseline, known)
    found = refit(
        model,
        known,
        WindowStore.gather(logs, torch.float64),
        RefitConfig.model_validate(CONFIG | {"offsets": offsets}),
        SCALES,
    )
    own = torch.zeros_like(baseline.theta)
    for column, term in enumerate(baseline.library.terms):
        own[:, column] = THETA[:, QUADRATIC.index(term)]
    free = baseline.free_indices()
    return (baseline.theta.detach() - own).flatten()[free], found.errors, found


def score(error: Tensor) -> float:
    return float(error.square().mean().sqrt())


@pytest.mark.long
def test_planted_offsets_are_found_and_no_longer_spoil_the_vessel() -> None:
    offsets = planted(1)
    logs = trials(LOGS, 33.0, seed=1, offsets=offsets)
    blind, claimed, _ = refitted(logs, None)
    error, standard, found = refitted(logs, BOTH)
    assert score(error) < 0.15 * score(blind), (score(error), score(blind))
    # the blind refit is sure of itself where it is wrong
    assert score(blind / claimed) > 3.0 > 2.0 > score(error / standard)
    assert found.offsets.axes == (1, 2)
    here = torch.from_numpy(offsets[:, 1:]) * found.offsets.speed**2
    apart = found.offsets.value - here
    assert float((apart / found.offsets.error).abs().max()) < 3.0
    assert score(apart) < 0.1 * score(here)
    np.testing.assert_allclose(
        found.offsets.spread.numpy(), SPREAD[1:] * found.offsets.speed**2, rtol=0.15
    )


@pytest.mark.long
def test_without_offsets_looking_for_them_costs_nothing() -> None:
    logs = trials(LOGS, 33.0, seed=2)
    blind, _, none = refitted(logs, None)
    error, _, found = refitted(logs, BOTH)
    assert score(error) < 1.15 * score(blind)
    assert (
        float(
            (found.offsets.spread / (torch.from_numpy(SPREAD[1:]) * found.offsets.speed**2)).max()
        )
        < 0.1
    )
    assert none.offsets.axes == ()
    assert none.offsets.value.shape == (LOGS, 0)


@pytest.mark.long
def test_standard_errors_are_those_of_repeated_trials() -> None:
    """Five sets of trials: errors in units of their standard errors are of the size of one."""
    ratios = []
    for seed in range(3, 8):
        error, standard, _ = refitted(trials(LOGS, 33.0, seed=seed, offsets=planted(seed)), BOTH)
        ratios.append(error / standard)
    assert 0.6 < score(torch.cat(ratios)) < 1.6
    assert float((torch.cat(ratios).abs() < 2.0).double().mean()) > 0.85


def test_spreads_that_are_given_hold_offsets_near_zero() -> None:
    logs = trials(LOGS, 33.0, seed=1, offsets=planted(1))
    _, _, found = refitted(logs, {"r": "0.001 deg/s^2"})
    assert found.offsets.axes == (2,)
    assert float(found.offsets.value.abs().max()) < 1e-4
    assert float(found.offsets.spread[0]) == pytest.approx(np.radians(0.001))
