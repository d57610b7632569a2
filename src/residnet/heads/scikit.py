"""Regressors of scikit-learn as heads (residual models).

The fitted state of the estimators in `residnet.heads.scikit_state.FITTED` is stored as arrays and
restored without a fit and without a pickle. Other classes of scikit-learn need `--trust`: a config
can run their constructors and fits, and they are fitted again on loading. Predictions need Python,
so that these heads cannot be exported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import FitError, UsageError
from residnet.core.samples import Samples
from residnet.core.trust import is_trusted
from residnet.heads.base import ClosedFormHead, Features, ResidualScale
from residnet.heads.scikit_estimators import make_estimator, parse_step
from residnet.heads.scikit_state import StateError, decode, encode
from residnet.regression.estimator import Solution

if TYPE_CHECKING:
    from residnet.heads.scikit_config import SklearnConfig

_DIFFERENCE_STEP = 0.1
"""Step of central differences in standard deviations of a feature.

It is large, because trees are piecewise constant.
"""
_STATE_KEY = "_extra_state"
_STORED_STATE_KEY = 1
"""First byte of a stored state that holds the arrays of fitted estimators."""
_STORED_SAMPLES = 2
"""First byte of a stored state that holds samples; the estimators are fitted again on loading."""


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
            names = [parse_step(step)[0] for step in self.config.pipeline]  # type: ignore[index]
            try:
                content = encode([list(zip(names, axis, strict=True)) for axis in axes])
            except StateError as error:
                raise FitError(f"the fitted pipeline {error}") from None
            parts = [[_STORED_STATE_KEY], count, np.frombuffer(content, dtype=np.uint8)]
        else:
            training_data = np.ascontiguousarray(np.column_stack((features, y)))
            parts = [[_STORED_SAMPLES], count, training_data.reshape(-1).view(np.uint8)]
        stored = torch.from_numpy(np.concatenate([np.asarray(p, dtype=np.uint8) for p in parts]))
        self.set_extra_state(stored)
        return [Solution({}, {_STATE_KEY: stored}, notes={"fitted_on": len(rows)})]

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
        if stored[0] == _STORED_STATE_KEY and self.config.is_storable:
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
        names = [parse_step(step)[0] for step in self.config.pipeline]  # type: ignore[index]
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
        # Any: PyTorch does not type the method `apply`
        predict: Any = _PredictFunction.apply
        return self.scale(predict(self.features(z), self)), s

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
