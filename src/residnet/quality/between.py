"""Findings between logs: copies, one run in several files, ranges, excitation, logs apart."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from residnet.core.arrays.paged import MAX_SAMPLES_IN_MEMORY
from residnet.core.log import Log
from residnet.core.names import POSE_NAMES, VELOCITY_NAMES
from residnet.core.stretches import find_runs
from residnet.io.split import hash_rows, row_sampling_interval
from residnet.preprocessing.channel_values import estimate_noise_std, nan_median, nan_std
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.clock import MIN_UNIX_TIME
from residnet.quality.excitation import compute_condition_number, format_names
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    format_quantity,
    format_share,
)
from residnet.quality.others import Fleet, causes, nothing_steers
from residnet.quality.statistics import (
    MOTION_CHANNELS,
    LogStatistics,
    abs_quantile,
    moving_average,
)

# so many rows in a row that two logs share are no chance
_MIN_COPIED_ROWS = 20


class LogSet:
    """Logs that are examined beside each other; it contains the channels that all of them have.

    Args:
        logs: each with an increasing clock.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        splits: log's name -> train, validation or test, where a config says.
    """

    def __init__(
        self, logs: Sequence[Log], inputs: Sequence[str] | None, splits: Mapping[str, str]
    ) -> None:
        common_channels = set.intersection(*(set(log.channels) for log in logs))
        self.channels = [name for name in logs[0].channels if name in common_channels]
        input_names = self.channels if inputs is None else inputs
        self.inputs = [
            name for name in input_names if name in common_channels and name not in MOTION_CHANNELS
        ]
        self.logs = [LogStatistics(log, self.inputs) for log in logs]
        self.splits = splits

    @cached_property
    def fleet(self) -> Fleet | None:
        """The logs, each predicted by a model of the others; None where that cannot be."""
        if len(self.logs) < 2 or not self.inputs:
            return None
        logs = [with_derived_velocities(log) for log in self.logs]
        has_velocity = any(all(name in log for log in logs) for name in VELOCITY_NAMES)
        return Fleet(logs, self.inputs) if has_velocity else None

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def split_conflict(self, *logs: LogStatistics) -> str:
        """Return the splits of logs where these are known and differ."""
        split_names = [self.splits.get(log.name, "") for log in logs]
        return " and ".join(split_names) if all(split_names) and len(set(split_names)) > 1 else ""


def with_derived_velocities(log: LogStatistics) -> LogStatistics:
    """Return a log with the velocities that its position and heading tell; others as they are.

    A yaw rate is none of them: differences of smoothed headings accused 3 of 12 good logs.
    """
    if "u" in log or len(log) < MIN_SAMPLES or not all(name in log for name in POSE_NAMES):
        return log
    ground_velocity = np.gradient(log.smoothed("x") + 1j * log.smoothed("y"), log.t)
    body_velocity = ground_velocity * np.exp(-1j * log["psi"])
    derived_velocities = {"u": body_velocity.real, "v": body_velocity.imag}
    completed_log = log.log.replace(
        channels={**derived_velocities, **log.log.channels},
        units={**dict.fromkeys(derived_velocities, "m/s"), **log.units},
        meta={**log.log.meta, "derived": tuple(derived_velocities)},
    )
    return LogStatistics(completed_log, log.inputs)


@check("between", "copied_part", fix="leave it out, or keep both in one split")
def check_copies(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report stretches that two logs, or two places of one log, have in common."""
    velocities = [name for name in VELOCITY_NAMES if name in logs]
    names = velocities if len(velocities) > 1 else sorted(logs.channels)
    candidate_logs = [log.log for log in logs.logs]
    if names and (sampling_interval := row_sampling_interval(candidate_logs)) > 1:
        # of very many rows a sample tells which logs have some in common
        # of equal rows all are in it, or none
        hashes_by_log = (hash_rows(log, names) for log in candidate_logs)
        sampled_hashes = [
            hashes[hashes % np.uint64(sampling_interval) == 0] for hashes in hashes_by_log
        ]
        rows, n_occurrences = np.unique(np.concatenate(sampled_hashes), return_counts=True)
        shared_hashes = rows[(n_occurrences > 1) & (n_occurrences <= 2 * len(candidate_logs))]
        may_share_rows = [
            int(np.isin(hashes_of_log, shared_hashes).sum()) * sampling_interval >= _MIN_COPIED_ROWS
            for hashes_of_log in sampled_hashes
        ]
        candidate_logs = list(itertools.compress(candidate_logs, may_share_rows))
    if not names or not candidate_logs:
        return
    # rows are hashed one by one, so that all logs are hashed at once
    joined_log = Log(
        "together",
        np.concatenate([log.t for log in candidate_logs]),
        {name: np.concatenate([log[name] for log in candidate_logs]) for name in names},
        candidate_logs[0].units,
    )
    hashes = np.split(
        hash_rows(joined_log, names), np.cumsum([len(log) for log in candidate_logs])[:-1]
    )
    log_indices = np.repeat(
        np.arange(len(candidate_logs)), [hashes_of_log.size for hashes_of_log in hashes]
    )
    row_indices = np.concatenate([np.arange(hashes_of_log.size) for hashes_of_log in hashes])
    _, hash_indices, n_occurrences = np.unique(
        np.concatenate(hashes), return_inverse=True, return_counts=True
    )
    # rows that stand in many places are those of a vessel at rest
    shared_rows = np.flatnonzero(
        (n_occurrences[hash_indices] > 1) & (n_occurrences[hash_indices] <= 2 * len(candidate_logs))
    )
    shared_rows = shared_rows[np.argsort(hash_indices[shared_rows], kind="stable")]
    rows_by_pair: dict[tuple[int, int, int], list[int]] = {}
    for _, equal_rows in itertools.groupby(
        shared_rows.tolist(), key=lambda i: int(hash_indices[i])
    ):
        for i, j in itertools.combinations(sorted(equal_rows), 2):
            key = int(log_indices[i]), int(log_indices[j]), int(row_indices[j] - row_indices[i])
            rows_by_pair.setdefault(key, []).append(int(row_indices[i]))
    records = {log.name: log for log in logs.logs}
    for (i, j, offset), shared_places in sorted(rows_by_pair.items()):
        is_shared = np.zeros(len(candidate_logs[i]) + 1, dtype=bool)
        is_shared[shared_places] = True
        starts, stops = find_runs(is_shared)
        longest_segment = int(np.argmax(stops - starts))
        n_copied, start = (
            int(stops[longest_segment] - starts[longest_segment]),
            int(starts[longest_segment]),
        )
        if n_copied < _MIN_COPIED_ROWS or (i == j and offset == 1):
            continue
        figures = {"rows": n_copied, "first": start, "offset": offset}
        a, b = candidate_logs[i], candidate_logs[j]
        if i == j:
            text = (
                f"{a.name}: rows {start} to {start + n_copied - 1} stand again from row"
                f" {start + offset} on"
            )
            yield make_finding(text, figures, code="repeated_block", fix="delete one of the copies")
            continue
        split_conflict = logs.split_conflict(records[a.name], records[b.name])
        level: Level = "fatal" if split_conflict else "will mislead"
        if logs.splits and not {a.name, b.name} <= logs.splits.keys():
            # the config leaves one of them out already
            level = "note"
        conflict_text = f" ({split_conflict})" if split_conflict else ""
        if n_copied >= max(len(a), len(b)) - 1:
            text, fix = (
                f"{a.name} and {b.name} are the same{conflict_text}",
                "leave one of them out",
            )
            yield make_finding(text, figures, code="duplicate_log", level=level, fix=fix)
            continue
        first_row = start + offset
        if len(b) < len(a):
            a, b, first_row = b, a, start
        text = (
            f"{a.name} is in {format_share(n_copied / len(a))} a copy of rows {first_row} to"
            f" {first_row + n_copied - 1} of {b.name}{conflict_text}"
        )
        yield make_finding(text, figures, level=level)


_COMPARED_STATES = ("x", "y", "u", "v", "r")


@check("between", "continued", "note")
def check_continued_logs(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report a log that goes on where another ended: one run, cut into files."""
    is_comparable = [
        len(log) >= 20 and sum(n in log for n in _COMPARED_STATES) >= 4 for log in logs.logs
    ]
    if sum(is_comparable) < 2:
        return

    def compute_per_log(statistic: Callable[[np.ndarray], float]) -> np.ndarray:
        """Return a figure of each log and state [L, 5], NaN where it is not measured."""
        return np.array(
            [
                [statistic(log[n]) if n in log else np.nan for n in _COMPARED_STATES]
                for log in logs.logs
            ]
        )

    initial_states, final_states = (
        compute_per_log(lambda x: float(x[:3].mean())),
        compute_per_log(lambda x: float(x[-3:].mean())),
    )
    noise_levels, high_levels = (
        compute_per_log(estimate_noise_std),
        compute_per_log(lambda x: float(abs_quantile(x, 0.9))),
    )
    typical_changes = compute_per_log(lambda x: nan_median(np.abs(np.diff(x))))
    for i, a in enumerate(logs.logs):
        normalized_differences = np.abs(initial_states - final_states[i]) / np.maximum(
            typical_changes[i] + noise_levels[i] + noise_levels, 1e-12
        )
        max_differences = np.nan_to_num(
            np.max(np.where(np.isnan(normalized_differences), 0.0, normalized_differences), axis=1)
        )
        for j in np.flatnonzero(max_differences <= 30.0):
            b = logs.logs[j]
            if j == i or not (is_comparable[i] and is_comparable[j]):
                continue
            pause_duration, start_offset = float(b.t[0] - a.t[-1]), float(abs(b.t[0]))
            is_contiguous = (
                min(abs(a.t[-1]), start_offset) > 2.0 * a.sampling_interval
                and 0.0 < pause_duration < 3.0 * a.sampling_interval
            )
            # where both are at rest nothing tells one quay from another
            is_at_rest = math.hypot(*final_states[i, 2:4]) < 0.2 * math.hypot(*high_levels[i, 2:4])
            has_restarted_clock = (
                abs(b.t[0] - a.t[0]) <= 1e-9 or b.t[0] <= 2.0 * a.sampling_interval
            )
            if not is_contiguous and (
                not has_restarted_clock or max_differences[j] > 8.0 or is_at_rest
            ):
                continue
            split_conflict = logs.split_conflict(a, b)
            text = f"{b.name} goes on where {a.name} ends"
            text += (
                f", {pause_duration:.2f} s later: one run, cut into files" if is_contiguous else ""
            )
            text += f"; they stand in {split_conflict}" if split_conflict else ""
            fix = "keep them in one split" if split_conflict or not logs.splits else ""
            yield make_finding(text, {"pause": pause_duration}, fix=fix)


@check(
    "between",
    "overlapping",
    "note",
    "two vessels, or two recordings of one run? keep them in one split",
)
def check_overlapping_logs(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs of the same time."""
    start_times, end_times = np.array([(log.t[0], log.t[-1]) for log in logs.logs]).T
    for i, a in enumerate(logs.logs if float(end_times.max()) > MIN_UNIX_TIME else ()):
        overlap_durations = np.minimum(a.t[-1], end_times[i + 1 :]) - np.maximum(
            a.t[0], start_times[i + 1 :]
        )
        is_dated = np.minimum(a.t[0], start_times[i + 1 :]) > MIN_UNIX_TIME
        for j in np.flatnonzero(is_dated & (overlap_durations > 0.0)).tolist():
            b, overlap_duration = logs.logs[i + 1 + j], float(overlap_durations[j])
            yield make_finding(
                f"{a.name} and {b.name} overlap in time for {overlap_duration:.1f} s",
                {"seconds": overlap_duration},
            )


_COMPARED_ROWS = 50 * 4 ** np.arange(12) - 1
"""Rows whose commands tell most logs apart: a manoeuvre may begin with a rest."""


@check(
    "between",
    "same_commands",
    "note",
    "repeats show how far the vessel repeats itself; keep them in one split",
)
def check_same_commands(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs with the same commands."""
    names = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    sampled_commands = np.full((len(logs.logs), len(names), _COMPARED_ROWS.size), np.nan)
    for i, log in enumerate(logs.logs if names else ()):
        sampled_rows = _COMPARED_ROWS[len(log) > _COMPARED_ROWS]
        sampled_commands[i, :, : sampled_rows.size] = [log[name][sampled_rows] for name in names]
    is_close = functools.partial(np.isclose, rtol=1e-6, atol=1e-9)
    for i, a in enumerate(logs.logs if names else ()):
        later_commands = sampled_commands[i + 1 :]
        # what rests while both last tells nothing
        is_changing = (np.abs(np.diff(sampled_commands[i])) > 0.0) & np.isfinite(
            later_commands[..., 1:]
        )
        is_different = (
            ~is_close(sampled_commands[i], later_commands)
            & np.isfinite(sampled_commands[i] - later_commands)
            & is_changing.any(-1, keepdims=True)
        )
        for b in itertools.compress(logs.logs[i + 1 :], ~is_different.any(axis=(1, 2))):
            n_common = min(len(a), len(b))
            moving_inputs = [name for name in names if nan_std(a[name][:n_common]) > 1e-9]
            command_pairs = ((a[name][:n_common], b[name][:n_common]) for name in moving_inputs)
            if (
                n_common < 50
                or not moving_inputs
                or not all(
                    is_close(*command_pair, equal_nan=True).all() for command_pair in command_pairs
                )
            ):
                continue
            split_conflict = logs.split_conflict(a, b)
            text = (
                f"{a.name} and {b.name} have the same commands ({', '.join(moving_inputs)}) over {n_common}"
                " samples"
            )
            text += f" and stand in {split_conflict}" if split_conflict else ""
            yield make_finding(text, {"samples": n_common})


@check(
    "between",
    "extrapolation",
    fix="add training logs that go there, or do not trust the model there",
)
def check_extrapolation(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report how much of the other logs lies outside what the training logs cover."""
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
                    f" range {format_quantity(lower, unit)} to {format_quantity(upper, unit)} for {format_share(share_outside)} of the"
                    " time"
                )
                level: Level = "will mislead" if share_outside > 0.25 else "note"
                yield make_finding(text, {"share": share_outside}, level=level)


def _relative_spread(*value_arrays: np.ndarray) -> float:
    """Return the spread of a channel over its size, beyond its noise."""
    finite_values = np.concatenate(value_arrays)
    finite_values = finite_values[np.isfinite(finite_values)]
    max_abs = float(np.abs(finite_values).max(initial=0.0))
    return (
        max(float(finite_values.std()) - 1.5 * estimate_noise_std(finite_values), 0.0) / max_abs
        if max_abs > 0.0
        else 0.0
    )


_MIN_TURN_SHARE = 0.05
"""Share of turning below which only noise and overshoots turn to a side: .0001 in circles behind
a straight run, .3 and more in zigzags and random steps of five vessels."""


def _excitation_ratio(log: LogStatistics, name: str) -> float:
    """Return the spread of a velocity over the least that counts; below 1 it does not vary.

    Only what its averaged noise does not explain counts.
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
    """Report whether a fit to all logs together has something to learn from."""
    n_logs, velocities = len(logs.logs), [name for name in VELOCITY_NAMES if name in logs]
    subsamples = [log.subsample for log in logs.logs]
    excitation_by_velocity = {
        name: max(_excitation_ratio(log, name) for log in subsamples) for name in velocities
    }
    if excitation_by_velocity and max(excitation_by_velocity.values()) < 1.0:
        text = (
            f"no velocity varies beyond its noise in any of {n_logs} logs: a fit would find nothing"
            " but noise"
        )
        yield make_finding(
            text,
            {f"{n}_over_noise": ratio for n, ratio in excitation_by_velocity.items()},
            level="fatal",
        )
    elif logs.inputs and "r" in excitation_by_velocity:
        smoothed_rates = [
            moving_average(log["r"], max(round(2.0 / log.sampling_interval), 5))
            for log in subsamples
        ]
        yaw_rates = np.concatenate(smoothed_rates)
        port_share = float(
            np.nansum(np.abs(yaw_rates[yaw_rates < 0.0])) / np.nansum(np.abs(yaw_rates))
        )
        text, turning_side = "", "port" if port_share > 0.5 else "starboard"
        if excitation_by_velocity["r"] < 1.0:
            text = f"none of {n_logs} logs turns beyond its noise: nothing is learned of steering"
        elif min(port_share, 1.0 - port_share) < _MIN_TURN_SHARE:
            text = (
                f"all of {n_logs} logs turn to {turning_side}: how it turns to the other is unknown"
            )
        if text:
            level: Level = "will mislead" if n_logs > 1 else "note"
            fix = "add turns to both sides: zigzag, 3-2-1-1"
            yield make_finding(text, {"port": port_share}, code="one_side", level=level, fix=fix)
    driving_inputs = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    max_spread_within_logs = {
        name: max(_relative_spread(log[name]) for log in subsamples) for name in driving_inputs
    }
    spread_among_logs = {
        name: _relative_spread(*(log[name] for log in subsamples)) for name in driving_inputs
    }
    # constant in each, but not the same in all, tells something
    if (
        driving_inputs
        and max(max_spread_within_logs.values()) < 1e-3
        and max(spread_among_logs.values()) <= 1e-2
    ):
        text = f"no input ({', '.join(driving_inputs)}) varies within any of {n_logs} logs"
        text += ": what they do cannot be identified"
        yield make_finding(text, {"spread": max(max_spread_within_logs.values())})
    constant_inputs = [
        name
        for name in driving_inputs
        if max(max_spread_within_logs[name], spread_among_logs[name]) < 1e-3
    ]
    if constant_inputs:
        text = f"{', '.join(constant_inputs)} never varies: its effect cannot be separated from a constant"
        yield make_finding(
            text, {"count": len(constant_inputs)}, code="constant_inputs", level="note", fix=""
        )
    varying_channels = [
        name for name in (*velocities, *driving_inputs) if name not in constant_inputs
    ]
    # of very many samples evenly spread ones tell the same
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
        text = f"{n_logs} logs together: condition number of {format_names(varying_channels)} {condition_number:.3g}"
        if condition_number > 30.0:
            text += (
                f"; {', '.join(collinear_names)} move together: give one of them, or add manoeuvres that move"
                " them apart"
            )
        yield make_finding(
            text, {"condition": condition_number}, code="condition", level="note", fix=""
        )


@check("between", "contradicts", fix="")
def check_contradicting_logs(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report logs that a model of the others does not explain, and what would explain them."""
    fleet = logs.fleet
    if fleet is None:
        return
    for name in (dead_steering := nothing_steers(fleet))[0]:
        text = (
            f"{name} rests in every log, and {format_share(dead_steering[1])} of how the yaw rate changes is"
            " explained by nothing that was recorded: its record is dead"
        )
        fix = "find the channel that holds the steering"
        yield make_finding(
            text, {"unexplained": dead_steering[1]}, code="contradicts_dead", fix=fix
        )
    if dead_steering[0]:
        # without the steering no log explains another
        return
    n_inliers = len(fleet.core)
    for i in fleet.apart:
        log, likeliest_hypothesis = fleet.logs[i], causes(fleet, i)[0]
        split = logs.splits.get(log.name, "")
        if likeliest_hypothesis.kind == "vessel" and fleet.agreed and fleet.goes_beyond(i):
            text = (
                f"{log.name} goes beyond the inputs of the {n_inliers} other logs that agree: they"
                " cannot tell whether it is right"
            )
            yield make_finding(text, code="beyond_others", level="note")
            continue
        residual_ratio = float(np.nanmax(fleet.scores(fleet.core, [i])[i].left))
        text = (
            f"{log.name}{f' ({split})' if split else ''}: a model of {n_inliers} other logs does not"
            f" explain its motion ({residual_ratio:.2g} times what it leaves of them); {likeliest_hypothesis.text}"
        )
        if not fleet.agreed:
            text += "; no more than half of the logs agree, so that it may be the others"
        figures = {
            "left": residual_ratio,
            "size": likeliest_hypothesis.size,
            "effect": fleet.harm(i),
        }
        yield make_finding(
            text,
            figures,
            code=f"contradicts_{likeliest_hypothesis.kind}",
            fix=_ACTIONS[likeliest_hypothesis.kind],
        )


_ACTIONS = {
    "dead": "leave this log out, or restore the record",
    "scale": "correct its unit or scale in this log, or leave it out if an actuator had failed",
    "sign": "correct its sign in this log",
    "offset": "take the offset off in this log",
    "late": "shift the clock of the inputs in this log",
    "exchanged": "exchange both columns in this log",
    "heading": "correct the heading, or the axes of the velocities, of this log",
    "current": "leave it out, give the current as an input, or let the fit estimate it",
    "vessel": "leave it out, or fit it alone",
}
"""What explains a log -> what to do."""


@check(
    "between",
    "dead_commands",
    "note",
    fix="a fit leaves these stretches out (prepare.dead_commands: keep would keep them)",
)
def check_unexplained_idle(logs: LogSet, make_finding: Check) -> Iterator[Finding]:
    """Report motion that no recorded input explains while all of them rest."""
    fleet = logs.fleet
    idle_segments = (
        [(i, *segment) for i in fleet.told for segment in fleet.rests(i)] if fleet else []
    )
    for i, start, stop in idle_segments:
        log = logs.logs[i]
        text = (
            f"{log.name}: from t = {log.t[start]:.1f} to {log.t[stop]:.1f} s all inputs rest and"
            " the vessel moves as none of the other logs explains: a hand on the wheel, or a dead"
            " record"
        )
        yield make_finding(text, {"t": log.t[start], "seconds": log.t[stop] - log.t[start]})
