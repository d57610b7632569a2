"""Checks of a set of logs: copies, split runs, ranges, excitation, contradicting logs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from residnet.core.arrays.paged import MAX_SAMPLES_IN_MEMORY
from residnet.core.log import Log
from residnet.core.names import (
    POSE_NAMES,
    SET_POINT_CHANNELS,
    VELOCITY_NAMES,
    port_starboard_pairs,
)
from residnet.core.stretches import find_runs
from residnet.io.split import hash_rows, row_sampling_interval
from residnet.preprocessing.channel_values import estimate_noise_std, nan_std
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.consensus import (
    Consensus,
    find_consensus,
)
from residnet.quality.excitation import compute_condition_number, format_names
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    format_quantity,
    format_share,
)
from residnet.quality.outlier_causes import rank_hypotheses
from residnet.quality.statistics import (
    MIN_TURN_SHARE,
    MOTION_CHANNELS,
    SMOOTHING_SAMPLES,
    STEERING_CHANNELS,
    LogStatistics,
    compute_port_share,
    count_reversals,
    interpolate_gaps,
    moving_average,
)

# smallest number of consecutive equal rows that is no coincidence
_MIN_COPIED_ROWS = 20
_MIN_UNIX_TIME = 1e8
"""Time from which stamps are seconds since 1970."""


class LogSet:
    """Set of logs with the channels that all logs have in common.

    Args:
        logs: logs with increasing times.
        inputs: channels that drive the vessel; None takes all channels except states and
            accelerations.
        splits: name of a log -> train, validation or test, as far as a config defines it.
    """

    def __init__(
        self, logs: Sequence[Log], inputs: Sequence[str] | None, splits: Mapping[str, str]
    ) -> None:
        common_channels = set.intersection(*(set(log.channels) for log in logs))
        self.channels = [name for name in logs[0].channels if name in common_channels]
        input_names = self.channels if inputs is None else inputs
        self.inputs = [
            name
            for name in input_names
            if name in common_channels and name not in (*MOTION_CHANNELS, *SET_POINT_CHANNELS)
        ]
        self.logs = [LogStatistics(log, self.inputs) for log in logs]
        self.splits = splits

    @cached_property
    def consensus(self) -> Consensus | None:
        """Inliers and outliers of leave-one-log-out prediction; None without inputs or velocity."""
        if len(self.logs) < 2 or not self.inputs:
            return None
        logs = [with_derived_velocities(log) for log in self.logs]
        has_velocity = any(all(name in log for log in logs) for name in VELOCITY_NAMES)
        return find_consensus(logs, self.inputs) if has_velocity else None

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def split_conflict(self, *logs: LogStatistics) -> str:
        """Return the splits of logs joined by `and` if they are known and differ; else empty."""
        split_names = [self.splits.get(log.name, "") for log in logs]
        return " and ".join(split_names) if all(split_names) and len(set(split_names)) > 1 else ""


def with_derived_velocities(log: LogStatistics) -> LogStatistics:
    """Return a log with u and v derived from position and heading, unless it has u.

    The yaw rate is not derived: differences of smoothed headings flagged 3 of 12 good logs.
    """
    if "u" in log or len(log) < MIN_SAMPLES or not all(name in log for name in POSE_NAMES):
        return log
    ground_velocity = np.gradient(log.smoothed("x") + 1j * log.smoothed("y"), log.t)
    ground_velocity[log.near_seam(SMOOTHING_SAMPLES)] = np.nan
    known_rows = np.flatnonzero(np.isfinite(log["x"]))
    if known_rows.size:
        # a receiver without a fix at the start or the end is not at rest
        ground_velocity[: known_rows[0]] = np.nan
        ground_velocity[known_rows[-1] + 1 :] = np.nan
    body_velocity = ground_velocity * np.exp(-1j * log["psi"])
    derived_velocities = {"u": body_velocity.real, "v": body_velocity.imag}
    completed_log = log.log.replace(
        channels={**derived_velocities, **log.log.channels},
        units={**dict.fromkeys(derived_velocities, "m/s"), **log.units},
        meta={**log.log.meta, "derived": tuple(derived_velocities)},
    )
    return LogStatistics(completed_log, log.inputs)


@check("between", "copied_part", fix="exclude it, or put both into one split")
def check_copies(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report rows that occur in two logs, or at two places of one log."""
    # a log that was read alone has the same rows with another origin of the positions
    names = [name for name in logs.channels if name not in ("x", "y", "z")] or logs.channels
    # of very many rows a sample is compared; equal rows have equal hashes and are sampled together
    interval = row_sampling_interval([log.log for log in logs.logs])
    hashes = np.concatenate([hash_rows(log.log, names) for log in logs.logs])
    rows = np.flatnonzero(hashes % np.uint64(interval) == 0)
    _, first_places, inverse = np.unique(hashes[rows], return_index=True, return_inverse=True)
    sources = rows[first_places[inverse]]
    log_starts = np.cumsum([0, *map(len, logs.logs)])
    source_logs, copy_logs = np.searchsorted(log_starts, (sources, rows), side="right") - 1
    # a copy is a run of rows whose first occurrences are equally far away; those of frozen rows
    # become more distant, those of rows that are held for some samples alternate
    keys = np.stack((source_logs, copy_logs, rows - sources))
    labels = np.cumsum(np.diff(keys, axis=1, prepend=keys[:, :1]).any(axis=0))
    labels[rows == sources] = -1
    longest_runs: dict[tuple[int, int], tuple[int, int]] = {}
    for start, stop in zip(*find_runs(labels), strict=True):
        pair = int(source_logs[start]), int(copy_logs[start])
        longest_start, longest_stop = longest_runs.get(pair, (0, 0))
        if stop - start > max(longest_stop - longest_start, _MIN_COPIED_ROWS // interval - 1, 2):
            longest_runs[pair] = int(start), int(stop)
    for (i, j), (start, stop) in sorted(longest_runs.items()):
        n_copied = int(rows[stop - 1] - rows[start]) + 1
        first_row = int(sources[start] - log_starts[i])
        offset = int(rows[start] - log_starts[j]) - first_row
        figures = {"rows": n_copied, "first": first_row, "offset": offset}
        if i == j:
            text = (
                f"{logs.logs[i].name}: rows {first_row} to {first_row + n_copied - 1} are repeated"
                f" from row {first_row + offset} on"
            )
            yield make_finding(text, figures, code="repeated_block", fix="delete one of the copies")
        else:
            yield _describe_copy(logs, logs.logs[i], logs.logs[j], figures, make_finding)


def _describe_copy(
    logs: LogSet,
    a: LogStatistics,
    b: LogStatistics,
    figures: Mapping[str, float],
    make_finding: Check,
) -> Finding:
    """Return the finding on rows of log `a` that occur in log `b`.

    Args:
        logs: all logs, with their splits.
        a: log with the first copy.
        b: log with the second copy.
        figures: number of rows, number of the first one in `a`, and difference to that in `b`.
        make_finding: constructor of the finding.
    """
    n_copied = int(figures["rows"])
    split_conflict = logs.split_conflict(a, b)
    level: Level = "fatal" if split_conflict else "will mislead"
    if logs.splits and not {a.name, b.name} <= logs.splits.keys():
        # the config already excludes one of the logs
        level = "note"
    conflict_text = f" ({split_conflict})" if split_conflict else ""
    # of very many rows the first and the last one are not in the sample
    if n_copied >= 0.99 * max(len(a), len(b)):
        text = f"{a.name} and {b.name} are the same{conflict_text}"
        fix = "exclude one of them"
        return make_finding(text, figures, code="duplicate_log", level=level, fix=fix)
    first_row = int(figures["first"] + figures["offset"])
    if len(b) < len(a):
        a, b, first_row = b, a, int(figures["first"])
    text = (
        f"{a.name} is in {format_share(n_copied / len(a))} a copy of rows {first_row} to"
        f" {first_row + n_copied - 1} of {b.name}{conflict_text}"
    )
    return make_finding(text, figures, level=level)


@check(
    "between",
    "overlapping",
    "note",
    "two vessels, or two recordings of one run? put them into one split",
)
def check_recording_times(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs with one clock that overlap in time, or of which one continues the other."""
    ordered_logs = sorted(logs.logs, key=lambda log: float(log.t[0]))
    for i, a in enumerate(ordered_logs):
        # logs whose clocks start at zero have no common clock
        is_dated = a.t[0] > _MIN_UNIX_TIME
        for b in ordered_logs[i + 1 :]:
            pause = float(b.t[0] - a.t[-1])
            if pause >= 3.0 * a.sampling_interval:
                break
            if pause > 0.0 and b.t[0] > 2.0 * a.sampling_interval:
                split_conflict = logs.split_conflict(a, b)
                text = (
                    f"{b.name} continues where {a.name} ends, {pause:.2f} s later: a run that was"
                    " split into files"
                )
                text += f"; they belong to {split_conflict}" if split_conflict else ""
                fix = "put them into one split" if split_conflict or not logs.splits else ""
                yield make_finding(text, {"pause": pause}, code="continued", fix=fix)
            elif pause < 0.0 and is_dated:
                seconds = min(-pause, float(b.t[-1] - b.t[0]))
                text = f"{a.name} and {b.name} overlap in time for {seconds:.1f} s"
                yield make_finding(text, {"seconds": seconds})


_MIN_EQUAL_COMMANDS = 50
"""Smallest number of samples of logs with the same commands."""


@check(
    "between",
    "same_commands",
    "note",
    "repeated runs show the repeatability of the vessel; put them into one split",
)
def check_same_commands(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs with identical commands."""
    names = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    logs_by_first_commands: dict[bytes, list[LogStatistics]] = {}
    for log in logs.logs if names else ():
        first_commands = log.log.stack(names)[:_MIN_EQUAL_COMMANDS]
        if len(first_commands) == _MIN_EQUAL_COMMANDS:
            logs_by_first_commands.setdefault(first_commands.tobytes(), []).append(log)
    for group in logs_by_first_commands.values():
        for a, b in itertools.combinations(group, 2):
            n_common = min(len(a), len(b))
            moving_inputs = [name for name in names if nan_std(a[name][:n_common]) > 1e-9]
            commands, other_commands = (log.log.stack(moving_inputs)[:n_common] for log in (a, b))
            if not moving_inputs or not np.array_equal(commands, other_commands, equal_nan=True):
                continue
            split_conflict = logs.split_conflict(a, b)
            text = (
                f"{a.name} and {b.name} have the same commands ({', '.join(moving_inputs)}) over"
                f" {n_common} samples"
            )
            text += f" and belong to {split_conflict}" if split_conflict else ""
            yield make_finding(text, {"samples": n_common})


@check(
    "between",
    "extrapolation",
    fix="add training logs in this range, or do not use the model there",
)
def check_extrapolation(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report validation and test samples outside the range of the training logs."""
    training_logs = [log for log in logs.logs if logs.splits.get(log.name) == "train"]
    other_logs = [log for log in logs.logs if logs.splits.get(log.name) in ("validation", "test")]
    for name in logs.channels if training_logs and other_logs else ():
        if name in ("x", "y", "z", "psi"):
            continue
        unit = training_logs[0].units[name]
        lower = min(float(np.nanmin(log[name])) for log in training_logs)
        upper = max(float(np.nanmax(log[name])) for log in training_logs)
        margin = 0.02 * (upper - lower)
        for log in other_logs:
            values = log[name][np.isfinite(log[name])]
            share_outside = float(((values < lower - margin) | (values > upper + margin)).mean())
            if share_outside > 0.01:
                text = (
                    f"{name} of {log.name} ({logs.splits[log.name]}) lies outside the training"
                    f" range {format_quantity(lower, unit)} to {format_quantity(upper, unit)} for"
                    f" {format_share(share_outside)} of the time"
                )
                # an auxiliary channel does not drive the model
                is_used = name in MOTION_CHANNELS or name in logs.inputs
                level: Level = "will mislead" if share_outside > 0.25 and is_used else "note"
                yield make_finding(text, {"share": share_outside}, level=level)


_MIN_SPREAD = 1e-3
"""Relative standard deviation of an input below which it is constant."""


def _relative_spread(*value_arrays: np.ndarray) -> float:
    """Return the standard deviation of a channel beyond its noise, over its largest value."""
    finite_values = np.concatenate(value_arrays)
    finite_values = finite_values[np.isfinite(finite_values)]
    max_abs = float(np.abs(finite_values).max(initial=0.0))
    return (
        max(float(finite_values.std()) - 1.5 * estimate_noise_std(finite_values), 0.0) / max_abs
        if max_abs > 0.0
        else 0.0
    )


def _excitation_ratio(log: LogStatistics, name: str) -> float:
    """Return the standard deviation of a smoothed velocity over the smallest one that counts.

    Below 1 the velocity does not vary beyond its averaged noise.
    """
    n_samples = max(round(2.0 / log.sampling_interval), 5)
    smoothed_values = moving_average(log[name], n_samples)
    finite_values = smoothed_values[np.isfinite(smoothed_values)]
    speeds = np.hypot(log["u"], log["v"]) if "u" in log and "v" in log else np.zeros(1)
    min_std = np.radians(0.05) if name == "r" else 0.02 * float(np.abs(np.nanmean(speeds)))
    min_std = max(3.0 * log.noise_std(name) / np.sqrt(n_samples), min_std, 1e-9)
    return float(finite_values.std() / min_std) if finite_values.size >= 10 else 0.0


@check("between", "no_excitation", fix="record manoeuvres: zigzag, 3-2-1-1")
def check_excitation(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report missing or collinear excitation in the set of logs."""
    # do the vessels move, and turn to both sides?
    n_logs = len(logs.logs)
    velocities = [name for name in VELOCITY_NAMES if name in logs]
    subsamples = [log.subsample for log in logs.logs]
    excitation_by_velocity = {
        name: max(_excitation_ratio(log, name) for log in subsamples) for name in velocities
    }
    if excitation_by_velocity and max(excitation_by_velocity.values()) < 1.0:
        text = (
            f"no velocity varies beyond its noise in any of {n_logs} logs: a fit would learn"
            " only noise"
        )
        yield make_finding(
            text,
            {f"{n}_over_noise": ratio for n, ratio in excitation_by_velocity.items()},
            level="fatal",
        )
    elif logs.inputs and "r" in excitation_by_velocity:
        port_share = compute_port_share(subsamples)
        text = ""
        turning_side = "port" if port_share > 0.5 else "starboard"
        if excitation_by_velocity["r"] < 1.0:
            text = f"none of {n_logs} logs turns beyond its noise: steering cannot be learned"
        elif min(port_share, 1.0 - port_share) < MIN_TURN_SHARE:
            text = (
                f"all of {n_logs} logs turn to {turning_side}: turns to the other side are unknown"
            )
        if text:
            level: Level = "will mislead" if n_logs > 1 else "note"
            fix = "add turns to both sides: zigzag, 3-2-1-1"
            yield make_finding(text, {"port": port_share}, code="one_side", level=level, fix=fix)
    # do the inputs vary?
    driving_inputs = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    max_spread_within_logs = {
        name: max(_relative_spread(log[name]) for log in subsamples) for name in driving_inputs
    }
    spread_among_logs = {
        name: _relative_spread(*(log[name] for log in subsamples)) for name in driving_inputs
    }
    # inputs that are constant in each log but differ among logs carry information
    if (
        driving_inputs
        and max(max_spread_within_logs.values()) < _MIN_SPREAD
        and max(spread_among_logs.values()) <= 1e-2
    ):
        text = f"no input ({', '.join(driving_inputs)}) varies within any of {n_logs} logs"
        text += ": their effects cannot be identified"
        yield make_finding(text, {"spread": max(max_spread_within_logs.values())})
    constant_inputs = [
        name
        for name in driving_inputs
        if max(max_spread_within_logs[name], spread_among_logs[name]) < _MIN_SPREAD
    ]
    if constant_inputs:
        text = (
            f"{', '.join(constant_inputs)} never varies: its effect cannot be separated from a"
            " constant"
        )
        yield make_finding(
            text, {"count": len(constant_inputs)}, code="constant_inputs", level="note", fix=""
        )
    varying_channels = [
        name for name in (*velocities, *driving_inputs) if name not in constant_inputs
    ]
    # are velocities and inputs collinear? Evenly spread samples suffice for the condition number
    sample_stride = -(-sum(len(log) for log in subsamples) // MAX_SAMPLES_IN_MEMORY)
    columns = np.concatenate(
        [log.log.stack(varying_channels)[::sample_stride] for log in subsamples]
    )
    columns = columns[np.isfinite(columns).all(axis=1)]
    if (
        driving_inputs
        and len(varying_channels) > 1
        and columns.shape[0] >= 10 * len(varying_channels)
    ):
        condition_number, collinear_names = compute_condition_number(columns, varying_channels)
        text = (
            f"{n_logs} logs together: condition number of {format_names(varying_channels)}"
            f" {condition_number:.3g}"
        )
        if condition_number > 30.0:
            text += (
                f"; {', '.join(collinear_names)} are collinear: use one of them, or add manoeuvres"
                " that vary them separately"
            )
        yield make_finding(
            text, {"condition": condition_number}, code="condition", level="note", fix=""
        )


_MIN_SWING = math.radians(20.0)
"""Swing of a heading to both sides that was steered.

Gusts cause it in at most one of ten straight runs; in steered fleets at least three of ten logs do
it.
"""
_MIN_WEAVING_SHARE = 0.2
"""Share of logs with such a heading from which a vessel was steered."""


def find_dead_steering(logs: LogSet) -> list[str]:
    """Return steering records that are constant in every log though the headings swing.

    On a vessel with a propeller on either side, both steer.
    """
    pairs = port_starboard_pairs(logs.inputs)
    partners = pairs | {stbd: port for port, stbd in pairs.items()}
    steering = [name for name in logs.inputs if name in STEERING_CHANNELS or name in partners]
    varying = [
        name
        for name in steering
        if any(_relative_spread(log[name]) > _MIN_SPREAD for log in logs.logs)
    ]
    # another rudder may have steered
    if "r" not in logs or not {*STEERING_CHANNELS}.isdisjoint(varying):
        return []

    def is_weaving(log: LogStatistics) -> bool:
        integrated = np.cumsum(np.nan_to_num(log["r"])) * log.sampling_interval
        heading = interpolate_gaps(log.t, log["psi"]) if "psi" in log else integrated
        return count_reversals(heading, _MIN_SWING) >= 2

    if np.mean([is_weaving(log.subsample) for log in logs.logs]) < _MIN_WEAVING_SHARE:
        return []
    return [
        name
        for name in steering
        if name not in varying and (partners[name] in varying if name in partners else not varying)
    ]


@check("between", "contradicts_dead", fix="find the channel that holds the steering")
def check_dead_steering(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report steering records that are constant in every log though the vessel was steered."""
    for name in find_dead_steering(logs):
        yield make_finding(
            f"{name} is constant in every log while the heading swings by more than"
            f" {math.degrees(_MIN_SWING):.0f} deg to both sides: its record is dead"
        )


_MIN_DEVIANCE_DIFFERENCE = 3.84
"""Smallest difference of deviances of a significant change: 95 % quantile of chi-squared."""


@check("between", "contradicts", fix="")
def check_contradicting_logs(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs that a model of the other logs does not explain, with the likeliest cause."""
    if find_dead_steering(logs) or (consensus := logs.consensus) is None:
        # without the steering no log explains another
        return
    # no log is accused by a model that does not explain the agreeing logs
    adequate = consensus.adequate if consensus.outliers else None
    if adequate is None:
        return
    fleet = consensus.fleet
    n_inliers = len(consensus.inliers)
    for i in consensus.outliers:
        if not adequate.is_contradicting(i):
            continue
        log = fleet.logs[i]
        hypotheses = rank_hypotheses(consensus, i)
        hypothesis = hypotheses[0]
        unexplained = next(h for h in hypotheses if h.kind == "vessel")
        is_explained = hypothesis.deviance < unexplained.deviance - _MIN_DEVIANCE_DIFFERENCE
        split = logs.splits.get(log.name, "")
        # new inputs are no contradiction: the polynomial does not extrapolate
        if not is_explained and consensus.has_majority and consensus.is_only_extrapolating(i):
            text = (
                f"{log.name} has inputs outside the range of the {n_inliers} other logs"
                " that agree: they cannot confirm or contradict it"
            )
            yield make_finding(text, code="beyond_others", level="note")
            continue
        residual_ratio = consensus.compute_rmse_ratio(i)
        text = (
            f"{log.name}{f' ({split})' if split else ''}: a model of {n_inliers} other logs does"
            f" not explain its motion (RMSE {residual_ratio:.2g} times the usual one);"
            f" {hypothesis.text}"
        )
        if not consensus.has_majority:
            text += "; no more than half of the logs agree, so the other logs may be wrong"
        figures = {
            "left": residual_ratio,
            "size": hypothesis.size,
        }
        yield make_finding(
            text,
            figures,
            code=f"contradicts_{hypothesis.kind}",
            fix=_ACTIONS[hypothesis.kind],
        )


_ACTIONS = {
    "dead": "exclude this log, or restore the record",
    "scale": "correct its unit or scale in this log, or exclude it if an actuator had failed",
    "sign": "correct its sign in this log",
    "offset": "subtract the offset in this log",
    "late": "shift the clock of the inputs in this log",
    "exchanged": "exchange both columns in this log",
    "heading": "correct the heading, or the axes of the velocities, of this log",
    "current": "exclude it, provide the current as an input, or let the fit estimate it",
    "vessel": "exclude it, or fit it separately",
}
"""Kind of hypothesis -> recommended action."""
