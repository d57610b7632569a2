"""Checks of excitation: ranges and standstill; the condition number of several channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.stretches import find_runs
from residnet.preprocessing.channel_values import nan_quantiles
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    format_quantity,
    format_share,
)
from residnet.quality.statistics import LogStatistics, moving_average

# In the checks below `make_finding` is the registered check itself: called with a text, it creates
# a finding with the code, severity and action of the check as defaults.


@check("excitation", "range", "note")
def report_ranges(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report range and standard deviation of velocities and inputs."""
    for name in (*log.velocities, *log.inputs):
        values = log[name][np.isfinite(log[name])]
        unit = log.units[name]
        lower = float(values.min())
        upper = float(values.max())
        std = float(values.std())
        statistics = {"min": lower, "max": upper, "std": std}
        if std <= 1e-6 * max(abs(lower), abs(upper)):
            text = (
                f"{name} is constant at {format_quantity(lower, unit)}: its effect cannot be"
                " identified from this log only"
            )
            yield make_finding(text, statistics, code="constant")
            continue
        text = (
            f"{name} from {format_quantity(lower, unit)} to {format_quantity(upper, unit)},"
            f" standard deviation {format_quantity(std, unit)}"
        )
        yield make_finding(text, statistics)


def find_samples_at_rest(log: LogStatistics) -> np.ndarray:
    """Return [T] bool: samples at which the speed and the yaw rate, averaged over 2 s, are small.

    A mean is small if it is below 3 % of its 95 % quantile over the log, or below four standard
    errors of a mean of white noise.
    """
    n_samples = max(round(2.0 / log.sampling_interval), 5)
    is_at_rest = np.ones(len(log), dtype=bool)
    speeds = np.hypot(moving_average(log["u"], n_samples), moving_average(log["v"], n_samples))
    yaw_rates = np.abs(moving_average(log["r"], n_samples))
    noise_levels = np.hypot(log.noise_std("u"), log.noise_std("v")), log.noise_std("r")
    for values, noise_level in zip((speeds, yaw_rates), noise_levels, strict=True):
        quantile_95 = nan_quantiles(values, 0.95)[0]
        standard_error = noise_level / np.sqrt(n_samples)
        is_at_rest &= values < max(0.03 * quantile_95, 4.0 * standard_error)
    return is_at_rest


@check(
    "excitation",
    "standing",
    fix="exclude these parts: they hold noise only",
    required_channels=("u", "v", "r"),
)
def check_samples_at_rest(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report parts of a log in which the vessel is at rest."""
    is_at_rest = find_samples_at_rest(log)
    starts, stops = find_runs(is_at_rest)
    rest_share = float(is_at_rest.mean())
    durations = log.t[stops - 1] - log.t[starts]
    longest_segment = int(np.argmax(stops - starts)) if starts.size else 0
    if rest_share > 0.02 and durations[longest_segment] > 3.0:
        start_time = float(log.t[starts[longest_segment]])
        longest_duration = float(durations[longest_segment])
        text = (
            f"the vessel is at rest for {format_share(rest_share)} of the time, at most"
            f" {longest_duration:.1f} s without a break from t = {start_time:.2f} s"
        )
        severity: Level = "will mislead" if rest_share > 0.1 else "note"
        yield make_finding(
            text,
            {"share": rest_share, "longest": longest_duration, "t": start_time},
            level=severity,
            sample_mask=is_at_rest,
        )


def format_names(names: Sequence[str]) -> str:
    """Return the names in brackets, or their number if there are more than twelve."""
    return f"[{', '.join(names)}]" if len(names) <= 12 else f"{len(names)} channels"


def compute_condition_number(columns: np.ndarray, names: Sequence[str]) -> tuple[float, list[str]]:
    """Return the condition number of centred and scaled columns, and the most collinear ones.

    Args:
        columns: values of k channels at N samples [N, k].
        names: names of the columns.

    Returns:
        Ratio of the largest to the smallest singular value, and up to three names with the largest
        entries in the right singular vector of the smallest one.
    """
    column_std = np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    _, singular_values, singular_vectors = np.linalg.svd(
        (columns - columns.mean(axis=0)) / column_std, False
    )
    condition_number = float(
        singular_values[0]
        / max(singular_values[-1], 1e-16 * singular_values[0], np.finfo(float).tiny)
    )
    largest_indices = np.argsort(-np.abs(singular_vectors[-1]))[:3]
    return condition_number, [
        names[i] for i in largest_indices if abs(singular_vectors[-1][i]) > 0.2
    ]
