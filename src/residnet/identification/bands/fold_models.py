"""Models as they come out without some of the training logs, for bands."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from residnet.baselines import ParametricBaseline
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.data.prepare import samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import ClosedFormHead
from residnet.heads.base import EquationHead
from residnet.identification.identified import Identified
from residnet.identification.models import FittedModel
from residnet.identification.residuals import residual_samples
from residnet.regression.solutions import Solution
from residnet.training.free_runs.left_out import without_logs


def fold_numbers(kinds: Sequence[str], folds: int, seed: int) -> np.ndarray:
    """Return the number of the fold of each log [L]; logs of a kind are spread over the folds.

    Args:
        kinds: of manoeuvre, by log.
        folds: at most; fewer where there are fewer logs.
        seed: of the division.
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
        identified: the fit.
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
        if fitted.spec.disturbance is not None:
            return []
        if role == "baseline":
            return self._baseline(fitted)
        head = fitted.model.head
        name = self.identified.settings.baseline_name_of(fitted.name)
        quick = isinstance(head, ClosedFormHead) and not isinstance(head, EquationHead)
        if role != "head" or not quick or name not in before[0]:
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
            _place(model, theta)
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


def _place(model: HybridDynamics, theta: Tensor) -> None:
    assert isinstance(model.baseline, ParametricBaseline)
    with torch.no_grad():
        model.baseline.theta.copy_(theta)
