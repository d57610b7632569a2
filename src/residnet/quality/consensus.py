"""Find the logs of one vessel that contradict the other logs.

Every log is predicted by a linear regression fitted to the *other* logs (leave-one-log-out). The
regression is a one-step model without vessel knowledge: the change of each velocity over a block of
a few seconds, regressed on the time integral of polynomial features of velocities and inputs.

Two statistics flag a log. Both are relative to their spread over the inliers, so that noise, gusts
and the misfit of the polynomial, which affect all logs, flag none:

- `rmse_ratio`: RMSE of the log under the model of the other logs, over the median of the inliers;
- `score_test`: test whether the hull or an input needs a separate scale factor in this log.

The module `outlier_causes` explains each outlier.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.names import VELOCITY_NAMES, azimuth_thrusters
from residnet.core.stretches import find_runs
from residnet.preprocessing.channel_values import SIGMA_OF_MAD
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.statistics import (
    LogStatistics,
    make_blocks,
)

# Regression
RIDGE = 1e-6
"""Ridge penalty over the mean of the Gram matrix's diagonal: collinear features are solvable."""
OVERLAP = 4.0
"""Number of blocks that overlap each sample; their residuals count as one independent one."""
MIN_BLOCKS = 12
"""Smallest number of blocks of a log for a decision."""
MAX_BLOCKS = 1500
"""Largest number of blocks of a log; further ones only overlap."""
CHUNK_SAMPLES = 20_000
"""Samples per chunk, so that some thirty features fit into the cache of a core."""
POLYNOMIAL_PREFERENCE = 0.95
"""Ratio of errors below which the polynomial is preferred to the homogeneous features."""
# Outlier decision, calibrated on 80 random fleets so that 3 clean ones are flagged
# (scripts/bench/fleets.py --seed 1, 2)
MAX_SCORE_TEST = 4.8
MAX_RMSE_RATIO = 1.8
"""Ratio of a log's error to that of the other logs above which it can be an outlier."""
MAX_RMSE_Z = 5.5
"""The same limit for the logarithm of this ratio, in its standard deviations among the logs."""
USUAL_SCORE_TEST = 1.3
"""Expected score test of a correct model: mean of the largest of three chi over their size."""
MIN_LOG_RMSE_STD = 0.1
"""Lower bound on the standard deviation of log(RMSE) among logs of one vessel."""
MIN_MATERIAL_ERROR = 0.15
"""Smallest mispredicted share of the response that misleads a fit."""
MAX_SUSPECTS = 8
"""Largest number of logs that are left out in turn."""
MIN_SUSPICION = 0.5
"""Severity from which a log is left out in turn."""
MAX_REFERENCES = 40
"""Largest number of inliers, evenly spread, that serve as the reference of a large fleet."""
MAX_SPARSE_LOGS = 3
"""Largest number of logs that predict each other too badly for a residual variance."""
CV_FOLDS = 4
"""Folds of the cross-validation within a log, used if there are too few logs."""
LTS_STEPS = 3
"""Concentration steps of the least-trimmed-squares search."""
MIN_CONTAMINATION = 1.6
"""RMSE of the clean half under the model of all logs, over its own, that reveals a shared fault.

1.5 at most without one (`quickstart`; 1 in 48 random fleets); more in 33 of 36 random fleets in
which two logs share a fault.
"""
MAX_LACK_OF_FIT = 1.25
"""RMSE of the agreeing logs over that with terms of third degree, above which terms are missing."""
MAX_UNEXPLAINED_MOTION = 0.6
"""Unexplained share of every velocity of the agreeing logs above which no log is accused.

Gusts leave up to .8 of a surge velocity that hardly changes, and up to .3 of the others.
"""
RANGE_MARGIN = 0.1
"""Share of the inliers' range by which an input may exceed it without extrapolation."""
SIZE_MARGIN = 0.02
"""Share of the inliers' largest value by which an input may exceed their range."""
MIN_RELATIVE_STD = 1e-3
"""Relative standard deviation of an input below which it is constant."""
Samples = Mapping[str, np.ndarray]
"""Channels at the samples of blocks, [K, samples of a block] each."""
# --- features and block data -----------------------------------------------------------------


def _thrust_components(log: Samples, inputs: Sequence[str]) -> tuple[list[np.ndarray], list[str]]:
    """Return the thrust of azimuth thrusters along both body axes, and the remaining inputs."""
    azimuths = azimuth_thrusters(inputs)
    # quadratic in the revolutions; the azimuth angle turns the thrust, hence a complex number
    thrusts = [log[n] * np.abs(log[n]) * np.exp(1j * log[angle]) for angle, n in azimuths.items()]
    other_inputs = [
        name for name in inputs if name not in azimuths and name not in azimuths.values()
    ]
    return [part for thrust in thrusts for part in (thrust.real, thrust.imag)], other_inputs


def compute_block_features(
    log: Samples,
    units: Mapping[str, str],
    velocities: Sequence[str],
    inputs: Sequence[str],
    *,
    homogeneous: bool,
    enriched: bool = False,
) -> list[np.ndarray]:
    """Compute the regression features of a log, one array per feature.

    Args:
        log: channels at the samples of the blocks, [K, samples of a block] each.
        units: unit of each channel.
        velocities: channels of the velocities, surge first.
        inputs: channels that drive the vessel; wind among them adds its load.
        homogeneous: forces of second degree in velocities and revolutions only, as of a hull in
            water, which extrapolate to other speeds; else a polynomial with constant and linear
            terms, which fits more vessels.
        enriched: all features of both forms and terms of third degree, for the test of lack of fit.
    """
    if enriched:
        forms = [
            compute_block_features(log, units, velocities, inputs, homogeneous=form)
            for form in (False, True)
        ]
        columns = [*forms[0], *forms[1]]
        states = [log[name] for name in velocities]
        drives = [log[n] for n in inputs if not n.startswith(("wind", "current"))]
        columns += [x**3 for x in states]
        columns += [a * a * b for a, b in itertools.permutations(states, 2)]
        if len(drives) <= 4:
            columns += [a**3 for a in drives]
            columns += [np.abs(x) * a for a in drives for x in states[1:]]
        return columns
    states = [log[name] for name in velocities]
    u = states[0]
    columns = [x * np.abs(x) for x in states]
    columns += [a * b for a, b in itertools.combinations(states, 2)]
    if "q" in velocities:
        # weight and buoyancy act along the vertical, in body axes of a diving vessel
        level = np.cos(log["theta"])
        columns += [np.sin(log["theta"]), level * np.sin(log["phi"]), level * np.cos(log["phi"])]
    actuators = [name for name in inputs if not name.startswith(("wind", "current"))]
    thrusts, other_inputs = _thrust_components(log, actuators)
    if homogeneous:
        angles = [log[name] for name in other_inputs if units[name] == "rad"]
        revs = [log[name] for name in other_inputs if units[name] != "rad"]
        columns += [np.abs(u) * x for x in states[1:]]
        columns += [*thrusts, *(u * thrust for thrust in thrusts)]
        for n in revs:
            columns += [n * np.abs(n), u * n]
        if len(revs) <= 4:
            columns += [np.abs(n) * x for n in revs for x in states[1:]]
            columns += [a * b for a, b in itertools.combinations(revs, 2)]
        for inflow in (u, *revs[:4]):
            columns += [inflow * np.abs(inflow) * a**power for a in angles for power in (1, 2)]
    else:
        drives = [*thrusts, *(log[name] for name in other_inputs)]
        columns += [np.ones_like(u), *states, *drives]
        # beyond four inputs each enters linearly only, or the features outnumber the blocks
        for a in drives if len(drives) <= 4 else ():
            columns += [a * np.abs(a), u * a, u * np.abs(u) * a]
            columns += [b * np.abs(b) * a for b in drives if b is not a]
    if {"wind_speed", "wind_dir"} <= set(inputs) and "psi" in log:
        pressure = log["wind_speed"] * np.abs(log["wind_speed"])
        angle = log["wind_dir"] - log["psi"]
        columns += [pressure * f for f in (np.cos(angle), np.sin(angle), np.sin(2.0 * angle))]
    return columns


@dataclass(frozen=True)
class BlockData:
    """Design matrix X [K, k] and response Y [K, n] of the blocks of one log.

    Attributes:
        start: first sample of each block [K].
        length: samples of a block.
        noise_var: variance [n] that sensor noise adds to Y.
    """

    X: np.ndarray
    Y: np.ndarray
    start: np.ndarray
    length: int
    noise_var: np.ndarray

    @property
    def is_sufficient(self) -> bool:
        """Whether there are enough blocks to decide anything."""
        return len(self.Y) >= MIN_BLOCKS

    def subset(self, rows: np.ndarray) -> BlockData:
        """Return some of the blocks, by indices or mask."""
        return BlockData(self.X[rows], self.Y[rows], self.start[rows], self.length, self.noise_var)

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """X'X and X'Y."""
        return self.X.T @ self.X, self.X.T @ self.Y


def pool_moments(data: Iterable[BlockData]) -> list[np.ndarray]:
    """Return X'X and X'Y summed over logs."""
    return [np.sum(part, axis=0) for part in zip(*(d.moments for d in data), strict=True)]


class RidgeFit:
    """A ridge regression, from X'X and X'Y.

    Attributes:
        coef: coefficients [k, n].
        gram_inv: regularised (X'X)^-1 [k, k].
        residual_var: usual residual variance [n], 1 until it is set.
    """

    def __init__(self, gram: np.ndarray, cross: np.ndarray) -> None:
        # a vessel at rest has a zero Gram matrix
        penalty = RIDGE * (np.trace(gram) / len(gram) or 1.0)
        self.gram_inv = np.linalg.inv(gram + penalty * np.eye(len(gram)))
        self.coef = self.gram_inv @ cross
        self.residual_var = np.ones(self.coef.shape[1])

    def compute_residuals(self, data: BlockData) -> np.ndarray:
        """Return Y - X coef [K, n]."""
        return np.asarray(data.Y - data.X @ self.coef)

    def compute_leverage(self, data: BlockData) -> np.ndarray:
        """Return x' (X'X)^-1 x [K], the coefficients' share in the predictive variance."""
        return np.asarray(((data.X @ self.gram_inv) * data.X).sum(1))

    def compute_mse(self, data: BlockData) -> np.ndarray:
        """Return the mean squared residual [n], corrected for leverage."""
        return np.asarray(
            (self.compute_residuals(data) ** 2 / (1.0 + self.compute_leverage(data))[:, None]).mean(
                0
            )
        )

    def compute_predictive_std(self, data: BlockData) -> np.ndarray:
        """Return the standard deviation of a new response [K, n]."""
        variance = self.residual_var + data.noise_var
        return np.asarray(np.sqrt(variance * (1.0 + self.compute_leverage(data))[:, None]))

    def standardize_residuals(self, data: BlockData) -> np.ndarray:
        """Return the residuals over their predictive standard deviation [K, n]."""
        return np.asarray(self.compute_residuals(data) / self.compute_predictive_std(data))

    def compute_deviance(self, data: BlockData) -> float:
        """Return minus twice the mean log-likelihood of a block, constants left out."""
        fit = (self.standardize_residuals(data) ** 2).sum(1).mean()
        return float(fit) + self.compute_leverage_penalty(data)

    def compute_leverage_penalty(self, data: BlockData) -> float:
        """Return the part of the deviance that does not depend on Y."""
        return float(self.residual_var.size * np.log1p(self.compute_leverage(data)).mean())


def cross_validate_mse(data: BlockData) -> np.ndarray:
    """Return the mean squared residual [n] of a cross-validation within one log."""
    folds = [data.subset(rows) for rows in np.array_split(np.arange(len(data.Y)), CV_FOLDS)]
    return np.asarray(
        np.mean(
            [
                RidgeFit(*pool_moments([*folds[:k], *folds[k + 1 :]])).compute_mse(fold)
                for k, fold in enumerate(folds)
            ],
            axis=0,
        )
    )


# --- a fleet of logs and its outliers --------------------------------------------------------


@dataclass(frozen=True)
class Score:
    """Comparison of a log with the inliers.

    Attributes:
        score_test: score test of its contributions, over its usual value.
        rmse_ratio: RMSE over the usual RMSE [n].
        rmse_z: largest log(RMSE) in standard deviations of the inliers.
        material_error: mispredicted share of the response.
    """

    score_test: float
    rmse_ratio: np.ndarray
    rmse_z: float
    material_error: float

    @property
    def severity(self) -> float:
        """Severity of the deviation; above 1 the log is an outlier."""
        if self.material_error < MIN_MATERIAL_ERROR:
            return 0.0
        ratio = float(np.nanmax(self.rmse_ratio, initial=0.0)) / MAX_RMSE_RATIO
        return max(self.score_test / MAX_SCORE_TEST, min(ratio, self.rmse_z / MAX_RMSE_Z))


class Fleet:
    """Logs of one vessel as regression data in common scales.

    Args:
        logs: logs with increasing times and the same channels.
        inputs: channels that drive the vessel.

    Attributes:
        velocities: channels of the response.
        actuators: inputs without wind and current.
        data: regression data of each log.
        usable: indices of logs with sufficient data.
    """

    def __init__(self, logs: Sequence[LogStatistics], inputs: Sequence[str]) -> None:
        self.logs = list(logs)
        self.inputs = tuple(inputs)
        has_six_dof = all(name in log for log in logs for name in SIX_DOF_LAYOUT.dynamic_states)
        common_velocities = [name for name in VELOCITY_NAMES if all(name in log for log in logs)]
        self.velocities = list(SIX_DOF_LAYOUT.velocities) if has_six_dof else common_velocities
        self.actuators = [name for name in inputs if not name.startswith(("wind", "current"))]
        lengths = [
            make_blocks(log, *self.velocities).length * log.sampling_interval
            for log in logs
            if len(log) >= MIN_SAMPLES
        ]
        self.block_seconds = float(np.median(lengths)) if lengths else 1.0
        self._enriched: Fleet | None = None
        errors = {form: self._standardize(homogeneous=form) for form in (False, True)}
        if errors[False] < POLYNOMIAL_PREFERENCE * errors[True]:
            self._standardize(homogeneous=False)

    def _standardize(self, *, homogeneous: bool, enriched: bool = False) -> float:
        """Set the data in one form of features; return the median leave-one-out error."""
        self.homogeneous = homogeneous
        self.enriched = enriched
        self.__dict__.pop("feature_groups", None)
        raw = [self.assemble(log) for log in self.logs]
        self.usable = [i for i, data in enumerate(raw) if data.is_sufficient]

        def scale(of: Callable[[BlockData], np.ndarray]) -> np.ndarray:
            squares = [np.mean(of(raw[i]) ** 2, axis=0) for i in self.usable]
            rms = np.sqrt(np.mean(squares, axis=0)) if squares else np.ones(1)
            return np.where(rms == 0.0, 1.0, rms)

        self.x_scale = scale(lambda data: data.X)
        self.y_scale = scale(lambda data: data.Y)
        self.data = [self._scale_data(data) for data in raw]
        if len(self.usable) < 2:
            return 0.0
        fits = self.fit_leave_one_out(self.usable, self.usable)
        return float(
            np.median([np.sqrt(fits[i].compute_mse(self.data[i])).sum() for i in self.usable])
        )

    def assemble(self, log: LogStatistics) -> BlockData:
        """Return integrals of regressors and changes of velocities over blocks of a log, in SI."""
        length = len(log)
        if length >= MIN_SAMPLES:
            length = max(round(self.block_seconds / log.sampling_interval), 4)
        stride = max(length // int(OVERLAP), (len(log) - length) // MAX_BLOCKS, 1)
        start = np.arange(0, max(len(log) - length, 0), stride)
        needed = {*self.velocities, *self.inputs, "psi", "phi", "theta"} & {*log}
        integrals = []
        for chunk in np.array_split(start, max(start.size * length // CHUNK_SAMPLES, 1)):
            sample_index = chunk[:, None] + np.arange(length + 1)
            samples = {name: log[name][sample_index] for name in needed}
            dt = np.diff(log.t[sample_index], axis=1)
            columns = compute_block_features(
                samples,
                log.units,
                self.velocities,
                self.inputs,
                homogeneous=self.homogeneous,
                enriched=self.enriched,
            )
            trapezoids = [0.5 * ((c[:, 1:] + c[:, :-1]) * dt).sum(1) for c in columns]
            integrals.append(np.stack(trapezoids, axis=-1))
        X = np.concatenate(integrals)
        end = start + length
        Y = np.stack([log[name][end] - log[name][start] for name in self.velocities], axis=-1)
        valid = np.isfinite(X).all(1) & np.isfinite(Y).all(1)
        # a block across a gap lasts longer
        valid &= log.t[end] - log.t[start] <= (length + 3.0) * log.sampling_interval
        noise_var = np.array([2.0 * log.noise_std(name) ** 2 for name in self.velocities])
        return BlockData(X, Y, start, length, noise_var).subset(valid)

    def _scale_data(self, data: BlockData) -> BlockData:
        return BlockData(
            data.X / self.x_scale,
            data.Y / self.y_scale,
            data.start,
            data.length,
            data.noise_var / self.y_scale**2,
        )

    def assemble_scaled(self, log: LogStatistics) -> BlockData:
        """Return block data divided by the standard deviations over all logs of the fleet."""
        return self._scale_data(self.assemble(log))

    def with_data(self, data: Mapping[int, BlockData]) -> Fleet:
        """Return the fleet with other data for some logs."""
        copied_fleet = copy.copy(self)
        copied_fleet.data = [data.get(i, current) for i, current in enumerate(self.data)]
        return copied_fleet

    def enrich(self) -> Fleet:
        """Return the fleet with terms of third degree among the features."""
        if self._enriched is None:
            self._enriched = copy.copy(self)
            self._enriched._standardize(homogeneous=self.homogeneous, enriched=True)
        return self._enriched

    def fit_leave_one_out(self, members: Sequence[int], of: Iterable[int]) -> dict[int, RidgeFit]:
        """Fit the members once for each log, without that log.

        Args:
            members: indices of the logs in the fit.
            of: indices of the logs to leave out.
        """
        gram, cross = pool_moments(self.data[j] for j in members)
        fits = {}
        for i in of:
            log_moments = self.data[i].moments if i in members else (0.0, 0.0)
            fits[i] = RidgeFit(gram - log_moments[0], cross - log_moments[1])
        return fits

    def estimate_excess_var(
        self, logs: Sequence[int], fits: Mapping[int, RidgeFit], members: int
    ) -> dict[int, np.ndarray]:
        """Return the residual variance [n] of logs beyond their sensor noise.

        Fewer than three other logs predict too badly: then it is cross-validated within each log.
        """
        mse = {
            i: (
                fits[i].compute_mse(self.data[i])
                if members > MAX_SPARSE_LOGS
                else cross_validate_mse(self.data[i])
            )
            for i in logs
        }
        return {i: np.maximum(mse[i] - self.data[i].noise_var, 0.0) for i in logs}

    def score_logs(
        self,
        inliers: Sequence[int],
        of: Sequence[int],
        min_variance: Mapping[int, np.ndarray] | None = None,
    ) -> dict[int, Score]:
        """Compare logs with a fit to the inliers without them.

        Args:
            inliers: indices of the inliers.
            of: indices of the logs to compare.
            min_variance: lower bounds on the expected residual variance [n], by log.
        """
        references = inliers[:: -(-len(inliers) // MAX_REFERENCES)]
        logs = [i for i in dict.fromkeys((*references, *of)) if len(inliers) > (i in inliers)]
        fits = self.fit_leave_one_out(inliers, logs)
        mse = {i: fits[i].compute_mse(self.data[i]) for i in logs}
        excess = self.estimate_excess_var(references, fits, len(references))
        expected = {
            i: np.median([excess[j] for j in references if j != i], axis=0) + self.data[i].noise_var
            for i in logs
        }
        for i, variance in (min_variance or {}).items():
            expected[i] = np.maximum(expected[i], variance)
        ratio = {i: np.sqrt(mse[i] / expected[i]) for i in logs}
        log_ratio = {i: np.log(np.maximum(ratio[i], 1e-6)) for i in logs}
        tests = {i: self.run_score_test(i, fits[i], expected[i]) for i in logs}
        references = [i for i in references if i in ratio]
        # too few logs give no estimate of the spread
        center = np.zeros(1)
        std = np.full(1, np.inf)
        misfit = 1.0
        if len(references) > 4:
            center = np.median([log_ratio[i] for i in references], axis=0)
            mad = np.median([np.abs(log_ratio[i] - center) for i in references], axis=0)
            std = np.hypot(SIGMA_OF_MAD * mad, MIN_LOG_RMSE_STD)
        if len(references) > 2:
            # features that do not fit the vessel fail the test in every log
            usual = float(np.median([tests[i][0] for i in references]))
            misfit = max(1.0, usual / USUAL_SCORE_TEST)
        return {
            i: Score(
                tests[i][0] / misfit,
                ratio[i],
                float(((log_ratio[i] - center) / std).max()),
                max(tests[i][1], float(np.sqrt(np.maximum(mse[i] - expected[i], 0.0)).max())),
            )
            for i in of
        }

    def estimate_local_squares(self, inliers: Sequence[int], i: int) -> np.ndarray:
        """Return the squared residuals [K, n] of the inliers in the motions of another log.

        Each block of the log is paired with the nearest block of the inliers, whose residual is
        that of a model without its log. Near replicates measure the lack of fit where the log is
        (Daniel and Wood 1980), which the median over all manoeuvres does not.

        Args:
            inliers: indices of the inliers.
            i: index of the other log.
        """
        data = self.data[i]
        references = [j for j in inliers if j != i]
        references = references[:: -(-len(references) // MAX_REFERENCES)]
        fits = self.fit_leave_one_out(inliers, references)
        squares = [
            fits[j].compute_residuals(self.data[j]) ** 2
            / (1.0 + fits[j].compute_leverage(self.data[j]))[:, None]
            for j in references
        ]
        # squared distances in blocks of the references; scipy.spatial takes longer to import
        distance = np.full(len(data.X), np.inf)
        nearest_squares = np.zeros_like(data.Y)
        for reference, reference_squares in zip(references, squares, strict=True):
            X = self.data[reference].X
            distances = (X**2).sum(1) - 2.0 * data.X @ X.T
            nearest = distances.argmin(axis=1)
            block_distance = distances[np.arange(len(nearest)), nearest]
            is_nearer = block_distance < distance
            distance = np.where(is_nearer, block_distance, distance)
            nearest_squares[is_nearer] = reference_squares[nearest[is_nearer]]
        return nearest_squares

    @cached_property
    def feature_groups(self) -> list[np.ndarray]:
        """Masks [k] of the features without inputs, then of the features with each actuator."""
        log = self.logs[self.usable[0]]
        X = self.assemble(log).X
        groups = []
        for name in self.actuators:
            perturbed = self.assemble(replace_channels(log, {name: 1.7 * log[name] + 0.1})).X
            rows = min(len(perturbed), len(X))
            groups.append((np.abs(perturbed[:rows] - X[:rows]) > 0.0).any(0))
        hull = ~np.logical_or.reduce(groups) if groups else np.ones(X.shape[1], dtype=bool)
        return [hull, *groups]

    def compute_contributions(self, i: int, fit: RidgeFit) -> np.ndarray:
        """Return the contributions of hull and actuators to the response [n, K, groups]."""
        X = self.data[i].X
        parts = [X[:, group] @ fit.coef[group] for group in self.feature_groups]
        table = np.stack(parts, axis=-1).transpose(1, 0, 2)
        return np.asarray(table * (np.abs(table).max(axis=1, keepdims=True) > 1e-9))

    def run_score_test(self, i: int, fit: RidgeFit, variance: np.ndarray) -> tuple[float, float]:
        """Test whether a log needs a scale factor of its own on each contribution (Rao 1948).

        Args:
            i: index of the log.
            fit: regression that predicts the log.
            variance: expected variance of the residuals [n].

        Returns:
            The statistic, RMS over the contributions, and the share of the response that such
            factors change; both of the worst velocity.
        """
        data = self.data[i]
        table = self.compute_contributions(i, fit)
        transposed = table.transpose(0, 2, 1)
        score = transposed @ fit.compute_residuals(data).T[..., None]
        information = transposed @ table
        cross = transposed @ data.X
        covariance = information + cross @ fit.gram_inv @ cross.transpose(0, 2, 1)
        covariance = OVERLAP * np.maximum(variance, 1e-12)[:, None, None] * covariance
        inverse = np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)
        statistic = (score.transpose(0, 2, 1) @ inverse @ score)[:, 0, 0]
        count = np.maximum(table.any(axis=1).sum(axis=1), 1)
        factors = np.linalg.pinv(information, rcond=1e-6, hermitian=True) @ score
        change = np.sqrt(np.mean((table @ factors) ** 2, axis=1))
        return float(np.sqrt(np.maximum(statistic, 0.0) / count).max()), float(change.max())

    def find_least_trimmed_half(self) -> list[int]:
        """Return the half of the logs with the best mutual agreement.

        Several logs with the same fault corrupt the model of all logs, so that none is an outlier.
        Least trimmed squares over logs (Rousseeuw and Van Driessen 2006) avoids this; the search
        starts from single logs.
        """
        within_log_mse = {
            i: np.maximum(cross_validate_mse(self.data[i]), 1e-12) for i in self.usable
        }
        best = list(self.usable)
        best_loss = math.inf
        for seed in self.usable[:: -(-len(self.usable) // MAX_SUSPECTS)]:
            half = [seed]
            for _ in range(LTS_STEPS):
                loss = {}
                fits = self.fit_leave_one_out(half, [i for i in self.usable if [i] != half])
                for i in self.usable:
                    ratio = (
                        fits[i].compute_mse(self.data[i]) / within_log_mse[i]
                        if i in fits
                        else np.ones(1)
                    )
                    loss[i] = float(ratio.max())
                half = sorted(loss, key=lambda i: loss[i])[: len(self.usable) // 2 + 1]
            total = sum(loss[i] for i in half)
            if total < best_loss:
                best = sorted(half)
                best_loss = total
        return best


@dataclass
class Consensus:
    """The inliers and outliers of a fleet.

    Attributes:
        fleet: the logs with the data of the decision.
        inliers: indices of the agreeing logs.
        outliers: indices of the contradicting logs, the most severe first.
    """

    fleet: Fleet
    inliers: list[int]
    outliers: list[int] = field(default_factory=list)

    @cached_property
    def excess_var(self) -> dict[int, np.ndarray]:
        """Residual variance [n] of each inlier beyond its noise, under the model of the others."""
        has_several = len(self.inliers) > 1
        fits = self.fleet.fit_leave_one_out(self.inliers, self.inliers) if has_several else {}
        return self.fleet.estimate_excess_var(self.inliers, fits, len(self.inliers))

    def fit_inliers(self, excluding: int) -> RidgeFit:
        """Return the fit to the inliers without one log, with the usual residual variance."""
        fit = self.fleet.fit_leave_one_out(self.inliers, [excluding])[excluding]
        usual = [variance for i, variance in self.excess_var.items() if i != excluding]
        fit.residual_var = np.maximum(np.median(usual, axis=0), 1e-12)
        return fit

    @property
    def has_majority(self) -> bool:
        """Whether more than half of the logs are inliers, so that the outliers are wrong."""
        return len(self.inliers) > max(1.0, len(self.fleet.usable) / 2.0)

    @cached_property
    def adequate(self) -> Consensus | None:
        """The consensus whose model explains the agreeing logs; None if no model does.

        Where terms of third degree explain the inliers clearly better, the features lack terms of
        the vessel (lack of fit), and a log with another manoeuvre is no contradiction. Then the
        model with these terms decides which logs are outliers.
        """
        unexplained_shares = np.sqrt(np.median([*self.excess_var.values()], axis=0))
        if float(unexplained_shares.min()) > MAX_UNEXPLAINED_MOTION:
            return None
        if len(self.inliers) < 2:
            return self
        enriched = Consensus(self.fleet.enrich(), self.inliers, self.outliers)
        ratios = [
            self.excess_var[i]
            / np.maximum(enriched.excess_var[i], 1e-2 * self.fleet.data[i].noise_var + 1e-12)
            for i in self.inliers
        ]
        has_lack_of_fit = float(np.median(ratios, axis=0).max()) > MAX_LACK_OF_FIT**2
        return enriched if has_lack_of_fit else self

    def compute_rmse_ratio(self, i: int) -> float:
        """Return the RMSE of a log over the usual RMSE, for its worst velocity."""
        return float(np.nanmax(self.fleet.score_logs(self.inliers, [i])[i].rmse_ratio))

    def is_outlier(self, i: int, data: BlockData | None = None) -> bool:
        """Return whether a log, or part of its data, contradicts the inliers."""
        fleet = self.fleet if data is None else self.fleet.with_data({i: data})
        return fleet.score_logs(self.inliers, [i])[i].severity > 1.0

    def is_contradicting(self, i: int) -> bool:
        """Return whether a log is an outlier among the agreeing logs of like motions.

        Terms that the features lack matter in some manoeuvres only, where the residuals of the
        agreeing logs are large too. Three logs or fewer predict too badly to measure this.
        """
        if len(self.inliers) <= MAX_SPARSE_LOGS:
            return self.is_outlier(i)
        squares = self.fleet.estimate_local_squares(self.inliers, i)
        min_variance = {i: squares.mean(0)}
        return self.fleet.score_logs(self.inliers, [i], min_variance)[i].severity > 1.0

    def is_only_extrapolating(self, i: int) -> bool:
        """Return whether a log is an outlier only outside of the inliers' range of inputs.

        A log that lies outside from end to end has no part that could confirm it.
        """
        fleet = self.fleet
        data = self.fleet.data[i]

        def collect_signals(log: LogStatistics) -> np.ndarray:
            thrusts, other_inputs = _thrust_components(dict(log.log.channels), fleet.actuators)
            return np.stack([*thrusts, *(log[name] for name in (*other_inputs, *fleet.velocities))])

        inlier_signals = [collect_signals(fleet.logs[j]) for j in self.inliers if j != i]
        lower = np.min([np.nanmin(values, axis=1) for values in inlier_signals], axis=0)
        upper = np.max([np.nanmax(values, axis=1) for values in inlier_signals], axis=0)
        size = np.maximum(np.abs(lower), np.abs(upper))
        margin = np.maximum(RANGE_MARGIN * (upper - lower), SIZE_MARGIN * size)
        log_signals = collect_signals(fleet.logs[i])
        is_outside = (log_signals < (lower - margin)[:, None]) | (
            log_signals > (upper + margin)[:, None]
        )
        is_input_outside = is_outside[: -len(fleet.velocities)].any(axis=0)
        if not is_input_outside.any() or is_input_outside.all():
            return False
        # the motion caused by such inputs lasts longer than the inputs
        is_outside = is_outside.any(axis=0)
        for start, stop in zip(*find_runs(is_outside), strict=True):
            is_outside[start:stop] = is_input_outside[start:stop].any()
        count = np.append(0, np.cumsum(is_outside))
        data_inside = data.subset(count[data.start + data.length + 1] == count[data.start])
        return not data_inside.is_sufficient or not self.is_outlier(i, data_inside)


def find_consensus(logs: Sequence[LogStatistics], inputs: Sequence[str]) -> Consensus:
    """Return which logs of one vessel agree.

    Args:
        logs: logs with increasing times and the same channels.
        inputs: channels that drive the vessel.
    """
    fleet = Fleet(logs, inputs)
    if len(fleet.usable) < 2:
        return Consensus(fleet, fleet.usable)
    consensus = _partition_logs(fleet, fleet.usable)
    # A fault that several logs share corrupts the model of all, and none is an outlier. The best
    # half has no such fault, but logs at the edge of the vessel's range are outliers of it.
    # Therefore the half counts only if the model of all is clearly worse on it.
    half = _partition_logs(consensus.fleet, consensus.fleet.find_least_trimmed_half())
    fits = half.fleet.fit_leave_one_out(consensus.inliers, half.inliers)
    under_all = half.fleet.estimate_excess_var(half.inliers, fits, len(half.inliers))
    ratios = [under_all[i] / np.maximum(half.excess_var[i], 1e-12) for i in half.inliers]
    contaminated = float(np.median(ratios, axis=0).max()) >= MIN_CONTAMINATION**2
    return half if contaminated else consensus


def _partition_logs(fleet: Fleet, start: Sequence[int]) -> Consensus:
    """Partition logs: a start set grows by all agreeing logs, then loses the worst ones."""
    inliers = list(start)

    def is_contradicting(i: int) -> bool:
        # without the logs of like motions nothing would measure the lack of fit there
        adequate = Consensus(fleet, [j for j in inliers if j != i]).adequate
        return adequate is not None and adequate.is_contradicting(i)

    while remaining := [i for i in fleet.usable if i not in inliers]:
        agreeing = [i for i, s in fleet.score_logs(inliers, remaining).items() if s.severity <= 1.0]
        if not agreeing:
            break
        inliers = sorted((*inliers, *agreeing))
    while len(inliers) > max(1, len(fleet.usable) // 2):
        severity = {i: score.severity for i, score in fleet.score_logs(inliers, inliers).items()}
        # an outlier corrupts the models of all others: the suspects are left out in turn
        suspects = sorted(inliers, key=lambda i: -severity[i])[:MAX_SUSPECTS]
        severity_without = {
            i: fleet.score_logs([j for j in inliers if j != i], [i])[i].severity
            for i in suspects
            if severity[i] > MIN_SUSPICION
        }
        by_severity = sorted(severity_without, key=lambda i: -severity_without[i])
        worst = next(
            (i for i in by_severity if severity_without[i] > 1.0 and is_contradicting(i)), -1
        )
        if worst < 0:
            break
        inliers.remove(worst)
    remaining = [i for i in fleet.usable if i not in inliers]
    scores = fleet.score_logs(inliers, remaining) if remaining else {}
    rejoined = [i for i in remaining if scores[i].severity <= 1.0]
    outliers = sorted({*remaining} - {*rejoined}, key=lambda i: -scores[i].severity)
    return Consensus(fleet, sorted((*inliers, *rejoined)), outliers)


def replace_channels(log: LogStatistics, channels: Mapping[str, np.ndarray]) -> LogStatistics:
    """Return the log with new or replaced channels [T]; its statistics are computed again."""
    return LogStatistics(log.log.replace(channels={**log.log.channels, **channels}), log.inputs)
