"""How strongly a refit holds on to least squares, chosen by free runs over folds of the logs."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from residnet.baselines import ParametricBaseline
from residnet.core.errors import DataError, ResidnetError
from residnet.core.samples import Samples
from residnet.data.prepare import Prepared, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.identification.cross_fitting.crossed import Crossed
from residnet.identification.cross_fitting.folds import Fold, folds_of
from residnet.identification.settings import FitSettings
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import Candidate, FreeRun, Prediction, free_run
from residnet.judge.protocol import Window, Windows, overlapping
from residnet.judge.verdict.selection import Blocks, blocks_of, log_errors
from residnet.training.refit import refit
from residnet.training.refit_config import RefitConfig

_ITERATIONS = 3
"""Steps of Gauss-Newton for each strength, each search going on where the last one ended."""
TAKEN = "taken"
"""Name of the model with the chosen prior among the errors over the folds."""
_ZERO = "zero"
_ALIKE = 1.0 + 1e-9
"""Standard errors by which divergences may differ; rounding apart."""
Prior = float | None
"""A strength of the prior; None for least squares as it is."""


@dataclass(frozen=True)
class JudgedFold:
    """A part of the logs, and the numbers of the model that was fitted without it.

    Attributes:
        windows: of the part.
        logs: that these belong to.
        state: numbers of the model with the chosen prior; None where its fit failed.
    """

    windows: list[Window]
    logs: list[Prepared]
    state: Mapping[str, torch.Tensor] | None


@dataclass(frozen=True)
class PriorChoice:
    """The strength that is taken, and what it was compared with.

    Attributes:
        prior: None where least squares stay as they are.
        table: for fit.json: prior, free-run error over the held-out windows, its ratio to the best
            one's, the standard error of that ratio's logarithm, windows that diverged.
        crossed: errors over the folds by `taken` and `zero`.
        folds: with the models of the chosen prior.
    """

    prior: Prior
    table: list[dict[str, Any]]
    crossed: Crossed
    folds: tuple[JudgedFold, ...] = ()


def choose_prior(
    name: str,
    spec: ModelSpec,
    config: RefitConfig,
    settings: FitSettings,
    logs: Sequence[Prepared],
    limit: np.ndarray,
) -> PriorChoice:
    """Return the strongest prior whose free runs are as good as the best ones.

    Errors are compared as those of models are, see `residnet.judge.verdict.selection`. Fewer
    divergences, by more than one standard error, come before less error. A refit that fails in a
    fold counts there as if every window had diverged.

    Args:
        name: of the baseline.
        spec: that it is built from.
        config: of its refit.
        settings: of the fit.
        logs: for training and validation; folds are made of them.
        limit: of |u, v, r| [3] beyond which a free run has diverged.

    Raises:
        DataError: where no fold holds a window to judge by.
    """
    priors: list[Prior] = [*config.priors, None]
    step, scales = settings.prepare.grid.step, torch.from_numpy(settings.evaluation.scales.array())
    pool: list[Prepared] = []
    windows: list[Window] = []
    predicted: dict[str, list[Prediction]] = {_key(prior): [] for prior in priors}
    predicted[_ZERO] = []
    fitted: list[tuple[list[Window], Fold, dict[Prior, HybridDynamics | None]]] = []
    for fold in folds_of(logs, config.folds):
        found = _windows(fold.held_out, settings.evaluation, config, step)
        if not found:
            continue
        predicted[_ZERO] += _predicted(None, spec, found, fold.held_out, step, limit)
        models = dict(_fitted(spec, config, fold, priors, scales))
        for prior, model in models.items():
            predicted[_key(prior)] += _predicted(model, spec, found, fold.held_out, step, limit)
        fitted.append((found, fold, models))
        offset = len(pool)
        windows += [_moved(window, offset) for window in found]
        pool += fold.held_out
    if not windows:
        raise DataError(
            f"refit.{name}: no part of the training and validation logs holds a free run of"
            f" {config.horizon:g} s to choose the prior by; give one prior, or longer logs"
        )
    choice = _chosen(priors, FreeRun("", "", windows, predicted), pool, settings.evaluation)
    return replace(
        choice,
        folds=tuple(
            JudgedFold(found, fold.held_out, _state(models[choice.prior]))
            for found, fold, models in fitted
        ),
    )


def judged_over(
    name: str,
    folds: Sequence[JudgedFold],
    spec: ModelSpec,
    settings: FitSettings,
    limit: np.ndarray,
) -> Crossed:
    """Return the errors over folds of a model that adds to the baselines fitted there.

    Args:
        name: that the errors get.
        folds: of the baseline's choice of a prior.
        spec: of the model, whose weights are the baseline's.
        settings: of the fit.
        limit: of |u, v, r| [3] beyond which a free run has diverged.
    """
    pool: list[Prepared] = []
    windows: list[Window] = []
    predicted: list[Prediction] = []
    for fold in folds:
        model = None
        if fold.state is not None:
            model = spec.build()
            model.load_state_dict(dict(fold.state))
        step = settings.prepare.grid.step
        predicted += _predicted(model, spec, fold.windows, fold.logs, step, limit)
        windows += [_moved(window, len(pool)) for window in fold.windows]
        pool += fold.logs
    return Crossed.of(FreeRun("", "", windows, {name: predicted}), pool, settings.evaluation)


def _state(model: HybridDynamics | None) -> dict[str, torch.Tensor] | None:
    return None if model is None else model.state_dict()


def _key(prior: Prior) -> str:
    return "least squares" if prior is None else f"{prior:g}"


def _windows(
    logs: Sequence[Prepared], evaluation: EvaluationConfig, config: RefitConfig, step: float
) -> list[Window]:
    """Return windows of the protocol that chooses, of the refit's horizon where none is there."""
    chosen = evaluation.protocols[evaluation.selection]
    shorter = Windows(length=config.horizon, first=0.0, history=0.0)
    for protocol in (overlapping(chosen), overlapping(shorter)):
        found = [w for number, log in enumerate(logs) for w in protocol.windows(log, number, step)]
        if found:
            return found
    return []


def _fitted(
    spec: ModelSpec,
    config: RefitConfig,
    fold: Fold,
    priors: Sequence[Prior],
    scales: torch.Tensor,
) -> list[tuple[Prior, HybridDynamics | None]]:
    """Return a model for each prior, None where the fold's logs do not give one."""
    model = spec.build()
    try:
        known: Samples = samples(fold.fitted, model.signals)
        first = spec.baseline.solutions(model.baseline, known)[0]
        store = WindowStore.gather(fold.fitted, torch.float64)
    except ResidnetError:
        return [(prior, None) for prior in priors]
    model.baseline.load_state_dict(first.state, strict=False)
    # which strength is the better one shows long before the last digit
    quick = config.model_copy(update={"every": config.horizon, "iterations": _ITERATIONS})
    out: list[tuple[Prior, HybridDynamics | None]] = []
    begin: torch.Tensor | None = None
    for prior in priors:
        if prior is None:
            out.append((prior, model))
            continue
        own = copy.deepcopy(model)
        try:
            refit(own, known, store, quick.with_prior(prior), scales, begin)
        except ResidnetError:
            out.append((prior, None))
            continue
        assert isinstance(own.baseline, ParametricBaseline)
        begin = own.baseline.theta.detach().clone()
        out.append((prior, own))
    return out


def _predicted(
    model: HybridDynamics | None,
    spec: ModelSpec,
    windows: Sequence[Window],
    logs: Sequence[Prepared],
    step: float,
    limit: np.ndarray,
) -> list[Prediction]:
    """Return the free runs of a model; those of `zero`, as diverged, where there is none."""
    if model is None:
        # beyond a limit of nothing every free run has diverged, and zero stands in its place
        model, limit = spec.build(), np.full(3, -1.0)
    candidate = Candidate("judged", "baseline", model)
    return free_run([candidate], windows, logs, step, limit)["judged"]


def _moved(window: Window, offset: int) -> Window:
    return Window(window.log + offset, window.start, window.stop, window.past, window.nu)


def _steady(
    run: FreeRun, blocks: Blocks, labels: Sequence[np.ndarray], priors: Sequence[Prior]
) -> list[Prior]:
    """Return the priors that diverge no more often than the steadiest, by one standard error.

    What happens in one part of the logs alone decides nothing.
    """
    lost = {p: np.zeros(len(blocks.weights)) for p in priors}
    for p, parts in lost.items():
        for label, prediction in zip(labels, run.predictions[_key(p)], strict=True):
            parts[label[0]] += prediction.diverged
    least = min(priors, key=lambda p: float(lost[p].sum()))
    return [
        p
        for p in priors
        if float((lost[p] - lost[least]).sum())
        <= blocks.standard_error(lost[p], lost[least]) * _ALIKE
    ]


def _chosen(
    priors: Sequence[Prior],
    run: FreeRun,
    logs: Sequence[Prepared],
    evaluation: EvaluationConfig,
) -> PriorChoice:
    crossed = Crossed.of(run, logs, evaluation)
    blocks, labels = crossed.blocks, blocks_of(run)[1]
    scores = log_errors(crossed.shares, blocks.weights)
    parts = {p: scores[_key(p)] for p in priors}
    lost = {p: sum(one.diverged for one in run.predictions[_key(p)]) for p in priors}
    steady = _steady(run, blocks, labels, priors)
    best = min(steady, key=lambda p: float(parts[p].sum()))
    apart = {p: float((parts[p] - parts[best]).sum()) for p in priors}
    spread = {p: blocks.standard_error(parts[p], parts[best]) for p in priors}
    # they stand in the order of their strength; least squares must be better than all refits
    taken = next(p for p in steady if apart[p] <= blocks.alike * spread[p])
    table = [
        {
            "prior": p,
            "error": float(crossed.shares[_key(p)].sum()),
            "ratio": math.exp(apart[p]),
            "standard_error": spread[p],
            "diverged": lost[p],
            "windows": len(run.windows),
        }
        for p in priors
    ]
    return PriorChoice(taken, table, crossed.renamed({_key(taken): TAKEN, _ZERO: _ZERO}))
