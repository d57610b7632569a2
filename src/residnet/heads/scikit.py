"""Regressors of scikit-learn as residual heads.

The fitted state of the estimators in `residnet.heads.scikit_state.FITTED` is stored as arrays and
restored without a fit and without a pickle. Other classes of scikit-learn need `--trust`: a config
can run their constructors and fits, and they are fitted again on loading. Predictions need Python,
so that these heads cannot be exported.
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
"""Step of central differences in standard deviations of a feature.

It is large, because trees are piecewise constant.
"""
_STATE = "_extra_state"
_STORED_STATE = 1
"""First byte of a stored state that holds the arrays of fitted estimators."""
_STORED_SAMPLES = 2
"""First byte of a stored state that holds samples; the estimators are fitted again on loading."""
_STORES_PICKLES = ("memory",)
"""Parameters that configure a joblib cache, which unpickles its files."""


class SklearnConfig(FeatureConfig):
    """Pipeline of scikit-learn that ends in a regressor, fitted per axis.

    Features and targets are standardised.

    Attributes:
        pipeline: steps of the pipeline. A step is a dotted name below `sklearn`, or a mapping from
            the name to the parameters, whose values may again be names or mappings. Classes outside
            of `residnet.heads.scikit_state.FITTED` need `--trust`.
        samples: maximum number of training samples; more samples are decimated evenly.
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
            raise ValueError(
                f"the last step, {type(final_step).__name__}, is not a regressor; end the pipeline"
                " with one"
            )
        for estimator in estimators[:-1]:
            if not callable(getattr(estimator, "transform", None)):
                raise ValueError(
                    f"{type(estimator).__name__} is not a transformer; only the last step may be a"
                    " regressor"
                )
        return steps

    @property
    def is_storable(self) -> bool:
        """Whether all classes are on the allow-list, so that the fitted state can be stored."""
        return all(_is_listed(step, FITTED) for step in self.pipeline)

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Build the head for channels `names`."""
        return SklearnHead(self, names)


def _parse_step(step: Any) -> tuple[str, Mapping[str, Any]] | None:
    """Return the class name and parameters of a step; None for a plain value."""
    if isinstance(step, str) and step.startswith("sklearn."):
        return step, {}
    if isinstance(step, Mapping) and len(step) == 1:
        name, parameters = next(iter(step.items()))
        if isinstance(name, str) and name.startswith("sklearn."):
            return name, parameters or {}
    return None


def _is_listed(step: Any, names: Any) -> bool:
    """Return whether a class and the classes in its parameters are on the allow-lists."""
    parsed_step = _parse_step(step)
    if parsed_step is None:
        return False
    class_name, parameters = parsed_step
    if class_name not in names:
        return False
    return all(_is_listed(value, KERNELS) for value in parameters.values() if _parse_step(value))


def make_estimator(step: Any, *, listed: Any = FITTED) -> Any:
    """Construct the estimator of a step, not yet fitted, with a fixed random seed.

    Args:
        step: class name, or a mapping from the class name to the parameters.
        listed: class names that are allowed without `--trust`.

    Raises:
        ValueError: if the class or a parameter does not exist or is not allowed.
    """
    parsed_step = _parse_step(step)
    if parsed_step is None:
        raise ValueError(
            f"{step!r} is not a class below `sklearn`; give a name such as sklearn.svm.SVR"
        )
    name, parameters = parsed_step
    if name not in listed and not is_trusted():
        raise ValueError(
            f"'{name}' is not among the classes of scikit-learn whose fitted state is stored as"
            f" data{suggest_name(name, listed)}; docs/howto/head.md lists them. Give --trust (in"
            " Python trust=True) only for configs and runs whose source you trust"
        )
    module_name, _, class_name = name.rpartition(".")
    try:
        estimator_class = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError):
        raise ValueError(f"scikit-learn has no '{name}'") from None
    if not inspect.isclass(estimator_class):
        raise ValueError(f"'{name}' is not a class of scikit-learn")
    settings = {key: _parameter(name, key, value) for key, value in parameters.items()}
    if "random_state" in inspect.signature(estimator_class).parameters:
        settings.setdefault("random_state", 0)
    if name == "sklearn.neighbors.KNeighborsRegressor":
        # the search tree is an object of compiled code, which cannot be stored as arrays
        algorithm = settings.setdefault("algorithm", "brute")
        if algorithm != "brute":
            raise ValueError(f"{name}: algorithm: expected 'brute', got {algorithm}")
    try:
        estimator = estimator_class(**settings)
        # scikit-learn validates parameters at the fit; an error here shows the key of the config
        if hasattr(estimator, "_validate_params"):
            estimator._validate_params()
    except (TypeError, ValueError) as error:
        first_line = next(iter(str(error).splitlines()), "")
        raise ValueError(f"{name}: {first_line}") from None
    return estimator


def _parameter(owner: str, key: str, value: Any) -> Any:
    """Convert a parameter: a plain value, a list of plain values, or an allowed kernel.

    Raises:
        ValueError: if the value is of another type, or configures a cache of pickles.
    """
    if key in _STORES_PICKLES and value is not None:
        raise ValueError(
            f"{owner}: {key}: is a cache of pickles, which residnet does not open; remove it"
        )
    if _parse_step(value):
        return make_estimator(value, listed=KERNELS)
    if isinstance(value, list | tuple):
        return [_parameter(owner, key, part) for part in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(
        f"{owner}: {key}: expected a number, a string or a list of these, got"
        f" {type(value).__name__}"
    )


@final
class SklearnHead(ClosedFormHead):
    """Head whose residual rho [..., n] is predicted by a fitted pipeline per axis."""

    def __init__(self, config: SklearnConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.export_error = (
            "predictions of scikit-learn need Python, which no export format contains"
        )
        self.config = config
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.stored = np.zeros(0, dtype=np.uint8)
        self.sample_count = 0
        self.axis_pipelines: list[list[Any]] = []

    def residual_scale(self) -> Tensor:
        return self.scale.std

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Fit the pipelines and return their state.

        Raises:
            FitError: if scikit-learn rejects the samples.
        """
        rows = torch.linspace(0, len(samples) - 1, min(len(samples), self.config.samples)).long()
        with torch.no_grad():
            features = self.features(samples.z[rows]).double().numpy()
            y = (samples.target[rows] / self.scale.std).double().numpy()
        axes = self._fit(features, y)
        # layout of the stored bytes: kind, number of samples (four bytes), content
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
        """Fit the steps of each axis to features [N, F] and targets [N, n]."""
        axes = []
        for i, name in enumerate(self.output_names):
            steps = [make_estimator(step) for step in self.config.pipeline]
            columns = x
            try:
                for step in steps[:-1]:
                    columns = step.fit_transform(columns, y[:, i])
                steps[-1].fit(columns, y[:, i])
            except (TypeError, ValueError) as error:
                first_line = next(iter(str(error).splitlines()), "")
                raise FitError(f"scikit-learn cannot fit {name}: {first_line}") from None
            axes.append(steps)
        return axes

    def get_extra_state(self) -> Tensor:
        """Return the fitted pipelines as bytes [N]; no bytes before a fit."""
        return torch.from_numpy(self.stored)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the pipelines from the bytes of `get_extra_state`.

        Raises:
            UsageError: if the state does not match this pipeline, or needs `--trust`.
        """
        stored = np.ascontiguousarray(state.detach().cpu().numpy())
        if stored.dtype != np.uint8 or stored.ndim != 1:
            raise UsageError(
                "a head of kind sklearn: its state was stored by an earlier version of residnet,"
                " which fitted it again at each load; run the fit again"
            )
        # loading the state that is already set needs no new fit
        if np.array_equal(stored, self.stored):
            return
        if len(stored) < 5:
            raise UsageError("a head of kind sklearn: its state is truncated; run the fit again")
        self.sample_count = int(stored[1:5].copy().view("<u4")[0])
        content = stored[5:]
        if stored[0] == _STORED_STATE and self.config.is_storable:
            self.axis_pipelines = self._restore(content.tobytes())
        elif stored[0] == _STORED_SAMPLES and is_trusted():
            width = self.features.n_features + self.n_dof
            try:
                training_data = content.copy().view(np.float64).reshape(self.sample_count, width)
            except ValueError:
                raise UsageError(
                    "a head of kind sklearn: its samples are truncated; run the fit again"
                ) from None
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
        """Restore the steps of each axis, and check them by a trial prediction."""
        axes = [[make_estimator(step) for step in self.config.pipeline] for _ in self.output_names]
        names = [_parse_step(step)[0] for step in self.config.pipeline]  # type: ignore[index]
        remedy = "restore the model, or run the fit again with this version of scikit-learn"
        try:
            decode(
                content,
                [list(zip(names, steps, strict=True)) for steps in axes],
                self.features.n_features,
            )
        except StateError as error:
            raise UsageError(f"a head of kind sklearn: its state {error}; {remedy}") from None
        try:
            trial_features = np.zeros((2, self.features.n_features))
            predictions = [_predict(steps, trial_features) for steps in axes]
            is_scalar = all(prediction.shape == (2,) for prediction in predictions)
        except Exception as error:
            first_line = next(iter(str(error).splitlines()), "")
            raise UsageError(
                f"a head of kind sklearn: its state gives no prediction ({first_line}); {remedy}"
            ) from None
        if not is_scalar:
            raise UsageError(
                f"a head of kind sklearn: it predicts several values per sample; {remedy}"
            )
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
        """Return the number of training samples per axis, which bounds the degrees of freedom."""
        return [float(self.sample_count)] * self.n_dof


def _predict(steps: Sequence[Any], rows: np.ndarray) -> np.ndarray:
    """Return the prediction [N] of a fitted pipeline at features [N, F]."""
    for step in steps[:-1]:
        rows = step.transform(rows)
    return np.asarray(steps[-1].predict(rows)).reshape(-1)


class _PredictFunction(torch.autograd.Function):
    """Prediction of fitted pipelines, differentiated by central differences."""

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
