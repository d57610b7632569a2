"""Any regressor of scikit-learn as a head, judged in free run as every other one.

What is stored are the samples that it was fitted on. A load fits it again, so that no pickle is
ever opened. Its predictions are made in Python: no format of export holds them.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping, Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field, field_validator
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features, ResidualScale
from residnet.regression.estimator import Solution

_REACH = 0.1
"""Standard deviations of a feature over which a slope is taken: trees are flat in between."""
_SIZE = "_extra_state"


class SklearnConfig(FeatureConfig):
    """A pipeline of scikit-learn that ends in a regressor, fitted for each axis.

    Features and targets come standardised.

    Attributes:
        pipeline: its steps by dotted name below `sklearn`, each a name or a mapping from the name
            to its parameters; a parameter may be such a name or mapping itself.
        samples: of the training logs that it is fitted on at most, evenly spread; they are stored
            with the model, which is fitted again when it is loaded.
    """

    kind: Literal["sklearn"] = "sklearn"
    pipeline: tuple[str | dict[str, dict[str, Any]], ...] = Field(
        default=("sklearn.ensemble.HistGradientBoostingRegressor",), min_length=1
    )
    samples: int = Field(default=5_000, ge=10, le=1_000_000)

    @field_validator("pipeline")
    @classmethod
    def _can_be_made(cls, steps: tuple[Any, ...]) -> tuple[Any, ...]:
        last = [_made(step) for step in steps][-1]
        if not callable(getattr(last, "predict", None)):
            raise ValueError(f"the last step, {type(last).__name__}, is no regressor")
        return steps

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Return the module for channels `names`."""
        return SklearnHead(self, names)


def _named(step: Any) -> tuple[str, Mapping[str, Any]] | None:
    """Return the name and the parameters of a part of a pipeline; None for a plain value."""
    if isinstance(step, str) and step.startswith("sklearn."):
        return step, {}
    if isinstance(step, Mapping) and len(step) == 1:
        name, parameters = next(iter(step.items()))
        if isinstance(name, str) and name.startswith("sklearn."):
            return name, parameters or {}
    return None


def _made(step: Any) -> Any:
    """Return the object of a step, with a fixed seed where it takes one.

    Raises:
        ValueError: where there is no such class or parameter.
    """
    named = _named(step)
    if named is None:
        raise ValueError(f"{step!r} names nothing below `sklearn`, for example sklearn.svm.SVR")
    name, parameters = named
    module, _, kind = name.rpartition(".")
    try:
        made = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError):
        raise ValueError(f"scikit-learn has no '{name}'") from None
    if not inspect.isclass(made):
        raise ValueError(f"'{name}' is no class of scikit-learn")
    given = {key: _made(v) if _named(v) else v for key, v in parameters.items()}
    if "random_state" in inspect.signature(made).parameters:
        given.setdefault("random_state", 0)
    try:
        return made(**given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None


@final
class SklearnHead(ClosedFormHead):
    """A head rho [..., n] that asks a fitted pipeline for each axis."""

    def __init__(self, config: SklearnConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.refusal = "scikit-learn predicts in Python, which no format of export holds"
        self.config = config
        self.features = Features(config.chosen(names), names, config.margin)
        self.scale = ResidualScale(self.dof)
        self.learned = np.zeros((0, self.features.count + self.dof))
        self.axes: list[Any] = []

    def residual_std(self) -> Tensor:
        return self.scale.spread

    def solutions(self, samples: Samples) -> list[Solution]:
        """Return the samples that the pipelines are fitted on; loaded, they are fitted.

        Raises:
            FitError: where scikit-learn refuses them.
        """
        rows = torch.linspace(0, len(samples) - 1, min(len(samples), self.config.samples)).long()
        with torch.no_grad():
            x = self.features(samples.z[rows])
            learned = torch.cat((x, samples.target[rows] / self.scale.spread), dim=1)
        state = {_SIZE: learned}
        self.set_extra_state(learned)
        return [Solution({}, state, notes={"fitted_on": len(rows)})]

    def get_extra_state(self) -> Tensor:
        """Return standardised features and targets [N, F + n], which a load fits again."""
        return torch.from_numpy(self.learned)

    def set_extra_state(self, state: Tensor) -> None:
        """Fit the pipelines on standardised features and targets [N, F + n].

        Raises:
            FitError: where scikit-learn refuses them.
        """
        from sklearn.pipeline import make_pipeline

        learned = state.double().numpy()
        if np.array_equal(learned, self.learned):
            return
        axes = []
        for i, axis in enumerate(self.outputs):
            whole = make_pipeline(*map(_made, self.config.pipeline))
            try:
                whole.fit(learned[:, : -self.dof], learned[:, i - self.dof])
            except (TypeError, ValueError) as error:
                first = (str(error).splitlines() or [""])[0]
                raise FitError(f"scikit-learn cannot fit {axis}: {first}") from None
            axes.append(whole)
        self.learned, self.axes = learned, axes

    def asked(self, x: Tensor) -> Tensor:
        """Return standardised residuals [N, n] at standardised features [N, F]."""
        if not self.axes or not len(x):
            return x.new_zeros(len(x), self.dof)
        rows = x.double().numpy()
        answers = [np.asarray(axis.predict(rows)).reshape(-1) for axis in self.axes]
        return torch.from_numpy(np.stack(answers, axis=1)).to(x)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        found: Tensor = _Asked.apply(self.features(z), self)  # type: ignore[no-untyped-call]
        return self.scale(found), s

    def parameter_count(self) -> list[float]:
        """Return the numbers that each axis was fitted on: nothing else bounds its freedom."""
        return [float(len(self.learned))] * self.dof


class _Asked(torch.autograd.Function):
    """The answer of fitted pipelines, with slopes by central differences."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, head: SklearnHead) -> Tensor:
        flat = x.detach().reshape(-1, x.shape[-1])
        ctx.head = head
        ctx.save_for_backward(flat)
        return head.asked(flat).reshape(*x.shape[:-1], head.dof)

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor, None]:
        (flat,) = ctx.saved_tensors
        grad = given[0]
        flow = grad.reshape(-1, ctx.head.dof)
        out = torch.zeros_like(flat)
        for i in range(flat.shape[1]):
            step = torch.zeros_like(flat)
            step[:, i] = _REACH
            apart = ctx.head.asked(flat + step) - ctx.head.asked(flat - step)
            out[:, i] = (flow * apart).sum(1) / (2.0 * _REACH)
        return out.reshape(*grad.shape[:-1], flat.shape[1]), None
