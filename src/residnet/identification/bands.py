"""Bands of the models of a fit, calibrated over logs that no model was fitted on."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import nn

from residnet.core.arrays import paged
from residnet.core.errors import FitError
from residnet.core.progress import begin
from residnet.core.samples import Samples
from residnet.data.prepare import Prepared, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ClosedFormHead
from residnet.identification.fitter import FittedModel, references, residual_samples
from residnet.identification.identified import Identified, closed_form, members_of, unlike_models
from residnet.judge.band import Band, BandsConfig, corrected, independent, quantile, run_weights
from residnet.judge.bands import RunErrors, calibrate, few, run_errors
from residnet.judge.freerun import Candidate, free_run
from residnet.judge.protocol import Window
from residnet.regression.estimator import Solution
from residnet.training.left_out import without_logs
from residnet.training.refit import parametric


def fold_numbers(kinds: Sequence[str], folds: int, seed: int) -> np.ndarray:
    """Return the number of the fold of each log [L]; logs of a kind are spread over the folds.

    Args:
        folds: at most; fewer where there are fewer logs.
    """
    random = np.random.default_rng([seed, 3])
    order = [
        place
        for kind in sorted(set(kinds))
        for place in random.permutation([i for i, own in enumerate(kinds) if own == kind]).tolist()
    ]
    out = np.empty(len(kinds), dtype=int)
    out[order] = np.arange(len(kinds)) % min(folds, len(kinds))
    return out


class FoldModels:
    """The models of a fit that can quickly be fitted without a fold of the training logs.

    Baselines that went through a refit take one step of Gauss-Newton; what has a closed form is
    solved again, with the complexity that the whole fit chose. Networks, searched equations and
    ensembles are not here.

    Args:
        fold: number of the fold of each training log [L].
    """

    def __init__(self, identified: Identified, fold: np.ndarray) -> None:
        self.identified = identified
        self.fold = torch.from_numpy(fold)
        self.count = int(fold.max()) + 1
        self.samples = samples(identified.train, identified.settings.signals.build())
        self.failed: dict[str, str] = {}

    @cached_property
    def models(self) -> list[dict[str, HybridDynamics]]:
        """The models by name for each fold that is left out."""
        out: list[dict[str, HybridDynamics]] = [{} for _ in range(self.count)]
        for name, fitted in self.identified.items():
            try:
                found = self._without(fitted, out)
            except FitError as error:
                self.failed[name] = str(error)
                continue
            for models, model in zip(out, found, strict=False):
                models[name] = model
        return out

    def _without(
        self, fitted: FittedModel, before: Sequence[dict[str, HybridDynamics]]
    ) -> list[HybridDynamics]:
        """Return a model without each fold; none where it cannot quickly be fitted again."""
        role = fitted.spec.role
        if role == "zero":
            return [copy.deepcopy(fitted.model) for _ in range(self.count)]
        if role == "baseline":
            return self._baseline(fitted)
        name = self.identified.settings.baseline_name_of(fitted.name)
        if not closed_form(fitted) or name not in before[0]:
            return []
        return [self._head(fitted, before[k][name], k) for k in range(self.count)]

    def _baseline(self, fitted: FittedModel) -> list[HybridDynamics]:
        settings = self.identified.settings
        refit = settings.refit.get(fitted.name)
        whole = copy.deepcopy(fitted.model).to(torch.float64)
        out = [copy.deepcopy(whole) for _ in range(self.count)]
        if refit is None or "refit" not in fitted.notes:
            for k, model in enumerate(out):
                config, kept = fitted.spec.baseline, self._kept(k)
                _fill(model.baseline, config.solutions(model.baseline, kept), fitted)
            return out
        found = without_logs(
            whole,
            self.samples,
            WindowStore.gather(self.identified.train, torch.float64),
            refit.with_prior(float(fitted.notes["prior"])),
            torch.from_numpy(settings.evaluation.scales.array()),
            self.fold,
            fitted.notes["refit"]["at_rest"],
        )
        for model, theta in zip(out, found, strict=True):
            parametric(model).theta.data.copy_(theta)
        return out

    def _head(self, fitted: FittedModel, baseline: HybridDynamics, k: int) -> HybridDynamics:
        model = fitted.spec.build()
        model.baseline.load_state_dict(copy.deepcopy(baseline.baseline.state_dict()))
        assert isinstance(model.head, ClosedFormHead)
        residual = residual_samples(model, self._kept(k))
        model.head.calibrate(residual)
        _fill(model.head, model.head.solutions(residual), fitted)
        return model.eval().requires_grad_(False)

    def _kept(self, k: int) -> Samples:
        """Return the samples of all folds but one."""
        return self.samples.where(self.fold[self.samples.group] != k)


def _fill(part: nn.Module, solutions: Sequence[Solution], fitted: FittedModel) -> None:
    """Fill a part with the solution that has the complexity of the fitted one, else the first."""
    alike = (
        solution
        for solution in solutions
        if all(fitted.notes.get(key) == value for key, value in solution.choice.items())
    )
    part.load_state_dict(next(alike, solutions[0]).state, strict=False)


_MOST = 1_000_000
"""Samples of all windows together that calibrate; of more windows, every second or so is taken."""


def calibrate_bands(
    identified: Identified, validation: Sequence[Prepared], config: BandsConfig
) -> dict[str, FittedModel]:
    """Return the models of a fit with their bands under all protocols.

    Training logs are predicted by models that leave them out, validation logs by the models
    themselves. A model that is not fitted again without logs takes the form of its reference's
    band, with the level that its own errors on the validation logs ask for. Where these were fitted
    too, means take the band of their reference as it is, and networks have none.
    """
    begin("calibrating bands")
    fold = fold_numbers([log.log.manoeuvre for log in identified.train], config.folds, config.seed)
    left_out = FoldModels(identified, fold)
    refitted = left_out.models if int(fold.max()) > 0 else [{}]
    out: dict[str, dict[str, Band]] = {}
    for protocol in identified.settings.evaluation.protocols:
        runs = _Calibration(identified, protocol, config, left_out.failed)
        for k, models in enumerate(refitted):
            own = paged.OneByOne(
                log for log, number in zip(identified.train, fold, strict=True) if number == k
            )
            runs.add(models, own, validation=False)
        if not identified.seen:
            runs.add({name: entry.model for name, entry in identified.items()}, validation, True)
        for name, band in runs.bands().items():
            out.setdefault(name, {})[protocol] = band
    found = dict(identified)
    for name, bands in out.items():
        # the description of a model takes the band that reaches furthest
        furthest = max(bands.values(), key=lambda band: band.horizon)
        spec = found[name].spec.model_copy(update={"band": furthest.table()})
        found[name] = replace(found[name], spec=spec, bands=bands)
    return found


class _Calibration:
    """The free runs that calibrate the bands under one protocol.

    Args:
        failed: why a model cannot be fitted without some of the logs, by its name.
    """

    def __init__(
        self, identified: Identified, protocol: str, config: BandsConfig, failed: Mapping[str, str]
    ) -> None:
        self.failed = failed
        self.identified = identified
        self.protocol = identified.settings.evaluation.protocols[protocol]
        self.config = config
        self.step = identified.settings.prepare.grid.step
        laid = sum(len(log) for log in identified.train) * self.step / config.every
        length = max(
            (w.stop - w.start for log in identified.train[:1] for w in self._windows([log])),
            default=1,
        )
        self.every = max(1, round(laid * length / _MOST))
        self.crossed: dict[str, list[RunErrors]] = {}
        self.validated: dict[str, list[RunErrors]] = {}

    def add(
        self, models: Mapping[str, HybridDynamics], logs: Sequence[Prepared], validation: bool
    ) -> None:
        """Run models over logs that they were not fitted on."""
        windows = self._windows(logs)[:: 1 if validation else self.every]
        if not windows or not models:
            return
        unlike = unlike_models(self.identified[name] for name in models)
        candidates = [
            Candidate(name, "", model, members=members_of(self.identified[name]), unlike=unlike)
            for name, model in models.items()
        ]
        found = free_run(candidates, windows, logs, self.step, self.identified.limit)
        for name, predictions in found.items():
            runs = run_errors(windows, predictions, logs)
            (self.validated if validation else self.crossed).setdefault(name, []).extend(runs)

    def _windows(self, logs: Sequence[Prepared]) -> list[Window]:
        return [
            window
            for number, log in enumerate(logs)
            for window in self.protocol.overlapping(log, number, self.step, self.config.every)
        ]

    def bands(self) -> dict[str, Band]:
        """Return the band of each model; none where no log is long enough."""
        zero = self.crossed.get("zero", []) + self.validated.get("zero", [])
        if not zero:
            return {}
        errors = np.concatenate([run.error for run in zero])
        unit, seen = np.zeros(errors.shape[1]), np.isfinite(errors).any(axis=0)
        unit[seen] = np.sqrt(np.nanmean(np.compress(seen, errors, axis=1) ** 2, axis=0))
        # a channel that zero predicts without any error has no scale of its own
        unit = np.where(unit > 0, unit, 1.0)
        out: dict[str, Band] = {}
        for name in self.crossed:
            runs = self.crossed[name] + self.validated.get(name, [])
            out[name] = calibrate(runs, self.config.level, self.step, unit)
        compared = references(self.identified.values())
        for name, entry in self.identified.items():
            reference = compared.get(name, "baseline")
            if name not in out and self.validated.get(name):
                out[name] = self._like(entry, out, reference, unit)
            elif name not in out and members_of(entry) and reference in out:
                band = out[reference]
                cautions = (_BORROWED.format(reference), *band.cautions)
                out[name] = replace(band, cautions=cautions)
        return {name: out[name] for name in self.identified if name in out}

    def _like(
        self, entry: FittedModel, known: Mapping[str, Band], reference: str, unit: np.ndarray
    ) -> Band:
        """Return the band of a model that was not fitted again without logs."""
        runs = self.validated[entry.name]
        logs = len({run.log for run in runs})
        if reference not in known or not self.validated.get(reference):
            band = calibrate(runs, self.config.level, self.step, unit)
            why = f" ({self.failed[entry.name]})" if entry.name in self.failed else ""
            return replace(band, cautions=(_ALONE.format(logs, why), *few(logs)))
        single = known[reference]
        ratio = _level(runs, single, self.config.level) / _level(
            self.validated[reference], single, self.config.level
        )
        ratio = np.where(np.isfinite(ratio), ratio, 1.0)
        return replace(
            single,
            width=single.width * ratio,
            plain=single.plain * ratio,
            constant=single.constant * ratio,
            logs=logs,
            cautions=(_SCALED.format(reference, logs), *few(logs)),
        )


_SCALED = (
    "This model was not fitted again without the logs that calibrate: its band has the form of that"
    " of {}, and its width from {} validation logs, which also chose between models or stopped the"
    " training early."
)
_ALONE = (
    "Only {} validation logs calibrate this band: no model could be fitted without some of the"
    " training logs{}. They also chose between models or stopped the training early."
)
_BORROWED = (
    "Short logs leave none that this model was not fitted on: its band is that of {}, which was"
    " fitted again without some of them."
)


def _level(runs: Sequence[RunErrors], band: Band, level: float) -> np.ndarray:
    """Return the quantile [c] of errors over the half widths of a band."""
    names = [run.log for run in runs]
    weight = run_weights(names)
    ratios = [run.error / run.within(band) for run in runs]
    inside = np.array([np.nanmean(ratio <= 1.0) for ratio in ratios])
    raised = corrected(level, independent(inside, weight, names, level))
    joined = np.concatenate(ratios)
    share = np.repeat(weight, [len(ratio) for ratio in ratios])
    return np.array([quantile(joined[:, i], share, raised) for i in range(joined.shape[1])])
