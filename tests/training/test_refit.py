"""The refit through rollouts: what it gains over least squares, its gradient and its errors."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, get_args

import numpy as np
import pytest
import torch
from made_system import (
    LINEAR,
    QUADRATIC,
    SCALES,
    STEP,
    free_run_error,
    inputs,
    model_of,
    trials,
)
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import DataError, FitError, ResidnetError
from residnet.core.layout import HEADING
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.time_steps import Integrator
from residnet.engine.rollout import Rollout
from residnet.heads.base import ZeroHead
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.training import refit as module
from residnet.training.left_out import PriorMeans, estimate_leave_one_out
from residnet.training.refit import Problem, refit, sensitivities
from residnet.training.refit_config import RefitConfig


def fitted(
    terms: Sequence[str], logs: Sequence[PreparedLog]
) -> tuple[HybridDynamics, Samples, WindowStore]:
    """Least squares on derivatives."""
    model = model_of(terms)
    known = make_samples(logs, model.signals)
    RegressorsConfig(terms=tuple(terms)).fit_preferred(model.baseline, known)
    return model, known, WindowStore.from_logs(logs, torch.float64)


def theta_of(model: HybridDynamics) -> Tensor:
    assert isinstance(model.baseline, RegressorBaseline)
    return model.baseline.theta


@pytest.fixture(scope="module")
def smoothed() -> Sequence[PreparedLog]:
    """Derivatives over 3 s of motions that take one: least squares finds the vessel too slow."""
    return trials(window=3.1)


ROLLS = ("u", "v", "r", "p")


def windy(
    integrator: Integrator = "rk4", velocities: tuple[str, ...] = ROLLS[:3]
) -> tuple[HybridDynamics, Problem]:
    """A model in true wind, whose heading matters to it, and windows with samples that do not
    count; everything moved off its start.
    """
    signals = SignalsConfig.model_validate(
        {
            "inputs": ("tau_x", "tau_n"),
            "exogenous": ("wind_speed", "wind_dir"),
            "velocities": velocities,
        }
    ).build()
    n = signals.n_dof
    rows = [
        ("1", "u", "u|u|", "tau_x", "wind_u"),
        ("v", "u r", "wind_v wind_mag"),
        ("r", "v", "r|r|", "tau_n", "wind_v wind_mag"),
        *[("p", "phi", "v", "u|u| phi"), ()][: n - 3],
    ]
    baseline = RegressorBaseline(rows, signals.names)
    random = np.random.default_rng(5)
    baseline.theta.data.copy_(
        torch.from_numpy(random.normal(size=tuple(baseline.theta.shape)) * 0.1)
    )
    with torch.no_grad():
        for axis, name in enumerate(velocities):
            baseline.theta[axis, baseline.library.terms.index(name)] = -0.7
    model = HybridDynamics(signals, baseline, ZeroHead(signals.names), STEP, integrator)
    active = torch.nonzero(baseline.term_mask.flatten() > 0).squeeze(1)
    batch = 5
    steps = 25
    count = len(active)
    wind = torch.from_numpy(random.uniform([2, -3], [6, 3], size=(batch, 1, 2))).expand(
        -1, steps, -1
    )
    usable = torch.from_numpy(random.random((batch, steps, 1)) < 0.8).double()
    half = torch.from_numpy(random.normal(size=(count, count)))
    problem = Problem(
        x0=torch.from_numpy(random.normal(size=(batch, 3 + n)) * [5, 5, 1, 0.5, *[0.2] * (n - 1)]),
        inputs=torch.cat((inputs(batch, steps, 6), wind), dim=-1),
        measured=torch.from_numpy(random.normal(size=(batch, steps, n)) * 0.3),
        weight=torch.cat((usable, usable, *[torch.ones_like(usable)] * (n - 2)), dim=-1)
        / torch.cat((SCALES, SCALES.new_full((n - 3,), 0.2))),
        precision=0.01 * half @ half.T,
        regularisation=torch.zeros(count, count, dtype=torch.float64),
        prior_mean=torch.from_numpy(random.normal(size=count) * 0.1),
        symmetry=torch.diag(torch.from_numpy(random.uniform(0, 0.1, size=count))),
        fixed=torch.zeros(count, dtype=torch.bool),
        free=active,
        belief_mean=torch.from_numpy(random.normal(size=count) * 0.1),
        belief_precision=torch.from_numpy(random.uniform(0, 50, size=count)),
        independent_errors=7.0,
        robust=0.05,
        log_index=torch.tensor([0, 0, 1, 3, 3]),
    )
    return model, problem


LEVEL = torch.tensor(0.3, dtype=torch.float64)


def with_step(model: HybridDynamics, problem: Problem, place: int, step: float) -> float:
    """Cost with one coefficient moved."""
    other = copy.deepcopy(model)
    assert isinstance(other.baseline, RegressorBaseline)
    with torch.no_grad():
        other.baseline.theta.view(-1)[problem.free[place]] += step
        values = other.baseline.theta.flatten()[problem.free]
        known = problem.prior_cost(values, problem.cost_per_nat(LEVEL))
    return float(module.simulate(other, problem)[0] + known)


@pytest.mark.parametrize("integrator", get_args(Integrator))
def test_sensitivities_equal_central_differences(integrator: Integrator) -> None:
    """Central differences of the one time loop, heading included: the wind makes it matter."""
    model, problem = windy(integrator, ROLLS)
    assert isinstance(model.baseline, RegressorBaseline)
    theta = model.baseline.theta.data.view(-1)
    count = len(problem.free)
    memory = model.initial_state(len(problem.x0)).double()

    def rolled(place: int, change: float) -> Tensor:
        theta[problem.free[place]] += change
        states, _, _ = Rollout(model)(problem.x0, problem.inputs, memory)
        theta[problem.free[place]] -= change
        return states

    def moved(place: int, change: float) -> Tensor:
        x0 = problem.x0.clone()
        x0[:, HEADING + place] += change
        return Rollout(model)(x0, problem.inputs, memory)[0]

    with torch.no_grad():
        states = rolled(0, 0.0)
        *_, (_, last) = sensitivities(model, states[:, :-1], problem.inputs)
        found = last[-1]
        for place in range(count):
            central = (rolled(place, 1e-5) - rolled(place, -1e-5))[:, -1, HEADING:] / 2e-5
            torch.testing.assert_close(found[:, :, place], central, rtol=1e-6, atol=1e-8)
        run = moved(0, 0.0)[:, :-1]
    whole = sensitivities(model, run, problem.inputs, to_start=True)
    to_start = torch.cat([part for _, part in whole]).transpose(0, 1).detach()
    with torch.no_grad():
        for place in range(1 + model.dof):
            central = (moved(place, 1e-5) - moved(place, -1e-5))[:, 1:, HEADING:] / 2e-5
            torch.testing.assert_close(to_start[..., place], central, rtol=1e-6, atol=1e-8)


def test_refit_with_estimated_starts_reduces_bias_of_noise() -> None:
    """Free runs from exact starts, of models refitted to free runs from noisy ones."""
    logs = trials(count=8, noise=0.06)
    off = {}
    for starts in ("measured", "estimated"):
        model, known, store = fitted(QUADRATIC, logs)
        content = {"horizon": 4.0, "every": 4.0, "prior": 0.0, "starts": starts}
        refit(model, known, store, RefitConfig.model_validate(content), SCALES)
        off[starts] = free_run_error(model)
    assert off["estimated"] < 0.7 * off["measured"]


def normal_equations(model: HybridDynamics, problem: Problem) -> tuple[Tensor, Tensor]:
    assert isinstance(model.baseline, RegressorBaseline)
    squares = module.simulate(model, problem)[1]
    return module.normal_equations(model, problem, LEVEL, squares)


def test_normal_equations_gradient_is_half_that_of_the_cost() -> None:
    """With m the mean square error of a window, d sqrt(m + c^2) = dm / (2 sqrt(m + c^2)); the
    prior's d (t'Pt) = 2 P t: half of both is returned.
    """
    model, problem = windy(velocities=ROLLS)
    hessian, gradient = normal_equations(model, problem)
    step = 1e-5
    central = [
        (with_step(model, problem, i, step) - with_step(model, problem, i, -step)) / (2 * step)
        for i in range(len(gradient))
    ]
    torch.testing.assert_close(
        2.0 * gradient, torch.tensor(central, dtype=torch.float64), rtol=1e-6, atol=1e-8
    )
    assert float(gradient.abs().min()) > 1e-4, "every coefficient is seen"
    torch.testing.assert_close(hessian, hessian.T)
    assert float(torch.linalg.eigvalsh(hessian)[0]) > 0


def test_normal_equations_hessian_is_half_that_of_the_cost_at_a_perfect_fit() -> None:
    """At a perfect fit without a prior Gauss-Newton is Newton."""
    model, problem = windy()
    assert isinstance(model.baseline, RegressorBaseline)
    # free runs that are compiled round otherwise than single steps
    fields = {
        **vars(problem),
        "measured": module.simulate(model, problem)[1][:, 1:, 3:],
        "precision": 0 * problem.precision,
        "symmetry": 0 * problem.symmetry,
        "belief_precision": 0 * problem.belief_precision,
    }
    perfect = Problem(**fields)
    hessian, gradient = normal_equations(model, perfect)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-14)
    step = 3e-6
    centre = with_step(model, perfect, 0, 0.0)
    assert centre == pytest.approx(problem.robust)
    for i in range(len(gradient)):
        curvature = (
            with_step(model, perfect, i, step) - 2 * centre + with_step(model, perfect, i, -step)
        ) / step**2
        assert 2.0 * float(hessian[i, i]) == pytest.approx(curvature, rel=2e-3)


def test_refit_with_symmetry_prior_removes_asymmetric_terms(
    smoothed: Sequence[PreparedLog],
) -> None:
    free, known, store = fitted(LINEAR, smoothed)
    held = copy.deepcopy(free)
    config = {"horizon": 8.0, "every": 4.0, "prior": 1e-4}
    refit(free, known, store, RefitConfig.model_validate(config), SCALES)
    refit(held, known, store, RefitConfig.model_validate(config | {"asymmetric": 1e4}), SCALES)
    # by hand: surge has no v, r, tau_n; sway and yaw have no constant, u, tau_x
    odd = torch.tensor([False, False, True, True, False, True])
    wrong = torch.stack((odd, ~odd, ~odd))
    assert float(theta_of(held)[wrong].abs().max()) < 1e-5
    assert float(theta_of(free)[wrong].abs().max()) > 1e-3
    assert float(theta_of(held)[~wrong].abs().min()) > 1e-3
    # the vessel is symmetric, so knowing it costs next to nothing
    assert free_run_error(held) < 1.2 * free_run_error(free)


@pytest.mark.parametrize(
    ("change", "error", "told"),
    [
        ("still", FitError, "needs a baseline of kind 'regressors', 'linear_steady'"),
        ({"horizon": 100.0}, DataError, "shorten the horizon or give longer logs"),
        # a raster wider than a log starts with it alone, and there nothing is known
        ({"every": 1000.0}, FitError, "no training log holds a free run of 8 s"),
        ("growing", FitError, "diverges within the refit's horizon"),
    ],
    ids=str,
)
def test_refit_refuses_unusable_data_and_models(
    smoothed: Sequence[PreparedLog], change: Any, error: type[ResidnetError], told: str
) -> None:
    model, known, store = fitted(LINEAR, smoothed)
    config = {"horizon": 8.0, "every": 4.0}
    if change == "still":
        still = ZeroBaselineConfig().build(model.signals.names)
        model = HybridDynamics(model.signals, still, ZeroHead(), STEP)
    elif change == "growing":
        config["horizon"] = 30.0
        theta_of(model).data[0, LINEAR.index("u")] = 1e6
    else:
        config |= change
    if "every" in change:
        store = dataclasses.replace(store, trainable=store.trainable & (store.n_elapsed > 0))
    with pytest.raises(error, match=told) as caught:
        refit(model, known, store, RefitConfig.model_validate(config), SCALES)
    assert "\n" not in str(caught.value)


def test_refit_of_a_diverging_start_begins_with_short_horizons(
    smoothed: Sequence[PreparedLog],
) -> None:
    model, known, store = fitted(LINEAR, smoothed)
    config = RefitConfig(horizon=4.0, every=4.0, prior=0.0)
    wanted = refit(model, known, store, config, SCALES).notes
    again, _, _ = fitted(LINEAR, smoothed)
    with torch.no_grad():
        # a yaw rate that grows beyond all numbers within the horizon
        theta_of(again)[2, LINEAR.index("r")] = 300.0
    notes = refit(again, known, store, config, SCALES).notes
    assert wanted["begun_over"] == wanted["horizon"] == pytest.approx(4.0)
    assert notes["begun_over"] < 4.0
    assert notes["cost_after"] == pytest.approx(wanted["cost_after"], rel=1e-2)
    count = 0
    for log in smoothed:
        for k in range(0, len(log) - 40, 40):
            count += bool(log.trainable[k]) and log.usable[k : k + 41].mean() >= 0.5
    assert wanted["windows"] == count > 0
    # a strong prior holds least squares
    held, _, _ = fitted(LINEAR, smoothed)
    start = theta_of(held).detach().clone()
    refit(held, known, store, config.model_copy(update={"prior": 1e9}), SCALES)
    torch.testing.assert_close(theta_of(held).detach(), start, rtol=0, atol=1e-4)


def test_estimate_leave_one_out_approximates_refits() -> None:
    logs = trials()[:4]
    config = RefitConfig(horizon=4.0, every=4.0, iterations=4, prior=1e-4)
    model = model_of(LINEAR)
    known = make_samples(logs, model.signals)
    store = WindowStore.from_logs(logs, torch.float64)
    RegressorsConfig(terms=tuple(LINEAR)).fit_preferred(model.baseline, known)
    assert isinstance(model.baseline, ParametricBaseline)
    first = model.baseline.theta.detach().clone()
    refit(model, known, store, config, SCALES)
    assert isinstance(model.baseline, ParametricBaseline)
    whole = model.baseline.theta.detach().clone()
    fold = torch.tensor([i % 2 for i in range(len(logs))])
    found = estimate_leave_one_out(model, known, store, config, SCALES, fold)
    assert len(found) == 2
    torch.testing.assert_close(model.baseline.theta.detach(), whole)
    apart = 0.0
    moved = 0.0
    for k, theta in enumerate(found):
        kept = [log for i, log in enumerate(logs) if i % 2 != k]
        other = copy.deepcopy(model)
        assert isinstance(other.baseline, ParametricBaseline)
        # its prior stands where least squares put the parameters, as that of the whole refit does
        with torch.no_grad():
            other.baseline.theta.copy_(first)
        refit(
            other,
            make_samples(kept, model.signals),
            WindowStore.from_logs(kept, torch.float64),
            config,
            SCALES,
            initial_theta=whole,
        )
        assert isinstance(other.baseline, ParametricBaseline)
        wanted = other.baseline.theta.detach()
        scale = whole.abs() + 0.1
        apart += float(((theta - wanted) / scale).square().sum())
        moved += float(((whole - wanted) / scale).square().sum())
    assert apart < 0.25 * moved


def test_estimate_leave_one_out_uses_prior_means_of_folds() -> None:
    """The least-squares solution of all logs holds a refit near the logs that are left out."""
    logs = trials(noise=0.05)[:4]
    config = RefitConfig(horizon=4.0, every=4.0, iterations=6, prior=1.0)
    model = model_of(LINEAR)
    known = make_samples(logs, model.signals)
    store = WindowStore.from_logs(logs, torch.float64)
    fold = torch.tensor([i % 2 for i in range(len(logs))])
    kept_logs = [[log for i, log in enumerate(logs) if i % 2 != k] for k in range(2)]

    def solve(kept: Sequence[PreparedLog]) -> Tensor:
        other = model_of(LINEAR)
        samples = make_samples(kept, other.signals)
        RegressorsConfig(terms=tuple(LINEAR)).fit_preferred(other.baseline, samples)
        assert isinstance(other.baseline, ParametricBaseline)
        return other.baseline.get_free().detach().clone()

    prior_means = PriorMeans(solve(logs), torch.stack([solve(kept) for kept in kept_logs]))
    assert isinstance(model.baseline, ParametricBaseline)
    model.baseline.set_free(prior_means.of_all_logs)
    refit(model, known, store, config, SCALES)
    refitted = model.baseline.get_free().detach().clone()
    arguments = (model, known, store, config, SCALES, fold)
    with_fold = estimate_leave_one_out(*arguments)
    without_fold = estimate_leave_one_out(*arguments, prior_means=prior_means)
    distances = np.zeros(2)
    for k, kept in enumerate(kept_logs):
        other = copy.deepcopy(model)
        assert isinstance(other.baseline, ParametricBaseline)
        other.baseline.set_free(prior_means.without_folds[k])
        samples = make_samples(kept, model.signals)
        refit(other, samples, WindowStore.from_logs(kept, torch.float64), config, SCALES)
        wanted = other.baseline.get_free().detach()
        scale = refitted.abs() + 0.1
        for j, thetas in enumerate((with_fold, without_fold)):
            theta = thetas[k].flatten()[model.baseline.free_indices()]
            distances[j] += float(((theta - wanted) / scale).square().sum())
    assert distances[1] < 0.25 * distances[0]
