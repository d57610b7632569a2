"""A fit in Python: its models, side by side, its solutions, and who is compared."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from tiny import TINY
from tiny_fit import logs_of, settings_of

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import DataError, FitError
from residnet.core.processes import available_cores, worker_limit
from residnet.core.progress import Progress, on_progress
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.identification import fit as parts
from residnet.identification.bands import LeaveFoldOutModels
from residnet.identification.fit import fit_models
from residnet.identification.fitter import (
    FitStore,
    FittedModel,
    Fitter,
    find_reference_names,
)
from residnet.identification.identified import (
    IdentifiedModels,
    run_teacher_forced,
)
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.samples import compute_channels, make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.regression.estimator import Solution
from residnet.training.score import Score
from residnet.training.selection import select_by_free_run


@pytest.fixture(scope="module")
def logs() -> PreparedSplits:
    return logs_of(settings_of())


def test_models_stand_in_order(
    logs: PreparedSplits, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    heard: list[Progress] = []
    with on_progress(heard.append):
        found = fit_models(logs, settings_of("heads", "ensembles", "training", bands=None))
    assert not list(tmp_path.iterdir())
    assert list(found) == ["constant_velocity", "baseline", "ridge", "lstm", "ensemble"]
    roles = [entry.spec.role for entry in found.values()]
    assert roles == ["constant_velocity", "baseline", "head", "head", "ensemble"]
    assert found.velocity_limits.shape == (3,)
    assert np.all(found.velocity_limits > 0)
    epochs = [event.done for event in heard if event.stage == "training lstm"]
    assert epochs == list(range(1, 8))


def test_an_optional_head_is_left_out_where_its_package_is_absent(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "deap", None)
    bred = {"kind": "genetic", "evolution": {"population": 10, "generations": 1}, "optional": True}
    said: list[str] = []
    with on_progress(lambda event: said.append(str(event))):
        assert list(fit_models(logs, settings_of(heads={"bred": bred}, bands=None))) == [
            "constant_velocity",
            "baseline",
        ]
    assert "bred is skipped" in " ".join(said)


def test_a_band_says_why_its_model_could_not_be_fitted_without_some_logs(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: FittedModel) -> list[HybridDynamics]:
        raise FitError("the data do not excite it")

    monkeypatch.setattr(LeaveFoldOutModels, "_fit_baseline_without_folds", refuse)
    bands = fit_models(logs, settings_of(bands={"folds": 2}))["baseline"].bands
    assert bands
    for band in bands.values():
        assert "(the data do not excite it)" in band.cautions[0]


TRAINING: dict[str, Any] = {
    "steps": 2,
    "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 1, "batch": 16}],
}


def beside(**training: Any) -> FitSettings:
    heads = {"wide": {"kind": "mlp", "hidden": [5]}, "narrow": {"kind": "mlp", "hidden": [2]}}
    return settings_of(
        refit={"baseline": {"horizon": 2.0, "iterations": 2}},
        heads={**heads, "ridge": {"kind": "ridge"}},
        training={"wide": {**TRAINING, **training}, "narrow": TRAINING},
        bands=None,
    )


@pytest.mark.long
def test_side_by_side_gives_the_same_models(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "_MIN_PARALLEL_STEPS", 1)
    settings = beside()
    alone = fit_models(logs, settings)
    heard: list[Progress] = []
    with worker_limit(2), on_progress(heard.append):
        found = fit_models(logs, settings)
    assert (
        list(found) == list(alone) == ["constant_velocity", "baseline", "wide", "narrow", "ridge"]
    )
    for name, model in alone.items():
        other = found[name].model.state_dict()
        for key, value in model.model.state_dict().items():
            assert torch.equal(value, other[key]), (name, key)
        notes = {key: value for key, value in model.notes.items() if key != "seconds"}
        assert {key: found[name].notes[key] for key in notes} == notes, name
    # what the processes report reaches who listens to this one, and so does why one fails
    assert {"training wide", "training narrow"} <= {event.stage for event in heard}
    failing = beside(multi_step=[{"horizon": 500.0, "epochs": 1, "batch": 16}])
    with worker_limit(2), pytest.raises(DataError, match="no training log holds a window of 500"):
        fit_models(logs, failing)


def test_what_ends_soon_stays_in_this_process(
    logs: PreparedSplits, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = beside()
    fitter = Fitter(logs, settings, FitStore())
    with worker_limit(8):
        assert parts.count_parallel_heads(fitter) == 1
        monkeypatch.setattr(parts, "_MIN_PARALLEL_STEPS", 1)
        assert parts.count_parallel_heads(fitter) == 2
    # a program of the user's own need not be made for processes
    assert available_cores() == 1
    assert parts.count_parallel_heads(fitter) == 1
    with worker_limit(8):
        gpu = beside(device="cuda")
        assert parts.count_parallel_heads(Fitter(logs, gpu, FitStore())) == 1


ROLES = {
    "constant_velocity": "constant_velocity",
    **dict.fromkeys(("baseline", "physics", "hull"), "baseline"),
}
ROLES |= {"mlp": "head", "ridge": "head", "ensemble": "ensemble"}
NOTES: dict[str, dict[str, Any]] = {
    "baseline": {"validation": 0.5},
    "physics": {"validation": 0.16},
    "hull": {"validation": 0.18},
    "mlp": {"baseline": "hull", "validation": 0.1},
    "ridge": {"validation": 0.2},
    "ensemble": {"validation": 0.1},
}
TO_FIRST = dict.fromkeys(("constant_velocity", "physics", "hull", "ridge", "plant"), "baseline")


@pytest.mark.parametrize(
    ("roles", "notes", "expected"),
    [
        (ROLES | {"plant": "plant"}, NOTES, {**TO_FIRST, "mlp": "hull", "ensemble": "physics"}),
        # what is not there is no reference
        ({"mlp": "head", "ensemble": "ensemble"}, {"mlp": {"baseline": "hull"}}, {}),
        # baselines without a recorded validation error: the first
        (
            {"baseline": "baseline", "b": "baseline", "ensemble": "ensemble"},
            {},
            {"b": "baseline", "ensemble": "baseline"},
        ),
        # a baseline that diverged is none while a steady one is there
        (
            {name: ROLES[name] for name in ("baseline", "physics", "hull", "ensemble")},
            NOTES | {"physics": {"validation": 0.16, "validation_diverged": 2}},
            {"physics": "baseline", "hull": "baseline", "ensemble": "hull"},
        ),
    ],
)
def test_who_is_compared_with_whom(
    roles: dict[str, str], notes: dict[str, dict[str, Any]], expected: dict[str, str]
) -> None:
    found = [
        SimpleNamespace(name=name, spec=SimpleNamespace(role=role), notes=notes.get(name, {}))
        for name, role in roles.items()
    ]
    assert find_reference_names(cast(list[FittedModel], found)) == expected


def model() -> HybridDynamics:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    return HybridDynamics(
        signals, RegressorsConfig(terms=("u",)).build(signals.names), ZeroHead(), 0.1
    )


def at(value: float, *, alone: bool = True) -> Solution:
    """A solution of coefficients all alike; it has neighbours one apart where it is not alone."""
    return Solution(
        {"value": value},
        {"theta": torch.full((3, 1), value, dtype=torch.float64)},
        neighbours=None
        if alone
        else lambda: [at(value - 1.0, alone=False), at(value + 1.0, alone=False)],
    )


def chosen(
    bench: Callable[[float], Score], *solutions: Solution
) -> tuple[float, list[dict[str, Any]]]:
    """The value that is chosen, which the model then has, and what was tried."""
    own = model()
    theta: Any = own.baseline.theta

    def score(candidate: HybridDynamics) -> Score:
        assert candidate is own
        return bench(float(theta[0, 0]))

    best, notes = select_by_free_run(own, own.baseline, solutions, score)
    assert theta.flatten().tolist() == [best.hyperparameters["value"]] * 3
    return best.hyperparameters["value"], notes.get("free_run_choice", [])


def test_a_single_solution_is_taken_without_a_free_run() -> None:
    def never(value: float) -> Score:
        raise AssertionError("nothing to choose")

    assert chosen(never, at(3.0)) == (3.0, [])


def test_a_diverging_solution_never_beats_the_best_steady_one() -> None:
    scores = {5.0: Score(1, 0.1), 2.0: Score(0, 0.9), 1.0: Score(0, 0.8)}
    best, tried = chosen(scores.__getitem__, at(5.0), at(2.0), at(1.0))
    assert best == 1.0
    assert [(one["value"], one["diverged"], one["validation"]) for one in tried] == [
        (5.0, 1, 0.1), (2.0, 0, 0.9), (1.0, 0, 0.8),
    ]  # fmt: skip


def test_what_lies_around_the_best_is_tried_while_it_gains() -> None:
    near = at(0.0, alone=False)
    wide = at(2.0, alone=False)
    best, tried = chosen(lambda value: Score(0, abs(value - 4.2)), near, wide)
    assert best == 4.0
    # each once, up to the first neighbours that do not gain
    assert [one["value"] for one in tried] == [0.0, 2.0, 1.0, 3.0, 4.0, 5.0]


def test_what_stands_alone_does_not_end_the_search() -> None:
    """No residual at all may beat every shared setting, and yet lose to what lies around the best
    of them.
    """
    best, tried = chosen(
        lambda value: Score(0, 2.5 if value == 0.0 else abs(value - 7.2)),
        *(at(4.0, alone=False), at(3.0, alone=False), at(0.0)),
    )
    assert tried[2]["validation"] == 2.5 < tried[0]["validation"]
    assert best == 7.0


TERMS = ["u", "v", "r", "tau_x", "tau_n"]
SETTINGS = settings_of(
    prepare={**TINY["prepare"], "hold": "mean"},
    baseline={"kind": "regressors", "terms": TERMS},
    heads={"ridge": {"kind": "ridge"}},
)


@pytest.fixture(scope="module")
def forced_logs() -> PreparedSplits:
    return logs_of(SETTINGS)


@pytest.fixture(scope="module")
def identified(forced_logs: PreparedSplits) -> IdentifiedModels:
    return fit_models(forced_logs, SETTINGS)


def test_accelerations_are_those_of_the_models_rate_at_the_sample(
    forced_logs: PreparedSplits, identified: IdentifiedModels
) -> None:
    log = forced_logs["test"][0]
    model = identified["ridge"].model.double()
    # inputs move on within a step: else one rule could not be told from the other
    assert np.abs(log.w - log.regression_inputs).max() > 1.0
    at = int(np.flatnonzero(log.trainable)[50])
    x, w = (
        torch.from_numpy(log.smoothed[at : at + 1]),
        torch.from_numpy(log.regression_inputs[at : at + 1]),
    )
    z = compute_channels(log, model.signals)[at : at + 1]
    torch.testing.assert_close(z, model.compute_channels(x, w), rtol=1e-12, atol=1e-12)
    rate = model.state_derivative(
        x, model.signals.prepare(w), model.head(z, model.initial_state(1))[0]
    )
    predicted = run_teacher_forced(model, log).predicted_accelerations[at]
    np.testing.assert_allclose(predicted, rate[0, 3:].detach().numpy(), rtol=1e-9)


def test_training_sees_the_channels_of_the_closed_forms(
    forced_logs: PreparedSplits, identified: IdentifiedModels
) -> None:
    """Where the fit saw other inputs, its residual would correlate with the regressors."""
    signals = SETTINGS.signals.build()
    known = make_samples(forced_logs["train"], signals)
    store = WindowStore.from_logs(forced_logs["train"], torch.float64)
    z = signals(store.smoothed, signals.prepare(store.regression_inputs))[store.trainable]
    torch.testing.assert_close(z, known.z, rtol=1e-12, atol=1e-12)
    runs = [
        (log, run_teacher_forced(identified["baseline"].model, log)) for log in forced_logs["train"]
    ]
    assert torch.equal(torch.cat([run.channels[log.trainable] for log, run in runs]), known.z)
    left = np.concatenate(
        [(log.nu_dot - run.predicted_accelerations)[log.trainable] for log, run in runs]
    )
    columns = known.z[:, [known.names.index(name) for name in TERMS]].numpy()
    size = np.linalg.norm(columns, axis=0)[:, None] * np.linalg.norm(left, axis=0)
    assert (np.abs(columns.T @ left) < 1e-6 * size).all()
