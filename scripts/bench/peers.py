"""Compare the standard recipe with peers: same logs, same windows, settings tuned on validation.

    pip install "residnet[peers]"
    python scripts/bench/peers.py [--logs measured|boats|shipped] [--vessels NAME ...] [--count 4]
        [--seed S] [--minutes 5] [--peers NAME ...] [--save FILE]
    python scripts/bench/peers.py --summary FILE ...

Draws of logs are those of `recipe.py`: three logs for training and one for validation, `minutes`
long together, and four for the test. The recipe uses the validation log in training too if logs are
short; peers select their settings on it and are fitted to the training logs and then to both.
Discrete-time peers run at a hundredth of a free run, with inputs averaged over a step, and are
interpolated. Free runs start from the measured past that the protocol grants.

| peer | package | settings tuned on validation windows |
|---|---|---|
| constant_velocity | | |
| arx | numpy | order 1, 2, 3, 5; ridge 1e-3, 1e-1, 10 |
| n4sid | nfoursid | order 3, 4, 6, 8; block rows 6, 10 |
| sindy | pysindy | polynomial degree 2, 3; threshold .003, .01, .03, .1 |
| narmax | sysidentpy | FROLS with 4, 8, 12, 20 terms of degree 1, 2, two lags |
| boosting | scikit-learn | 50, 150, 400 trees of 15 leaves, three lags |
| gru, lstm | torch | none; six networks of 32 units with an encoder of the past |
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import bench
import numpy as np
import torch
from recipe import SOURCES, STRETCHES, split
from torch import Tensor, nn

import residnet
from residnet.core.layout import VELOCITIES
from residnet.evaluation.freerun import FreeRunErrors
from residnet.preprocessing.prepare import PreparedLog

_STEPS_PER_FREE_RUN = 100
_MAX_VELOCITY = 8.0
"""Limit of predicted velocities in standard deviations, with which a diverged run counts."""


@dataclass(frozen=True)
class Series:
    """Standardised velocities x [T + 1, 3] of a log, and mean inputs w [T, m] of each step."""

    x: np.ndarray
    w: np.ndarray


class Scaling:
    """Standardisation and decimation of prepared logs by an integer factor.

    Args:
        logs: training logs.
        factor: grid steps in a step of the peers.
    """

    def __init__(self, logs: Sequence[PreparedLog], factor: int) -> None:
        self.factor = factor
        self.x_mean, self.x_std = _moments(np.concatenate([log.y[:, VELOCITIES] for log in logs]))
        self.w_mean, self.w_std = _moments(np.concatenate([log.w for log in logs]))
        # an input that is nearly constant in training may move in the test
        self.w_std = np.maximum(self.w_std, 0.05 * np.abs(self.w_mean))

    def symmetrize(self, columns: Sequence[int], signs: Sequence[float]) -> None:
        """Make means and standard deviations equal to those of mirrored logs with these logs."""
        n = len(self.x_mean)
        mean = np.concatenate((self.x_mean, self.w_mean))
        std = np.concatenate((self.x_std, self.w_std))
        index = list(columns)
        mean = 0.5 * (mean + np.array(signs) * mean[index])
        std = 0.5 * (std + std[index])
        self.x_mean = mean[:n]
        self.w_mean = mean[n:]
        self.x_std = std[:n]
        self.w_std = std[n:]

    def decimate(self, log: PreparedLog, start: int = 0, stop: int | None = None) -> Series:
        """Return the samples from `start` to `stop` of a log at the step of the peers."""
        y = log.y[start:stop, VELOCITIES]
        n_steps = (len(y) - 1) // self.factor
        x = (y[: n_steps * self.factor + 1 : self.factor] - self.x_mean) / self.x_std
        return Series(np.nan_to_num(x), self.average_inputs(log.w[start:stop], n_steps))

    def average_inputs(self, w: np.ndarray, n_steps: int) -> np.ndarray:
        """Return standardised means [n_steps, m] of inputs [T, m]; the last row is repeated."""
        n_missing = max(n_steps * self.factor - len(w), 0)
        w = np.concatenate((w, np.repeat(w[-1:], n_missing, axis=0)))[: n_steps * self.factor]
        means = w.reshape(n_steps, self.factor, w.shape[1]).mean(axis=1)
        return np.nan_to_num((means - self.w_mean) / self.w_std)


def _moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.nanmean(values, axis=0), np.nanstd(values, axis=0) + 1e-9


@dataclass(frozen=True)
class Runs:
    """Free runs: past x [B, P, 3] and w [B, P, m], start [B, 3], inputs w [B, T, m]."""

    past_x: np.ndarray
    past_w: np.ndarray
    start: np.ndarray
    w: np.ndarray


class Peer(ABC):
    """A model of standardised velocities in discrete time.

    Attributes:
        grid: values of each setting that is tuned on validation windows.
    """

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {}

    @abstractmethod
    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        """Fit the model to logs."""

    @abstractmethod
    def simulate(self, runs: Runs) -> np.ndarray:
        """Return the velocities [B, T, 3] after each step of free runs."""


class ConstantVelocity(Peer):
    """Velocities stay as they are at the start."""

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        """Nothing to fit."""

    def simulate(self, runs: Runs) -> np.ndarray:
        return np.repeat(runs.start[:, None], runs.w.shape[1], axis=1)


class LaggedPeer(Peer):
    """A model of the next increment from lagged velocities and inputs."""

    lags: int = 1

    def regressors(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the regressors [B, .] of the latest `lags` velocities [B, p, 3], inputs [B, p, m].

        The last input is the mean over the step that is predicted.
        """
        return np.concatenate((x.reshape(len(x), -1), w.reshape(len(w), -1)), axis=1)

    def collect(self, logs: Sequence[Series]) -> tuple[np.ndarray, np.ndarray]:
        """Return regressors [N, .] and increments [N, 3] of logs."""
        p = self.lags
        rows = []
        increments = []
        for log in logs:
            index = np.arange(p, len(log.w) + 1)[:, None] - np.arange(p, 0, -1)
            rows.append(self.regressors(log.x[index], log.w[index]))
            increments.append(np.diff(log.x, axis=0)[p - 1 :])
        return np.concatenate(rows), np.concatenate(increments)

    @abstractmethod
    def predict(self, regressors: np.ndarray) -> np.ndarray:
        """Return increments [B, 3] from regressors [B, .]."""

    def simulate(self, runs: Runs) -> np.ndarray:
        p = self.lags
        past_x = np.concatenate((runs.past_x, runs.start[:, None]), axis=1)
        # a past shorter than the lags repeats its first sample
        x = np.concatenate((np.repeat(past_x[:, :1], p, axis=1), past_x), axis=1)
        past_w = runs.past_w if runs.past_w.shape[1] else runs.w[:, :1]
        w = np.concatenate((np.repeat(past_w[:, :1], p, axis=1), runs.past_w, runs.w), axis=1)
        offset = w.shape[1] - runs.w.shape[1]
        for k in range(runs.w.shape[1]):
            latest_w = w[:, offset + k + 1 - p : offset + k + 1]
            increment = self.predict(self.regressors(x[:, -p:], latest_w))
            following = np.clip(x[:, -1] + increment, -_MAX_VELOCITY, _MAX_VELOCITY)
            x = np.concatenate((x, following[:, None]), axis=1)
        return x[:, -runs.w.shape[1] :]


class Arx(LaggedPeer):
    """Linear autoregression with inputs, by ridge regression (Ljung 1999, section 4.2)."""

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {
        "order": (1, 2, 3, 5),
        "ridge": (1e-3, 1e-1, 10.0),
    }

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        self.lags = settings["order"]
        rows, increments = self.collect(logs)
        design = np.column_stack((np.ones(len(rows)), rows))
        gram = design.T @ design + settings["ridge"] * np.eye(design.shape[1])
        self.coefficients = np.linalg.solve(gram, design.T @ increments)

    def predict(self, regressors: np.ndarray) -> np.ndarray:
        return self.coefficients[0] + regressors @ self.coefficients[1:]


class Boosting(LaggedPeer):
    """Gradient-boosted trees of the increments, one model for each velocity."""

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {"trees": (50, 150, 400)}
    lags = 3

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        from sklearn.ensemble import HistGradientBoostingRegressor

        rows, increments = self.collect(logs)
        self.models = [
            HistGradientBoostingRegressor(
                max_iter=settings["trees"], max_leaf_nodes=15, early_stopping=False, random_state=0
            ).fit(rows, target)
            for target in increments.T
        ]

    def predict(self, regressors: np.ndarray) -> np.ndarray:
        return np.stack([model.predict(regressors) for model in self.models], axis=1)


class Sindy(LaggedPeer):
    """Sparse identification of nonlinear dynamics by sequentially thresholded least squares.

    In discrete time: the derivative is the difference quotient over a step.
    """

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {
        "degree": (2, 3),
        "threshold": (0.003, 0.01, 0.03, 0.1),
    }

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        import pysindy

        self.model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=settings["threshold"], alpha=1e-2),
            feature_library=pysindy.PolynomialLibrary(degree=settings["degree"]),
        )
        self.model.fit(
            [log.x[:-1] for log in logs],
            t=1.0,
            x_dot=[np.diff(log.x, axis=0) for log in logs],
            u=[log.w for log in logs],
        )

    def predict(self, regressors: np.ndarray) -> np.ndarray:
        return np.asarray(self.model.predict(regressors[:, :3], u=regressors[:, 3:]))


class Narmax(Peer):
    """Polynomial NARX models selected by forward regression orthogonal least squares (FROLS).

    One model for each velocity; the other velocities are inputs. The package predicts one output,
    hence its regressors are evaluated here for all of them together. Moving-average terms are zero
    in a free run and are omitted.
    """

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {"degree": (1, 2), "terms": (4, 8, 12, 20)}
    lag = 2

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import RidgeRegression

        x = np.concatenate([log.x[:-1] for log in logs])
        w = np.concatenate([log.w for log in logs])
        self.terms: list[np.ndarray] = []
        self.coefficients: list[np.ndarray] = []
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            # the package relates y(k) to inputs up to k - 1
            inputs = np.column_stack((x[:, others], w))
            model = FROLS(
                ylag=self.lag,
                xlag=[list(range(1, self.lag + 1))] * inputs.shape[1],
                order_selection=False,
                n_terms=settings["terms"],
                estimator=RidgeRegression(alpha=1e-4),
                basis_function=Polynomial(degree=settings["degree"]),
                model_type="NARMAX",
            )
            model.fit(X=inputs, y=x[:, [axis]])
            self.terms.append(np.asarray(model.final_model))
            self.coefficients.append(np.asarray(model.theta).reshape(-1))

    def simulate(self, runs: Runs) -> np.ndarray:
        lag = self.lag
        past_x = np.concatenate((runs.past_x, runs.start[:, None]), axis=1)
        x = np.concatenate((np.repeat(past_x[:, :1], lag, axis=1), past_x), axis=1)
        past_w = runs.past_w if runs.past_w.shape[1] else runs.w[:, :1]
        w = np.concatenate((np.repeat(past_w[:, :1], lag, axis=1), runs.past_w, runs.w), axis=1)
        offset = w.shape[1] - runs.w.shape[1]
        for k in range(runs.w.shape[1]):
            following = np.zeros((len(x), 3))
            for axis, (terms, coefficients) in enumerate(
                zip(self.terms, self.coefficients, strict=True)
            ):
                others = [j for j in range(3) if j != axis]
                for term, coefficient in zip(terms, coefficients, strict=True):
                    product_of_term = np.full(len(x), coefficient)
                    # a code is 1000 times the number of the variable plus the lag; 0 is a constant
                    for code in term[term > 0]:
                        variable, delay = divmod(int(code), 1000)
                        if variable == 1:
                            value = x[:, -delay, axis]
                        elif variable < 4:
                            value = x[:, -delay, others[variable - 2]]
                        else:
                            value = w[:, offset + k + 1 - delay, variable - 4]
                        product_of_term = product_of_term * value
                    following[:, axis] += product_of_term
            following = np.clip(np.nan_to_num(following), -_MAX_VELOCITY, _MAX_VELOCITY)
            x = np.concatenate((x, following[:, None]), axis=1)
        return x[:, -runs.w.shape[1] :]


class N4sid(Peer):
    """Subspace identification of a linear state-space model (Van Overschee and De Moor 1994).

    The package takes one record, hence logs are joined. The state at the start of a free run is the
    least-squares estimate from the measured past.
    """

    grid: ClassVar[dict[str, tuple[Any, ...]]] = {"order": (3, 4, 6, 8), "rows": (6, 10)}

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        import pandas as pd
        from nfoursid.nfoursid import NFourSID

        outputs = [f"x{k}" for k in range(3)]
        inputs = [f"w{k}" for k in range(logs[0].w.shape[1])]
        table = np.concatenate([np.column_stack((log.x[:-1], log.w)) for log in logs])
        identification = NFourSID(
            pd.DataFrame(table, columns=[*outputs, *inputs]), outputs, inputs, settings["rows"]
        )
        identification.subspace_identification()
        self.model, _ = identification.system_identification(rank=settings["order"])

    def simulate(self, runs: Runs) -> np.ndarray:
        a, b, c, d = (getattr(self.model, name) for name in "abcd")
        n = len(a)
        n_past = runs.past_x.shape[1]
        # outputs of the past are linear in the state at its beginning
        observability = [c]
        for _ in range(n_past):
            observability.append(observability[-1] @ a)
        w = np.concatenate((runs.past_w, runs.w), axis=1)
        measured = np.concatenate((runs.past_x, runs.start[:, None]), axis=1)
        forced = np.zeros((len(w), n))
        residuals = []
        for k in range(n_past + 1):
            residuals.append(measured[:, k] - forced @ c.T - w[:, k] @ d.T)
            forced = forced @ a.T + w[:, k] @ b.T
        stacked = np.concatenate(observability)
        gram = stacked.T @ stacked + 1e-3 * np.eye(n)
        state = np.linalg.solve(gram, stacked.T @ np.concatenate(residuals, axis=1).T).T
        predicted = []
        for k in range(w.shape[1] + 1):
            if k > n_past:
                # the output at the end of the last step has the input of that step
                output = state @ c.T + w[:, min(k, w.shape[1] - 1)] @ d.T
                predicted.append(np.clip(output, -_MAX_VELOCITY, _MAX_VELOCITY))
            if k < w.shape[1]:
                state = np.clip(state @ a.T + w[:, k] @ b.T, -1e6, 1e6)
        return np.stack(predicted, axis=1)


class Recurrent(nn.Module):
    """K encoders and decoders of a recurrent cell, with weights [K, ., .], in one batch."""

    def __init__(
        self, n_members: int, n_inputs: int, size: int, cell: str, gain: float | Tensor = 0.5
    ) -> None:
        super().__init__()
        self.size = size
        self.cell = cell
        self.gain = gain
        self.limits: tuple[Tensor, Tensor] | None = None
        n_gates = 4 if cell == "lstm" else 3

        def parameter(*shape: int) -> nn.Parameter:
            return nn.Parameter((torch.rand(n_members, *shape) * 2.0 - 1.0) / size**0.5)

        self.weights = nn.ModuleDict(
            {
                name: nn.ParameterDict(
                    {
                        "input": parameter(n_inputs, n_gates * size),
                        "hidden": parameter(size, n_gates * size),
                        "bias": parameter(1, n_gates * size),
                        "bias_hidden": parameter(1, size),
                    }
                )
                for name in ("encoder", "decoder")
            }
        )
        self.output = nn.Parameter(0.1 * parameter(size, 3).data)
        self.skip = nn.Parameter(0.1 * parameter(n_inputs, 3).data)
        self.output_bias = nn.Parameter(torch.zeros(n_members, 1, 3))

    def update(self, part: str, z: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Return hidden and cell states [K, B, H] after inputs z [K, B, n_inputs]."""
        weights: Any = self.weights[part]
        size = self.size
        gates = torch.baddbmm(weights["bias"], z, weights["input"])
        recurrent = torch.bmm(h, weights["hidden"])
        if self.cell == "lstm":
            forget, take, emit, candidate = (gates + recurrent).chunk(4, dim=-1)
            c = torch.sigmoid(forget) * c + torch.sigmoid(take) * torch.tanh(candidate)
            return torch.sigmoid(emit) * torch.tanh(c), c
        update, reset = torch.sigmoid((gates + recurrent)[..., : 2 * size]).chunk(2, dim=-1)
        hidden = recurrent[..., 2 * size :] + weights["bias_hidden"]
        candidate = torch.tanh(gates[..., 2 * size :] + reset * hidden)
        return candidate + update * (h - candidate), c

    def forward(self, past: Tensor, x: Tensor, w: Tensor) -> Tensor:
        """Return velocities [K, B, T, 3]; past [K, B, P, .], start x [K, B, 3], w [K, B, T, m]."""
        h = past.new_zeros(*x.shape[:2], self.size)
        c = torch.zeros_like(h)
        for k in range(past.shape[2]):
            h, c = self.update("encoder", past[:, :, k], h, c)
        predicted = []
        for k in range(w.shape[2]):
            z = torch.cat((x, w[:, :, k]), dim=-1)
            if self.limits is not None:
                z = z.clamp(*self.limits)
            h, c = self.update("decoder", z, h, c)
            increment = self.gain * (
                torch.bmm(h, self.output) + torch.baddbmm(self.output_bias, z, self.skip)
            )
            x = (x + increment).clamp(-_MAX_VELOCITY, _MAX_VELOCITY)
            predicted.append(x)
        return torch.stack(predicted, dim=2)


@dataclass(frozen=True)
class NetworkSettings:
    """Settings of plain recurrent networks.

    Attributes:
        cell: `gru` or `lstm`.
        n_members: number of networks.
        size: hidden units of each network.
        n_batches: number of batches.
        batch_size: windows in a batch for each network.
        learning_rate: largest learning rate of the cosine schedule.
        loss: `huber`, the mean over samples, or `window`, the mean over windows of the root mean
            square error, as the recipe has it.
        horizons: shares of the batches, and the horizon of each relative to the longest one.
        longest: longest horizon relative to the shortest log.
        gain: change of a velocity in a step for an output of 1, in standard deviations of the
            velocity; `increment` for the standard deviation of the increments.
        decay: decay of the exponential average of the weights; 0 for the last weights.
        is_mirrored: whether half of the windows are mirrored.
        clips_members: whether the gradient of each network is clipped separately.
        is_limited: whether inputs of the networks are limited to their training range.
        validates: whether the weights with the smallest error on the last log are taken, which is
            not trained on.
    """

    cell: str = "gru"
    n_members: int = 6
    size: int = 32
    n_batches: int = 300
    batch_size: int = 32
    learning_rate: float = 3e-3
    loss: str = "huber"
    horizons: tuple[tuple[float, float], ...] = ((0.25, 0.3), (0.5, 0.6), (1.0, 1.0))
    longest: float = 1.0
    gain: float | str = 0.5
    decay: float = 0.99
    is_mirrored: bool = False
    clips_members: bool = False
    is_limited: bool = False
    validates: bool = False


_START_NOISE = 0.03
"""Standard deviation of the noise on the initial velocities, in standard deviations."""
_VALIDATION_INTERVAL = 25
"""Batches between two validations of `NetworkSettings.validates`."""


class Gru(Peer):
    """Recurrent networks in free run with growing horizons, averaged.

    Args:
        n_past: steps of the measured past.
        horizon: steps of a free run.
        settings: settings of the networks.
        mirror: source column and sign of each velocity and input in the mirror.
    """

    settings = NetworkSettings()

    def __init__(
        self,
        n_past: int,
        horizon: int,
        settings: NetworkSettings | None = None,
        mirror: tuple[list[int], list[float]] = ([], []),
    ) -> None:
        self.n_past = n_past
        self.horizon = horizon
        self.settings = settings or self.settings
        self.mirror = mirror

    def fit(self, logs: Sequence[Series], **settings: Any) -> None:
        options = self.settings
        torch.manual_seed(0)
        random = np.random.default_rng(0)
        validation = logs[-1:] if options.validates else ()
        if options.validates:
            logs = logs[:-1]
        rows = [torch.from_numpy(np.column_stack((log.x[:-1], log.w))).float() for log in logs]
        targets = [torch.from_numpy(log.x).float() for log in logs]
        shortest = min(len(log.w) for log in logs)
        room = min(int(options.longest * shortest), shortest - self.n_past - 1)
        longest = max(min(self.horizon, room), 2)
        joined = torch.cat(rows)
        gain: float | Tensor
        if isinstance(options.gain, str):
            gain = torch.cat([part.diff(dim=0) for part in targets]).std(dim=0)
        else:
            gain = options.gain
        net = Recurrent(options.n_members, rows[0].shape[1], options.size, options.cell, gain)
        if options.is_limited:
            net.limits = (joined.amin(0), joined.amax(0))
        average = copy.deepcopy(net)
        best = (np.inf, average)
        optimizer = torch.optim.AdamW(net.parameters(), lr=options.learning_rate, weight_decay=1e-3)
        for batch in range(options.n_batches):
            progress = batch / options.n_batches
            share = next(share for end, share in options.horizons if progress < end)
            length = max(round(share * longest), 2)
            optimizer.param_groups[0]["lr"] = (
                options.learning_rate
                * max(0.5 * (1.0 + np.cos(np.pi * progress)), 0.02)
                * min((batch + 1) / 20, 1.0)
            )
            loss = self.compute_loss(net, rows, targets, length, random)
            optimizer.zero_grad()
            loss.backward()
            if options.clips_members:
                clip_members(net)
            else:
                nn.utils.clip_grad_norm_(net.parameters(), float(options.n_members))
            optimizer.step()
            decay = min(options.decay, (batch + 1) / (batch + 10))
            with torch.no_grad():
                for averaged, value in zip(average.parameters(), net.parameters(), strict=True):
                    averaged.lerp_(value, 1.0 - decay)
            if validation and (batch + 1) % _VALIDATION_INTERVAL == 0:
                self.net = average
                error = self.free_run_error(validation, longest)
                if error < best[0]:
                    best = (error, copy.deepcopy(average))
        self.net = best[1] if validation else average

    def compute_loss(
        self,
        net: Recurrent,
        rows: list[Tensor],
        targets: list[Tensor],
        length: int,
        random: np.random.Generator,
    ) -> Tensor:
        """Return the loss of a batch of free runs of `length` steps from random starts."""
        options = self.settings
        starts = [(i, k) for i, z in enumerate(rows) for k in range(self.n_past, len(z) - length)]
        chosen = random.integers(len(starts), size=(options.n_members, options.batch_size))
        members = [[starts[j] for j in part] for part in chosen]

        def gather(tables: list[Tensor], first: int, last: int) -> Tensor:
            """Return rows `first` to `last` after each start [K, B, ., .]."""
            return torch.stack(
                [
                    torch.stack([tables[i][k + first : k + last] for i, k in part])
                    for part in members
                ]
            )

        past = gather(rows, -self.n_past, 0)
        start = gather(targets, 0, 1)
        inputs = gather(rows, 0, length)[..., 3:]
        target = gather(targets, 1, length + 1)
        if options.is_mirrored:
            rows_mirrored = torch.rand(options.n_members, options.batch_size, 1, 1) < 0.5
            columns, signs = (torch.tensor(part) for part in self.mirror)

            def reflect(values: Tensor, part: slice) -> Tensor:
                image = values[..., columns[part] - (part.start or 0)] * signs[part]
                return torch.where(rows_mirrored, image, values)

            past = reflect(past, slice(None))
            start = reflect(start, slice(3))
            inputs = reflect(inputs, slice(3, None))
            target = reflect(target, slice(3))
        start = start[:, :, 0] + _START_NOISE * torch.randn_like(start[:, :, 0])
        error = net(past, start, inputs) - target
        if options.loss == "window":
            return torch.sqrt(error.square().mean((2, 3)) + 0.05**2).mean(1).sum()
        loss = nn.functional.smooth_l1_loss(
            error, torch.zeros_like(error), reduction="none", beta=0.3
        )
        return loss.mean((1, 2, 3)).sum()

    def free_run_error(self, logs: Sequence[Series], length: int) -> float:
        """Return the root mean square error of free runs over windows of logs."""
        errors = []
        for log in logs:
            starts = range(self.n_past, len(log.w) - length, max(length // 5, 1))
            runs = Runs(
                np.stack([log.x[k - self.n_past : k] for k in starts]),
                np.stack([log.w[k - self.n_past : k] for k in starts]),
                np.stack([log.x[k] for k in starts]),
                np.stack([log.w[k : k + length] for k in starts]),
            )
            measured = np.stack([log.x[k + 1 : k + length + 1] for k in starts])
            errors.append(np.sqrt(np.mean((self.simulate(runs) - measured) ** 2)))
        return float(np.mean(errors))

    @torch.no_grad()
    def simulate(self, runs: Runs) -> np.ndarray:
        past = np.concatenate((runs.past_x, runs.past_w), axis=2)[:, -self.n_past :]
        n_members = self.settings.n_members
        tensors = [
            torch.from_numpy(part).float()[None].repeat(n_members, *[1] * part.ndim)
            for part in (past, runs.start, runs.w)
        ]
        return np.asarray(self.net(*tensors).double().mean(0).numpy())


def clip_members(net: nn.Module) -> None:
    """Clip the gradient of each network to a norm of 1."""
    gradients = [p.grad for p in net.parameters() if p.grad is not None]
    norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
    factor = 1.0 / norm.clamp(min=1.0)
    for gradient in gradients:
        gradient.mul_(factor.view(-1, *[1] * (gradient.ndim - 1)))


class Lstm(Gru):
    """The same with long short-term memories."""

    settings = NetworkSettings(cell="lstm")


PEERS: dict[str, type[Peer]] = {
    "constant_velocity": ConstantVelocity, "arx": Arx, "n4sid": N4sid, "sindy": Sindy,
    "narmax": Narmax, "boosting": Boosting, "gru": Gru, "lstm": Lstm,
}  # fmt: skip


class Comparison:
    """Peers on the prepared logs and windows of a fitted recipe.

    Args:
        data: prepared logs and protocols of the fit.
        coarsening: ratio of the time step to a hundredth of a free run.
    """

    def __init__(self, data: residnet.Dataset, coarsening: int = 1) -> None:
        self.data = data
        self.step = data.prepare.grid.step
        self.protocol = data.evaluation.protocols[data.evaluation.selection]
        self.scales = data.evaluation.scales.to_array()
        self.splits = {name: data.logs(name) for name in ("train", "validation", "test")}
        window = self.windows("test")[0]
        self.length = window.stop - window.start
        factor = coarsening * max(round(self.length / _STEPS_PER_FREE_RUN), 1)
        self.scaling = Scaling(self.splits["train"], factor)
        self.n_past = int(self.protocol.history / self.step) // factor

    def windows(self, name: str) -> list[Any]:
        """Return the windows of a split; overlapping ones of the validation log."""
        windows = []
        for i, log in enumerate(self.splits[name]):
            if name == "test":
                windows += self.protocol.make_windows(log, i, self.step)
            else:
                windows += self.protocol.make_overlapping_windows(log, i, self.step, 2.0)
        return windows

    def errors(self, peer: Peer, name: str) -> np.ndarray:
        """Return the NRMSE of a peer in each window of a split, as metrics.json averages it."""
        means = [np.nanmean(error**2, axis=0) for error in self.velocity_errors(peer, name)]
        return np.array([float(np.mean(np.sqrt(mean))) for mean in means])

    def velocity_errors(self, peer: Peer, name: str) -> list[np.ndarray]:
        """Return the errors [T, 3] of a peer in each window of a split, relative to the scales.

        They are NaN where they are not scored.
        """
        scaling = self.scaling
        logs = self.splits[name]
        # windows with equal lengths of past and run are simulated as one batch
        batches: dict[tuple[int, int], list[int]] = {}
        all_windows = self.windows(name)
        for number, window in enumerate(all_windows):
            n_past = min(self.n_past, window.start // scaling.factor)
            batches.setdefault((n_past, window.stop - window.start), []).append(number)
        errors: dict[int, np.ndarray] = {}
        for (n_past, length), numbers in batches.items():
            windows = [all_windows[number] for number in numbers]
            n_steps = -(-(length - 1) // scaling.factor)
            pasts = []
            inputs = []
            for window in windows:
                log = logs[window.log_index]
                begin = window.start - n_past * scaling.factor
                pasts.append(scaling.decimate(log, begin, window.start + 1))
                future = log.w[window.start : window.stop - 1]
                inputs.append(scaling.average_inputs(future, n_steps))
            past_x = np.stack([past.x for past in pasts])
            past_w = np.stack([past.w for past in pasts])
            runs = Runs(past_x[:, :-1], past_w, past_x[:, -1], np.stack(inputs))
            simulated = np.concatenate((past_x[:, -1:], peer.simulate(runs)), axis=1)
            for number, window, x in zip(numbers, windows, simulated, strict=True):
                errors[number] = self.compare(x, logs[window.log_index], window)
        return [errors[number] for number in range(len(all_windows))]

    def compare(self, x: np.ndarray, log: PreparedLog, window: Any) -> np.ndarray:
        """Return the errors [T, 3] of standardised velocities [K + 1, 3] at the peers' step."""
        scaling = self.scaling
        fine = np.arange(window.stop - window.start) / scaling.factor
        predicted = np.stack([np.interp(fine, np.arange(len(x)), column) for column in x.T], axis=1)
        difference = predicted * scaling.x_std + scaling.x_mean
        difference = difference - log.y[window.start : window.stop, VELOCITIES]
        # u and v are scored at usable samples only, see `FreeRunErrors.is_scored`
        difference[~log.usable[window.start : window.stop], :2] = np.nan
        return np.asarray(difference / self.scales)

    def judge(self, name: str) -> dict[str, Any]:
        """Tune and fit a peer; return its test error, settings and CPU seconds."""
        kind = PEERS[name]
        peer = (
            kind(self.n_past, self.length // self.scaling.factor) if name in _NETWORKS else kind()
        )
        train = [self.scaling.decimate(log) for log in self.splits["train"]]
        both = [*train, *(self.scaling.decimate(log) for log in self.splits["validation"])]
        begin = time.process_time()
        grid = [
            dict(zip(kind.grid, values, strict=True)) for values in product(*kind.grid.values())
        ]
        best = (np.inf, grid[0])
        silence = contextlib.redirect_stdout(io.StringIO())
        with warnings.catch_warnings(), silence:
            warnings.simplefilter("ignore")
            for settings in grid if len(grid) > 1 else []:
                try:
                    peer.fit(train, **settings)
                    error = float(self.errors(peer, "validation").mean())
                except (np.linalg.LinAlgError, ValueError):
                    continue
                if error < best[0]:
                    best = (error, settings)
            peer.fit(both, **best[1])
        errors = self.errors(peer, "test")
        return {
            "error": float(errors.mean()),
            "windows": errors.tolist(),
            "settings": best[1],
            "seconds": time.process_time() - begin,
        }


_NETWORKS = ("gru", "lstm")


def compare(splits: dict[str, Any], peers: Sequence[str]) -> dict[str, Any]:
    """Fit the recipe and the peers, and return errors, settings and CPU seconds by name."""
    begin = time.process_time()
    models = residnet.fit(splits, bands=None)
    seconds = time.process_time() - begin
    rows = residnet.metrics(models, split="test")
    rows = rows[rows.protocol == models.data.evaluation.selection].set_index("model")
    evaluation = models.runs["test"].evaluation
    selection = models.data.evaluation.selection
    run = next(run for run in evaluation.free_runs if run.protocol == selection)
    scales = models.data.evaluation.scales.to_array()
    record: dict[str, Any] = {}
    for name in ("ensemble", "hull", "baseline"):
        if name in rows.index:
            free_run_errors = FreeRunErrors.from_predictions(
                run.windows, run.predictions[name], evaluation.logs
            )
            record[name] = {
                "error": float(rows.nrmse_mean[name]),
                "windows": free_run_errors.nrmse(scales).tolist(),
                "seconds": seconds,
            }
    comparison = Comparison(models.data)
    # the same model in both computations: windows, scales and masks of this script are the recipe's
    error = comparison.judge("constant_velocity")["error"]
    if not np.isclose(error, rows.nrmse_mean["constant_velocity"], rtol=0.02):
        raise RuntimeError(
            f"constant velocity: error {error:.4f} here, but"
            f" {rows.nrmse_mean['constant_velocity']:.4f} in metrics.json"
        )
    return record | {name: comparison.judge(name) for name in peers}


def summarize(records: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of errors, ratios with paired standard errors, and times."""
    lines = [
        "| model | NRMSE | relative to `ensemble` | `ensemble` better in | CPU s |",
        "| --- | --- | --- | --- | --- |",
    ]
    # the windows of a draw are the pairs where there is a single draw
    errors = {
        name: np.array(
            [record["models"][name]["error"] for record in records]
            if len(records) > 1
            else records[0]["models"][name]["windows"]
        )
        for name in records[0]["models"]
    }
    seconds = {
        name: np.mean([record["models"][name]["seconds"] for record in records]) for name in errors
    }
    for name, values in sorted(errors.items(), key=lambda item: float(np.mean(item[1]))):
        ratios = np.log(values / errors["ensemble"])
        ratio = float(np.exp(ratios.mean()))
        standard_error = ratio * float(ratios.std(ddof=1)) / len(ratios) ** 0.5
        relative = "1" if name == "ensemble" else f"{ratio:.2f} ± {standard_error:.2f}"
        better = "" if name == "ensemble" else f"{int((ratios > 0).sum())} of {len(ratios)}"
        # the recipe fits these three together
        time_text = "in `ensemble`" if name in ("hull", "baseline") else f"{seconds[name]:.1f}"
        lines.append(f"| {name} | {values.mean():.3f} | {relative} | {better} | {time_text} |")
    return "\n".join(lines)


def main() -> None:
    """Print a line for each draw and the tables by source of logs."""
    given = bench.options(
        __doc__, logs="measured", vessels=[], count=4, first=0, seed=200, minutes=5.0,
        peers=list(PEERS), save=None, summary=[],
    )  # fmt: skip
    records: list[dict[str, Any]] = []
    for file in given.summary:
        records += [json.loads(line) for line in Path(file).read_text().splitlines()]
    source, names = SOURCES[given.logs]
    names = given.vessels or names
    for number in range(given.first, given.first + (0 if given.summary else given.count)):
        name = names[number % len(names)]
        random = np.random.default_rng([given.seed, number])
        seconds = 60.0 * given.minutes / STRETCHES
        splits = split(source(name, seconds, given.seed + number // 2, random))
        record = {"vessel": name, "draw": number, "models": compare(splits, given.peers)}
        records.append(record)
        print(json.dumps(record), flush=True)
        if given.save:
            with Path(given.save).open("a") as file:
                file.write(json.dumps(record) + "\n")
    for name in dict.fromkeys(record["vessel"] for record in records):
        chosen = [record for record in records if record["vessel"] == name]
        n_windows = len(chosen[0]["models"]["ensemble"]["windows"])
        print(f"\n{name}: {len(chosen)} draws, {n_windows} test windows each\n")
        print(summarize(chosen))


if __name__ == "__main__":
    main()
