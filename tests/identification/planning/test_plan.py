"""The next trial: what a refit has left open, what a run would tell, and the choice."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_system import LINEAR, SCALES, STEP, model_of, trials

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import DataError, UsageError
from residnet.dynamics.store import ModelSpec
from residnet.identification.fitter import FittedModel
from residnet.identification.planning import (
    PredictionGoal,
    TrialLimits,
    TrialPlan,
    compute_expected_uncertainty,
    compute_volume_gain,
    infer_input_shares,
    plan_trials,
    update_covariance,
)
from residnet.manoeuvres.input_shares import InputShare
from residnet.manoeuvres.open_loop import ConstantInput
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import compute_training_ranges
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.training.left_out import RefitUncertainty, estimate_refit_covariance
from residnet.training.refit import refit
from residnet.training.refit_config import RefitConfig

CONFIG = RefitConfig(horizon=4.0, every=4.0, iterations=3)
SHARES = {"tau_x": InputShare(drive=1.0), "tau_n": InputShare(steer=0.3)}


@pytest.fixture(scope="module")
def known() -> tuple[FittedModel, RefitUncertainty, torch.Tensor]:
    logs = trials()[:3]
    model = model_of(LINEAR)
    given = make_samples(logs, model.signals)
    store = WindowStore.from_logs(logs, torch.float64)
    RegressorsConfig(terms=tuple(LINEAR)).fit_preferred(model.baseline, given)
    refitted = refit(model, given, store, CONFIG, SCALES)
    low, high = compute_training_ranges(logs)
    spec = ModelSpec(
        name="baseline",
        role="baseline",
        signals=SignalsConfig(inputs=("tau_x", "tau_n")),
        baseline=RegressorsConfig(terms=tuple(LINEAR)),
        dt=STEP,
        integrator=model.integrator,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
    )
    open_ = estimate_refit_covariance(
        model, given, store, CONFIG, SCALES, refitted.notes["at_rest"]
    )
    return FittedModel(spec, model, {}), open_, refitted.covariance


def planned(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
    limits: TrialLimits,
    aim: PredictionGoal | None = None,
) -> TrialPlan:
    fitted, open_, _ = known
    return plan_trials(
        fitted, open_, CONFIG, SCALES.numpy(), SHARES, np.full(3, 100.0), limits, aim
    )


def test_a_look_back_finds_the_covariance_of_the_refit(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
) -> None:
    _, open_, covariance = known
    # the prior, which knows how far least squares were off, is not quite what it was
    errors, wanted = (part.diagonal().sqrt() for part in (open_.covariance, covariance))
    torch.testing.assert_close(errors, wanted, rtol=0.25, atol=1e-9)


def test_information_adds_to_what_is_known() -> None:
    random = torch.Generator().manual_seed(0)
    a, b = (torch.randn(4, 4, generator=random, dtype=torch.float64) for _ in range(2))
    covariance = torch.linalg.inv(a @ a.T)
    told = b @ b.T
    torch.testing.assert_close(
        update_covariance(covariance, told), torch.linalg.inv(a @ a.T + told)
    )
    wanted = 0.5 * (torch.logdet(a @ a.T + told) - torch.logdet(a @ a.T))
    assert compute_volume_gain(covariance, told) == pytest.approx(float(wanted))
    assert compute_expected_uncertainty(covariance, told) == pytest.approx(
        float((told @ covariance).trace().sqrt())
    )


def test_trials_are_chosen_for_what_is_to_be_predicted(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
) -> None:
    straight = ConstantInput(name="straight", drive=1.0, steer=0.0, duration=8.0)
    turning = ConstantInput(name="turning", drive=0.4, steer=1.0, duration=8.0)
    limits = TrialLimits(time=8.0, count=1)
    found = {
        one.name: {
            trial.simulated_run.true_log.name: trial.uncertainty_reduction
            for trial in planned(known, limits, PredictionGoal([one], 8.0, {"u": 0.5})).candidates
        }
        for one in (straight, turning)
    }
    # changes of speed tell about straight runs, and little about turns
    assert found["straight"]["speed_changes"] > 1.5 * found["turning"]["speed_changes"]


def test_trials_are_chosen_within_the_limits_and_narrow_the_intervals(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
) -> None:
    found = planned(known, TrialLimits(time=8.0, count=2))
    assert len(found.selected_trials) == 2
    assert (
        0.0
        < max(trial.uncertainty_reduction for trial in found.selected_trials)
        < found.uncertainty_reduction
        < 1.0
    )
    reach = float(np.median([trial.max_distance for trial in found.candidates]))
    near = planned(known, TrialLimits(time=8.0, area=reach, count=2))
    assert all(trial.max_distance <= reach for trial in near.candidates)
    assert len(near.candidates) < len(found.candidates)
    with pytest.raises(DataError, match="stays within the limits"):
        planned(known, TrialLimits(time=8.0, area=1e-6))


def test_inputs_that_steer_are_known_by_unit_or_side(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
) -> None:
    spec = known[0].spec
    assert infer_input_shares(spec)["tau_n"].steer == max(map(abs, spec.ranges["tau_n"]))
    twin = spec.model_copy(update={"signals": SignalsConfig(inputs=("n_port", "n_stbd"))})
    shares = infer_input_shares(twin)
    assert float(shares["n_port"].steer) > 0 > float(shares["n_stbd"].steer)
    short = {"low": spec.low[:4], "high": spec.high[:4]}
    single = spec.model_copy(update={"signals": SignalsConfig(inputs=("n",)), **short})
    with pytest.raises(UsageError, match="recognised as a steering input"):
        infer_input_shares(single)


def test_manoeuvres_too_short_to_tell_anything_are_refused(
    known: tuple[FittedModel, RefitUncertainty, torch.Tensor],
) -> None:
    short = ConstantInput(name="short", drive=1.0, steer=0.0, duration=1.0)
    with pytest.raises(DataError, match="cannot simulate them"):
        planned(known, TrialLimits(time=8.0, count=1), PredictionGoal([short], 1.0, {}))
