"""Regressors of scikit-learn as heads, judged in free run as every other one.

The fitted state of the estimators in `residnet.heads.scikit_state.FITTED` is stored as arrays and
restored without a fit and without a pickle. Other classes of scikit-learn need `--trust`: their
constructors and fits run when a config names them, and they are fitted again when they are loaded.
Predictions are made in Python: no format of export holds them.
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

from residnet.core.errors import FitError, UsageError
from residnet.core.names import suggest_name
from residnet.core.samples import Samples
from residnet.core.trust import is_trusted
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features, ResidualScale
from residnet.heads.scikit_state import FITTED, KERNELS, StateError, decode, encode
from residnet.regression.estimator import Solution

_DIFFERENCE_STEP = 0.1
"""Standard deviations of a feature over which a slope is taken: trees are flat in between."""
_STATE = "_extra_state"
_STORED_STATE = 1
"""First byte of a stored state that holds the arrays of fitted estimators."""
_STORED_SAMPLES = 2
"""First byte of a stored state that holds samples; the estimators are fitted again on loading."""
_STORES_PICKLES = ("memory",)
"""Parameters that name a joblib store, which unpickles what it finds there."""


class SklearnConfig(FeatureConfig):
    """A pipeline of scikit-learn that ends in a regressor, fitted for each axis.

    Features and targets come standardised.

    Attributes:
        pipeline: its steps by dotted name below `sklearn`, each a name or a mapping from the name
            to its parameters; a parameter may be such a name or mapping itself. Classes outside of
            `residnet.heads.scikit_state.FITTED` need `--trust`.
        samples: of the training logs that it is fitted on at most, evenly spread.
    """

    kind: Literal["sklearn"] = "sklearn"
    pipeline: tuple[str | dict[str, dict[str, Any] | None], ...] = Field(
        default=("sklearn.ensemble.HistGradientBoostingRegressor",), min_length=1
    )
    samples: int = Field(default=5_000, ge=10, le=1_000_000)

    @field_validator("pipeline")
    @classmethod
    def _validate_pipeline(cls, steps: tuple[Any, ...]) -> tuple[Any, ...]:
        estimators = [make_estimator(step) for step in steps]
        final_step = estimators[-1]
        if not callable(getattr(final_step, "predict", None)):
            raise ValueError(f"the last step, {type(final_step).__name__}, is no regressor")
        for estimator in estimators[:-1]:
            if not callable(getattr(estimator, "transform", None)):
                raise ValueError(
                    f"{type(estimator).__name__} is no transformer; only the last step predicts"
                )
        return steps

    @property
    def is_storable(self) -> bool:
        """Whether all of it stands on the allow-list, so that its fitted state can be stored."""
        return all(_is_listed(step, FITTED) for step in self.pipeline)

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Return the module for channels `names`."""
        return SklearnHead(self, names)


def _parse_step(step: Any) -> tuple[str, Mapping[str, Any]] | None:
    """Return the name and the parameters of a part of a pipeline; None for a plain value."""
    if isinstance(step, str) and step.startswith("sklearn."):
        return step, {}
    if isinstance(step, Mapping) and len(step) == 1:
        name, parameters = next(iter(step.items()))
        if isinstance(name, str) and name.startswith("sklearn."):
            return name, parameters or {}
    return None


def _is_listed(step: Any, names: Any) -> bool:
    """Return whether a class and all classes among its parameters are on their allow-lists."""
    named = _parse_step(step)
    if named is None or named[0] not in names:
        return False
    return all(_is_listed(value, KERNELS) for value in named[1].values() if _parse_step(value))


def make_estimator(step: Any, *, listed: Any = FITTED) -> Any:
    """Return the object of a step, not yet fitted, with a fixed seed where it takes one.

    Args:
        step: its name, or a mapping from the name to the parameters.
        listed: names that are allowed without `--trust`.

    Raises:
        ValueError: where there is no such class or parameter, or it is not allowed.
    """
    named = _parse_step(step)
    if named is None:
        raise ValueError(f"{step!r} names nothing below `sklearn`, for example sklearn.svm.SVR")
    name, parameters = named
    if name not in listed and not is_trusted():
        raise ValueError(
            f"'{name}' is not among the classes of scikit-learn whose fitted state is stored as"
            f" data{suggest_name(name, listed)}; docs/howto/head.md lists them. Give --trust (in Python"
            " trust=True) only for configs and runs whose source you trust"
        )
    module, _, kind = name.rpartition(".")
    try:
        made = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError):
        raise ValueError(f"scikit-learn has no '{name}'") from None
    if not inspect.isclass(made):
        raise ValueError(f"'{name}' is no class of scikit-learn")
    settings = {key: _parameter(name, key, value) for key, value in parameters.items()}
    known = inspect.signature(made).parameters
    if "random_state" in known:
        settings.setdefault("random_state", 0)
    if name == "sklearn.neighbors.KNeighborsRegressor":
        # a tree of neighbours is an object of compiled code, which cannot be stored as data
        algorithm = settings.setdefault("algorithm", "brute")
        if algorithm != "brute":
            raise ValueError(f"{name}: algorithm: expected 'brute', found {algorithm}")
    try:
        estimator = made(**settings)
        # scikit-learn checks parameters when it fits; here it names the key in the config
        if hasattr(estimator, "_validate_params"):
            estimator._validate_params()
    except (TypeError, ValueError) as error:
        first = next(iter(str(error).splitlines()), "")
        raise ValueError(f"{name}: {first}") from None
    return estimator


def _parameter(owner: str, key: str, value: Any) -> Any:
    """Return a parameter of an estimator: a plain value, a list of these, or an allowed kernel.

    Raises:
        ValueError: where it is none of these, or names a store of pickles.
    """
    if key in _STORES_PICKLES and value is not None:
        raise ValueError(f"{owner}: {key}: is a store of pickles, which residnet does not open")
    if _parse_step(value):
        return make_estimator(value, listed=KERNELS)
    if isinstance(value, list | tuple):
        return [_parameter(owner, key, part) for part in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(
        f"{owner}: {key}: expected a number, a text or a list of these, found"
        f" {type(value).__name__}"
    )


@final
class SklearnHead(ClosedFormHead):
    """A head rho [..., n] that asks a fitted pipeline for each axis."""

    def __init__(self, config: SklearnConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.export_error = "scikit-learn predicts in Python, which no format of export holds"
        self.config = config
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.stored = np.zeros(0, dtype=np.uint8)
        self.sample_count = 0
        self.axis_pipelines: list[list[Any]] = []

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Fit the pipelines, and return their state.

        Raises:
            FitError: where scikit-learn refuses the samples.
        """
        rows = torch.linspace(0, len(samples) - 1, min(len(samples), self.config.samples)).long()
        with torch.no_grad():
            features = self.features(samples.z[rows]).double().numpy()
            y = (samples.target[rows] / self.scale.std).double().numpy()
        axes = self._fit(features, y)
        count = np.array([len(rows)], dtype="<u4").view(np.uint8)
        if self.config.is_storable:
            names = [_parse_step(step)[0] for step in self.config.pipeline]  # type: ignore[index]
            try:
                content = encode([list(zip(names, axis, strict=True)) for axis in axes])
            except StateError as error:
                raise FitError(f"the fitted pipeline {error}") from None
            parts = [[_STORED_STATE], count, np.frombuffer(content, dtype=np.uint8)]
        else:
            training_data = np.ascontiguousarray(np.column_stack((features, y)))
            parts = [[_STORED_SAMPLES], count, training_data.reshape(-1).view(np.uint8)]
        stored = torch.from_numpy(np.concatenate([np.asarray(p, dtype=np.uint8) for p in parts]))
        self.set_extra_state(stored)
        return [Solution({}, {_STATE: stored}, notes={"fitted_on": len(rows)})]

    def _fit(self, x: np.ndarray, y: np.ndarray) -> list[list[Any]]:
        """Return the fitted steps of each axis, from features [N, F] and targets [N, n]."""
        axes = []
        for i, name in enumerate(self.output_names):
            steps = [make_estimator(step) for step in self.config.pipeline]
            columns = x
            try:
                for step in steps[:-1]:
                    columns = step.fit_transform(columns, y[:, i])
                steps[-1].fit(columns, y[:, i])
            except (TypeError, ValueError) as error:
                first = next(iter(str(error).splitlines()), "")
                raise FitError(f"scikit-learn cannot fit {name}: {first}") from None
            axes.append(steps)
        return axes

    def get_extra_state(self) -> Tensor:
        """Return the fitted pipelines as bytes [N]; none before a fit."""
        return torch.from_numpy(self.stored)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the pipelines from what `get_extra_state` returned.

        Raises:
            UsageError: where the state does not belong to this pipeline, or needs `--trust`.
        """
        stored = np.ascontiguousarray(state.detach().cpu().numpy())
        if stored.dtype != np.uint8 or stored.ndim != 1:
            raise UsageError(
                "a head of kind sklearn: its state was stored by an earlier version of residnet,"
                " which fitted it again at each load; run the fit again"
            )
        if np.array_equal(stored, self.stored):
            return
        if len(stored) < 5:
            raise UsageError("a head of kind sklearn: its state is cut off; run the fit again")
        self.sample_count = int(stored[1:5].copy().view("<u4")[0])
        content = stored[5:]
        if stored[0] == _STORED_STATE and self.config.is_storable:
            self.axis_pipelines = self._restore(content.tobytes())
        elif stored[0] == _STORED_SAMPLES and is_trusted():
            width = self.features.n_features + self.n_dof
            try:
                training_data = content.copy().view(np.float64).reshape(self.sample_count, width)
            except ValueError:
                raise UsageError("a head of kind sklearn: its samples are cut off") from None
            self.axis_pipelines = self._fit(
                training_data[:, : -self.n_dof], training_data[:, -self.n_dof :]
            )
        else:
            raise UsageError(
                "a head of kind sklearn: would be fitted again when it is loaded; give --trust (in"
                " Python trust=True) only if you trust the source of this model"
            )
        self.stored = stored

    def _restore(self, content: bytes) -> list[list[Any]]:
        """Return the steps of each axis with their stored state, after a trial prediction."""
        axes = [[make_estimator(step) for step in self.config.pipeline] for _ in self.output_names]
        names = [_parse_step(step)[0] for step in self.config.pipeline]  # type: ignore[index]
        again = "restore the model, or run the fit again with this version of scikit-learn"
        try:
            decode(
                content, [list(zip(names, a, strict=True)) for a in axes], self.features.n_features
            )
        except StateError as error:
            raise UsageError(f"a head of kind sklearn: its state {error}; {again}") from None
        try:
            answers = [_predict(steps, np.zeros((2, self.features.n_features))) for steps in axes]
            complete = all(part.shape == (2,) for part in answers)
        except Exception as error:
            first = next(iter(str(error).splitlines()), "")
            raise UsageError(
                f"a head of kind sklearn: its state gives no prediction ({first}); {again}"
            ) from None
        if not complete:
            raise UsageError(f"a head of kind sklearn: it predicts several values; {again}")
        return axes

    def predict(self, x: Tensor) -> Tensor:
        """Return standardised residuals [N, n] at standardised features [N, F]."""
        if not self.axis_pipelines or not len(x):
            return x.new_zeros(len(x), self.n_dof)
        features = x.double().numpy()
        predictions = [_predict(steps, features) for steps in self.axis_pipelines]
        return torch.from_numpy(np.stack(predictions, axis=1)).to(x)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        standardised_residual: Tensor = _PredictFunction.apply(self.features(z), self)  # type: ignore[no-untyped-call]
        return self.scale(standardised_residual), s

    def parameter_counts(self) -> list[float]:
        """Return the numbers that each axis was fitted on: nothing else bounds its freedom."""
        return [float(self.sample_count)] * self.n_dof


def _predict(steps: Sequence[Any], rows: np.ndarray) -> np.ndarray:
    """Return the prediction [N] of a fitted pipeline at features [N, F]."""
    for step in steps[:-1]:
        rows = step.transform(rows)
    return np.asarray(steps[-1].predict(rows)).reshape(-1)


class _PredictFunction(torch.autograd.Function):
    """The answer of fitted pipelines, with slopes by central differences."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, head: SklearnHead) -> Tensor:
        flat_features = x.detach().reshape(-1, x.shape[-1])
        ctx.head = head
        ctx.save_for_backward(flat_features)
        return head.predict(flat_features).reshape(*x.shape[:-1], head.n_dof)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (flat_features,) = ctx.saved_tensors
        grad = grad_outputs[0]
        flat_grad = grad.reshape(-1, ctx.head.n_dof)
        grad_input = torch.zeros_like(flat_features)
        for i in range(flat_features.shape[1]):
            feature_step = torch.zeros_like(flat_features)
            feature_step[:, i] = _DIFFERENCE_STEP
            prediction_difference = ctx.head.predict(
                flat_features + feature_step
            ) - ctx.head.predict(flat_features - feature_step)
            grad_input[:, i] = (flat_grad * prediction_difference).sum(1) / (2.0 * _DIFFERENCE_STEP)
        return grad_input.reshape(*grad.shape[:-1], flat_features.shape[1]), None
