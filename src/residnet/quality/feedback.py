"""Detection of feedback: inputs that a controller derived from the motion of the vessel.

In a closed loop an input is correlated with the disturbances that it counteracts, so that a
prediction-error estimate of its effect is biased without limit unless the input also varies
independently of the motion. Sources: L. Ljung, System Identification (1999), chapter 13; U.
Forssell and L. Ljung, Closed-loop identification revisited, Automatica 35 (1999).

An input in open loop is explained by its effects alone: the velocities before and after it. An
input of a course-keeping controller is explained by the heading as well, which is no effect at the
same time but an integral of past effects. The detection compares the two in leave-one-log-out
cross-validation. Steps of the set point and relays (zigzags) are feedback, too, but these inputs
also vary by themselves: the effects explain the former well, and a relay spends its time at the
ends of its range. Neither is reported.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from residnet.quality.between import LogSet
from residnet.quality.findings import Check, Finding, check
from residnet.quality.statistics import LogStatistics, interpolate_gaps

MAX_FEEDBACK_SHARE: Final = 0.2
"""Share of an input that feedback explains beyond the effects of the input, above which the input
is not identifiable. Measured with `scripts/bench/excitation.py`: 0.40 to 0.96 for controllers
without excitation, at most 0.04 for open loop and steps of the set point, up to 0.19 for zigzags of
one amplitude."""
_MIN_RELAY_SHARE: Final = 0.2
"""Share of samples near either end of the range of an input, from which it is a relay."""
_MIN_RELAY_SWITCHES: Final = 3
"""Smallest number of changes from one end of the range to the other in a log of a relay."""
_MIN_SHARE_OF_RELAY_LOGS: Final = 0.8
"""Share of the samples in logs of a relay, above which hardly any log holds other commands."""
_LAGS: Final = (-1.0, -0.5, 0.0, 0.5, 1.0, 2.0)
"""Times at which velocities count as effects, in units of the response time."""
_SAMPLES_PER_RESPONSE: Final = 6
"""Samples within a response time; more are averaged."""
_MIN_SAMPLES: Final = 40
"""Samples that a log needs after the averaging."""
_N_PARTS: Final = 4
"""Parts of a single log."""
_MAX_SAMPLES: Final = 4_000
"""Samples of a log that are used at most."""
_MIN_BLOCK_CORRELATION: Final = 0.25
"""Correlation of successive means of blocks above which motion dominates the noise."""
_RIDGE: Final = 1e-6
"""Regularisation of the normal equations with scaled regressors."""

FEEDBACK_SOURCES: Final = {
    "the heading": ("heading", "heading_integral"),
    "the speed": ("speed_integral",),
    "the position": ("position_ahead", "position_abeam"),
}
"""Quantity that a controller may feed back -> its regressors."""

Signals = Mapping[str, np.ndarray]
"""Signals [T] of a log by name on a uniform grid."""


@dataclass(frozen=True)
class InputFeedback:
    """Feedback in one input of a set of logs.

    Attributes:
        name: name of the input.
        source: quantity that is fed back, a key of `FEEDBACK_SOURCES`.
        share: share that the source explains of the variance which the effects do not explain, by
            leave-one-log-out cross-validation; at most about 0 in open loop.
        effect_share: share of the variance that velocities before and after the input explain.
        relay_share: share of the samples of a log near either end of its range, the smaller of both
            ends, mean over the logs: above 0.3 for a relay, 0.03 for a normal distribution.
    """

    name: str
    source: str
    share: float
    effect_share: float
    relay_share: float = 0.0

    @property
    def is_closed_loop(self) -> bool:
        """Whether feedback dominates the input, so that its effect is not identifiable.

        A relay such as that of a zigzag excites by its switches, although it follows the heading.
        """
        return self.share > MAX_FEEDBACK_SHARE and self.relay_share < _MIN_RELAY_SHARE


def cross_validated_r2(regressors: Sequence[np.ndarray], responses: Sequence[np.ndarray]) -> float:
    """Compute the leave-one-log-out R^2 of a linear regression with a constant.

    Args:
        regressors: regressors [T, k] of each log.
        responses: response [T] of each log.

    Returns:
        One minus the squared errors of the predictions over the variance of all responses; it is
        negative where the regression of other logs predicts worse than their mean.
    """
    joined = np.concatenate(regressors)
    centre = joined.mean(axis=0)
    scale = joined.std(axis=0)
    # a constant regressor explains nothing
    scale[scale <= 1e-9 * np.abs(joined).max(axis=0)] = np.inf
    designs = [np.column_stack((np.ones(len(x)), (x - centre) / scale)) for x in regressors]
    grams = np.array([design.T @ design for design in designs])
    moments = np.array([x.T @ y for x, y in zip(designs, responses, strict=True)])
    ridge = _RIDGE * sum(map(len, designs)) * np.eye(grams.shape[1])
    mean = np.concatenate(responses).mean()
    squared_error = 0.0
    squared_deviation = 0.0
    for k, (design, response) in enumerate(zip(designs, responses, strict=True)):
        coefficients = np.linalg.solve(
            grams.sum(axis=0) - grams[k] + ridge, moments.sum(axis=0) - moments[k]
        )
        squared_error += float(((response - design @ coefficients) ** 2).sum())
        squared_deviation += float(((response - mean) ** 2).sum())
    return 1.0 - squared_error / max(squared_deviation, 1e-300)


def measure_relay_share(values: np.ndarray) -> float:
    """Return the share of samples within a tenth of the range from its ends, the smaller of both.

    The range is from the 1 % to the 99 % quantile.
    """
    is_lower, is_upper = _find_range_ends(values)
    return float(min(is_lower.mean(), is_upper.mean())) if values.min() < values.max() else 0.0


def _find_range_ends(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples [T] bool at the lower and at the upper end of the range."""
    lower, upper = np.quantile(values, (0.01, 0.99))
    margin = 0.1 * (upper - lower)
    return values <= lower + margin, values >= upper - margin


def find_relay_inputs(logs: Sequence[Signals], input_names: Sequence[str]) -> list[str]:
    """Return the inputs that nearly all logs switch between the ends of their ranges.

    These are the rudder angles of zigzags and 3-2-1-1 manoeuvres. An input with few levels, such as
    the speed of a shaft, switches less often.

    Args:
        logs: signals [T] of each log by name.
        input_names: inputs to look at.
    """
    n_samples = [len(next(iter(log.values()))) for log in logs]
    return [
        name
        for name in input_names
        if np.average([_is_relay(log[name]) for log in logs], weights=n_samples)
        >= _MIN_SHARE_OF_RELAY_LOGS
    ]


def _is_relay(values: np.ndarray) -> bool:
    """Return whether an input [T] mostly switches between the ends of its range."""
    is_lower, is_upper = _find_range_ends(values)
    ends = is_upper[is_lower | is_upper]
    n_switches = int(np.count_nonzero(np.diff(ends)))
    return n_switches >= _MIN_RELAY_SWITCHES and measure_relay_share(values) >= _MIN_RELAY_SHARE


def response_time(rates: Sequence[np.ndarray], step: float) -> float:
    """Estimate the time scale of the motion in s: when the autocorrelation falls to one half.

    The rate is averaged over blocks, the shortest ones whose successive means are correlated, so
    that white noise of the sensor does not pass for fast motion.

    Args:
        rates: yaw rate (or another velocity) of each log [T], on a uniform grid.
        step: sampling interval in s.
    """
    shortest = min(len(rate) for rate in rates)
    n_block = 1
    while True:
        means = [average_blocks(rate - rate.mean(), n_block) for rate in rates]
        longest = max(map(len, means))
        covariance = np.zeros(longest)
        for mean in means:
            spectrum = np.fft.rfft(mean, 2 * len(mean))
            covariance[: len(mean)] += np.fft.irfft(np.abs(spectrum) ** 2)[: len(mean)]
        is_correlated = covariance[1] >= _MIN_BLOCK_CORRELATION * covariance[0]
        if is_correlated or 2 * n_block * _MIN_SAMPLES > shortest:
            break
        n_block *= 2
    # lag zero holds the measurement noise
    is_below = covariance[1:] < 0.5 * covariance[1]
    n_blocks = 1 + int(is_below.argmax()) if is_below.any() else longest // 10
    return step * n_block * n_blocks


def average_blocks(values: np.ndarray, n_block: int) -> np.ndarray:
    """Return the means of successive blocks of samples [T // n]."""
    n_blocks = len(values) // n_block
    return np.asarray(values[: n_blocks * n_block].reshape(n_blocks, n_block).mean(axis=1))


def detect_feedback(
    logs: Sequence[Signals], input_names: Sequence[str], step: float
) -> list[InputFeedback]:
    """Detect feedback in each input, by leave-one-log-out cross-validation.

    A single log is divided into four parts.

    Args:
        logs: signals of each log on a uniform grid: velocities, inputs, and psi, x and y where they
            are known.
        input_names: inputs to look at; constant ones are omitted.
        step: sampling interval in s.

    Returns:
        The strongest source of each input; empty without a yaw rate, or if logs are too short.
    """
    velocity_names = [name for name in ("u", "v", "r") if all(name in log for log in logs)]
    if not logs or "r" not in velocity_names:
        return []
    if len(logs) == 1:
        parts = np.array_split(np.arange(len(logs[0]["r"])), _N_PARTS)
        logs = [{name: values[part] for name, values in logs[0].items()} for part in parts]
    time_scale = response_time([log["r"] for log in logs], step)
    time_scale = float(np.clip(time_scale, _SAMPLES_PER_RESPONSE * step, 60.0))
    stride = max(round(time_scale / _SAMPLES_PER_RESPONSE / step), 1)
    lags = [round(lag * time_scale / step / stride) for lag in _LAGS]
    tables = [
        table
        for log in logs
        if (table := _feedback_regressors(log, velocity_names, input_names, stride, lags, step))
    ]
    results = []
    for name in input_names if len(tables) > 1 else ():
        responses = [table[name] for table in tables]
        joined = np.concatenate(responses)
        if joined.std() <= 1e-6 * max(float(np.abs(joined).max()), 1e-12):
            continue
        effect_names = [key for key in tables[0] if key.startswith("effect_")]
        effects = [np.stack([table[key] for key in effect_names], axis=1) for table in tables]
        effect_share = cross_validated_r2(effects, responses)
        relay_share = float(np.mean([measure_relay_share(response) for response in responses]))
        candidates = []
        for source, keys in FEEDBACK_SOURCES.items():
            if not all(key in table for key in keys for table in tables):
                continue
            effects_and_source = [
                np.column_stack((effect, *(table[key] for key in keys)))
                for effect, table in zip(effects, tables, strict=True)
            ]
            unexplained = 1.0 - cross_validated_r2(effects_and_source, responses)
            # effects that predict worse than the mean of the other logs are no reference: feedback
            # must then explain a share of the variance itself
            share = 1.0 - unexplained / max(1.0 - max(effect_share, 0.0), 1e-12)
            candidates.append(InputFeedback(name, source, share, effect_share, relay_share))
        if candidates:
            results.append(max(candidates, key=lambda candidate: candidate.share))
    return results


def _feedback_regressors(
    log: Signals,
    velocity_names: Sequence[str],
    input_names: Sequence[str],
    stride: int,
    lags: Sequence[int],
    step: float,
) -> dict[str, np.ndarray]:
    """Return effects, sources of feedback and inputs [K] of a log; empty if it is too short."""
    n_blocks = min(len(log["r"]) // stride, _MAX_SAMPLES)
    rows = np.arange(-min(lags), n_blocks - max(lags))
    if len(rows) < _MIN_SAMPLES:
        return {}

    def average(values: np.ndarray) -> np.ndarray:
        return average_blocks(values[: n_blocks * stride], stride)

    velocities = {name: average(log[name]) for name in velocity_names}
    table = {
        f"effect_{name}_{lag}": velocities[name][rows + lag]
        for name in velocity_names
        for lag in lags
    }
    if "psi" in log:
        psi = average(log["psi"])
        deviation = psi - psi.mean()
        table["heading"] = deviation[rows]
        integral = np.cumsum(deviation) * stride * step
        table["heading_integral"] = (integral - integral.mean())[rows]
    if "u" in velocities:
        integral = np.cumsum(velocities["u"] - velocities["u"].mean()) * stride * step
        table["speed_integral"] = (integral - integral.mean())[rows]
    if {"psi", "x", "y"} <= log.keys():
        offset = average(log["x"]) + 1j * average(log["y"])
        offset = (offset - offset.mean()) * np.exp(-1j * psi)
        table["position_ahead"] = offset.real[rows]
        table["position_abeam"] = offset.imag[rows]
    return table | {name: average(log[name])[rows] for name in input_names}


def to_uniform_signals(
    log: LogStatistics, names: Sequence[str], step: float
) -> dict[str, np.ndarray]:
    """Interpolate channels of a log to a uniform grid; channels without a number are omitted."""
    grid = np.arange(log.t[0], log.t[-1] + 0.5 * step, step)
    signals = {}
    for name in names:
        if name not in log or not np.isfinite(log[name]).any():
            continue
        values = interpolate_gaps(log.t, log[name])
        values = np.unwrap(values) if name == "psi" else values
        signals[name] = np.interp(grid, log.t, values)
    return signals


_ADVICE: Final = (
    "log runs in which it is driven in open loop (zigzag, 3-2-1-1, random steps) or by steps of the"
    " set point; until then the model holds under the same controller only"
)


@check("between", "feedback", fix=_ADVICE)
def check_feedback(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report inputs that a controller derived from the motion, without independent excitation."""
    names = ("u", "v", "r", "psi", "x", "y", *logs.inputs)
    steps = [log.sampling_interval for log in logs.logs]
    if "r" not in logs or not logs.inputs:
        return
    step = float(np.median(steps))
    signals = [to_uniform_signals(log.subsample, names, step) for log in logs.logs]
    inputs = [
        name
        for name in logs.inputs
        if not name.startswith(("wind", "current")) and all(name in log for log in signals)
    ]
    for feedback in detect_feedback(signals, inputs, step):
        if not feedback.is_closed_loop:
            continue
        text = (
            f"{feedback.name} follows {feedback.source}: feedback explains"
            f" {100.0 * feedback.share:.0f} % of the variance that the velocities do not explain,"
            " so that its effect cannot be identified from these logs"
        )
        yield make_finding(text, {"share": feedback.share, "effects": feedback.effect_share})


__all__ = [
    "FEEDBACK_SOURCES",
    "MAX_FEEDBACK_SHARE",
    "InputFeedback",
    "check_feedback",
    "cross_validated_r2",
    "detect_feedback",
    "find_relay_inputs",
    "response_time",
    "to_uniform_signals",
]
