"""Reader of trips with several files from different recorders, which become one log."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Seconds
from residnet.core.errors import DataError, ResidnetError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Level, Log, Remark, make_remark
from residnet.core.names import STATE_NAMES
from residnet.io.readers.base import ConfiguredReader, hash_files, require_file
from residnet.io.readers.tables import (
    TABLE_KINDS,
    CsvConfig,
    ExcelConfig,
    JsonLinesConfig,
    ParquetConfig,
)
from residnet.io.readers.timestamps import detect_unix_unit
from residnet.preprocessing.align import GridConfig, resample_at
from residnet.preprocessing.compatibility.clock import ClockEstimate, estimate_clock_from_rate
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.preprocessing.statistics import OverlappingBlocks

_MIN_CROPPED_SHARE = 0.5
"""Smallest overlap to which a joined log is cropped, as share of the log with the motion."""
_MIN_OVERLAP = 0.5
"""Smallest overlap of two logs while a clock offset is searched, as share of the shorter one."""
_COARSE_STEP = 0.5
"""Step in s of the coarse search of a clock offset."""
_FINE_STEP = 0.05
"""Step in s of the fine search around the optimum of the coarse one."""
_MIN_VARIANCE_RATIO = 1.5
"""Smallest ratio of unexplained variances, of the best alternative offset to the optimum."""
_MIN_ALTERNATIVE_OFFSET = 3.0
"""Smallest distance in s of an alternative offset from the optimum."""
_BLOCK_SECONDS = 2.5
"""Length in s of the blocks whose change of velocity is explained; derivatives are too noisy."""
_MIN_TURN_MARGIN = 8.0
"""Smallest log-likelihood ratio of an offset from turns to the next best one."""
_MIN_TURN_CORRELATION = 0.7
"""Smallest correlation of a yaw rate with the derivative of the heading on another clock."""
_MAX_SAMPLES = 3000
"""Largest number of samples of the motion for the search."""

TableKind = CsvConfig | ParquetConfig | ExcelConfig | JsonLinesConfig


class ClockOffset(NamedTuple):
    """Estimated offset between two clocks.

    Attributes:
        seconds: time in s to add to the other clock.
        explained_share: share (0 to 1) of the residual variance of the motion model that the other
            log's channels explain with this offset.
        runner_up_share: the same share for the best offset at a distance from this one.
    """

    seconds: float
    explained_share: float
    runner_up_share: float


@final
class JoinedConfig(ConfiguredReader):
    """Reader of trips whose files differ in one word of their names: gnss_1.csv, motors_1.csv.

    The first part has the motion; its file gives the log its name and its clock. Channels of other
    parts are resampled to this clock: averaged from a higher rate, held from a lower rate.

    Attributes:
        parts: word in the file name -> reader of these files, the motion first.
        shift: word -> time in s to add to the clock of this part. Parts without an entry are joined
            by their dates or Unix times, otherwise by the estimated clock offset.
    """

    kind: Literal["joined"] = "joined"
    parts: dict[str, TableKind] = Field(min_length=2)
    shift: dict[str, Seconds] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _validate_shift_keys(self) -> JoinedConfig:
        secondary_parts = list(self.parts)[1:]
        if unknown_parts := set(self.shift) - set(secondary_parts):
            raise ValueError(
                f"shift: '{min(unknown_parts)}' is no part with a clock offset (expected one of"
                f" {', '.join(secondary_parts)})"
            )
        return self

    def select_logs(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files with the motion, one per trip."""
        main_word, *secondary_words = self.parts
        reader_kind = self.parts[main_word].kind
        return [
            path
            for path in paths
            if main_word in path.name
            and not any(part_name in path.name for part_name in secondary_words)
            and TABLE_KINDS.get(path.suffix.lower(), "csv") == reader_kind
        ]

    def list_member_files(self, path: Path) -> list[Path]:
        """Return all files of a trip, from its file with the motion."""
        return [*self.find_trip_files(path).values()]

    def find_trip_files(self, path: Path) -> dict[str, Path]:
        """Return word -> file of a trip, from its file with the motion.

        Raises:
            UsageError: if the file does not exist.
            DataError: if its name lacks the word, or another file of the trip is missing.
        """
        require_file(path)
        main_word, *secondary_words = self.parts
        prefix, matched_word, suffix = path.name.rpartition(main_word)
        if not matched_word:
            raise DataError(
                f"{path}: the file name does not contain '{main_word}'; give the files with the"
                f" motion, the files of {', '.join(secondary_words)} are found from them"
            )
        trip_files = {main_word: path}
        for part_name in secondary_words:
            candidate = path.with_name(f"{prefix}{part_name}{suffix}")
            if not candidate.is_file():
                # the part of another recorder may have another extension
                pattern = f"{glob.escape(candidate.stem)}.*"
                candidates = sorted(path.parent.glob(pattern))
                candidate = candidates[0] if len(candidates) == 1 else candidate
            if not candidate.is_file():
                raise DataError(
                    f"{path}: {candidate.name} is missing in its folder; leave the trip out"
                )
            trip_files[part_name] = candidate
        return trip_files

    def read(self, path: Path) -> Log:
        """Read one trip; see `LogReader.read`."""
        files = self.find_trip_files(path)
        logs = {
            part_name: self.parts[part_name].build().read(file) for part_name, file in files.items()
        }
        main_word, *secondary_words = logs
        log = logs[main_word]
        # parts with dates first: their channels help to estimate the offsets of the others
        for part_name in sorted(
            secondary_words, key=lambda word: _offset_from_dates(log, logs[word]) is None
        ):
            log = self._merge_channels(log, logs[part_name], part_name)
        checksums = {part_name: hash_files([file]) for part_name, file in files.items()}
        meta = {**log.meta, "sha256": hash_files(list(files.values())), "parts": checksums}
        return log.replace(meta=meta)

    def _merge_channels(self, log: Log, other_log: Log, part_name: str) -> Log:
        """Return a log with the additional channels of another log, resampled to its clock.

        Args:
            log: log with the motion.
            other_log: log of another part.
            part_name: name of this part.

        Raises:
            DataError: if the other log has no new channel, or the clocks do not overlap.
        """
        new_channels = {
            n: values for n, values in other_log.channels.items() if n not in log.channels
        }
        if not new_channels:
            raise DataError(
                f"log {log.name}: the channels {', '.join(other_log.channels)} of {part_name} exist"
                " already; leave this part out"
            )
        t, offset_remark = self._convert_times(log, other_log, new_channels, part_name)
        step = float(np.median(np.diff(log.t)))
        in_overlap = (log.t >= t[0]) & (log.t <= t[-1])
        if in_overlap.sum() < 2:
            raise DataError(
                f"log {log.name}: the times run from {log.t[0]:.1f} to {log.t[-1]:.1f} s, those of"
                f" {part_name} from {t[0]:.1f} to {t[-1]:.1f} s; set `shift: {{{part_name}: ...}}`"
            )
        hold_names = tuple(new_channels) if float(np.median(np.diff(t))) > step else ()
        resampled = resample_at(
            other_log.replace(t=t, channels=new_channels),
            GridConfig(step=step, held=hold_names),
            log.t,
        )
        findings = [
            *log.meta.get("findings", ()),
            *other_log.meta.get("findings", ()),
            offset_remark,
        ]
        joined_log = log.replace(
            channels={**log.channels, **{name: resampled[name] for name in new_channels}},
            units={**log.units, **{name: other_log.units[name] for name in new_channels}},
            meta={**log.meta, "findings": findings},
        )
        # one recorder usually starts before the other one; a short part ends no log
        is_cropped = in_overlap.mean() > _MIN_CROPPED_SHARE
        return joined_log.select_rows(in_overlap) if is_cropped else joined_log

    def _convert_times(
        self,
        log: Log,
        other_log: Log,
        new_channels: Mapping[str, np.ndarray],
        part_name: str,
    ) -> tuple[np.ndarray, Remark]:
        """Return the times [T] of another log on the clock of the log with the motion.

        The offset is as configured, or follows from a heading and a yaw rate in different files,
        from dates, or from the accelerations that the commands explain.

        Args:
            log: log with the motion.
            other_log: log of another part.
            new_channels: channels of the other log that the log lacks.
            part_name: name of this part.

        Returns:
            The times, and a remark about their source.
        """
        configured_shift = self.shift.get(part_name)
        if configured_shift is not None:
            text = f"{part_name}: clock offset {configured_shift:g} s (configured)"
            return other_log.t + configured_shift, make_remark("note", "joined", text)
        date_offset = _offset_from_dates(log, other_log)
        turn_estimate = estimate_clock_from_turns(log, other_log)
        if turn_estimate is not None:
            text = (
                f"{part_name}: clock offset {turn_estimate.seconds:+.3f} s, standard error"
                f" {turn_estimate.standard_error:.2g} s, from yaw rate against heading (correlation"
                f" {turn_estimate.correlation:.3f}, margin to the next best offset"
                f" {turn_estimate.margin:.0f})"
            )
            if abs(turn_estimate.drift) > 1e-5:
                text += f", drift {1e6 * turn_estimate.drift:+.0f} ppm"
            difference = 0.0 if date_offset is None else date_offset - turn_estimate.seconds
            if abs(difference) > _COARSE_STEP:
                text += f"; the dates of both files differ from it by {difference:+.2f} s"
            figures = turn_estimate._asdict()
            remark = make_remark("note", "joined", text, **figures)
            return turn_estimate.convert_times(other_log.t), remark
        shift, remark = self._choose_clock_offset(
            log, other_log.replace(channels=dict(new_channels)), part_name, date_offset
        )
        return other_log.t + shift, remark

    def _choose_clock_offset(
        self, log: Log, other_log: Log, part_name: str, date_offset: float | None
    ) -> tuple[float, Remark]:
        """Choose the offset between two clocks from dates, or estimate it.

        Args:
            log: log with the motion.
            other_log: log of another part.
            part_name: name of this part.
            date_offset: offset from the dates of both logs; None if they have none.

        Returns:
            The time in s to add to the other clock, and a remark, which is a warning if the offset
            is ambiguous or contradicts the dates.
        """
        advice = f"set `shift: {{{part_name}: ...}}`"
        try:
            estimate = estimate_clock_offset(log, other_log)
        except ResidnetError as error:
            if date_offset is not None:
                return date_offset, make_remark(
                    "note", "joined", f"{part_name}: joined by the dates of both"
                )
            text = (
                f"{part_name}: the clock offset cannot be estimated ({error}); both files are"
                f" assumed to start at the same time: {advice}"
            )
            return float(log.t[0] - other_log.t[0]), make_remark("will mislead", "joined", text)
        # keys of the log's meta, which stay as they were in earlier versions
        offset_figures = {
            "seconds": estimate.seconds,
            "explained": estimate.explained_share,
            "other": estimate.runner_up_share,
        }
        is_unambiguous = 1.0 - estimate.runner_up_share >= _MIN_VARIANCE_RATIO * (
            1.0 - estimate.explained_share
        )
        explanation = (
            f"R² {estimate.explained_share:.2f} of the residual accelerations, at most"
            f" {estimate.runner_up_share:.2f} at other offsets"
        )
        if date_offset is not None and (
            not is_unambiguous or abs(estimate.seconds - date_offset) < _COARSE_STEP
        ):
            text = f"{part_name}: joined by the dates of both"
            return date_offset, make_remark("note", "joined", text, **offset_figures)
        if date_offset is not None:
            text = (
                f"{part_name}: joined by the dates of both, which differ by"
                f" {date_offset - estimate.seconds:+.2f} s from the estimated offset"
                f" ({explanation}): one of the clocks is wrong, {advice}"
            )
            return date_offset, make_remark("will mislead", "joined", text, **offset_figures)
        text = f"{part_name}: estimated clock offset {estimate.seconds:+.2f} s ({explanation})"
        text += "" if is_unambiguous else f"; the offset is ambiguous, {advice}"
        level: Level = "note" if is_unambiguous else "will mislead"
        return estimate.seconds, make_remark(level, "joined", text, **offset_figures)


def _offset_from_dates(log: Log, other_log: Log) -> float | None:
    """Return the time in s to add to another log's clock by dates or Unix times.

    None if a log has no dates, or the logs do not overlap.
    """
    first_epoch, second_epoch = (
        item.meta.get("epoch", item.t[0] if detect_unix_unit(item.t) == "s" else None)
        for item in (log, other_log)
    )
    if first_epoch is None or second_epoch is None:
        return None
    epoch_difference = float(second_epoch) - float(first_epoch)
    if not other_log.t[0] - other_log.t[-1] < epoch_difference < log.t[-1] - log.t[0]:
        return None
    return epoch_difference + float(log.t[0] - other_log.t[0])


def estimate_clock_from_turns(log: Log, other_log: Log) -> ClockEstimate | None:
    """Estimate the time to add to another clock if both logs have a heading or a yaw rate.

    Returns:
        The estimate; None without these channels, or if the turns do not determine the offset.
    """
    if not ({"psi", "r"} & log.channels.keys() and {"psi", "r"} & other_log.channels.keys()):
        return None
    heading = unwrap_angle(log["psi"]) if "psi" in log.channels else _integrate(log.t, log["r"])
    if "r" in other_log.channels:
        yaw_rate = other_log["r"]
    else:
        yaw_rate = np.gradient(unwrap_angle(other_log["psi"]), other_log.t)
    estimate = estimate_clock_from_rate(log.t, heading, other_log.t, yaw_rate)
    if (
        estimate is None
        or estimate.margin < _MIN_TURN_MARGIN
        or abs(estimate.correlation) < _MIN_TURN_CORRELATION
    ):
        return None
    return estimate


def _integrate(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the integral [T] of a rate over time, across gaps by linear interpolation."""
    is_finite = np.isfinite(rate)
    if is_finite.sum() < 2:
        return np.full(t.size, np.nan)
    gap_free = np.interp(t, t[is_finite], rate[is_finite])
    return np.append(0.0, np.cumsum(0.5 * np.diff(t) * (gap_free[1:] + gap_free[:-1])))


def estimate_clock_offset(log: Log, other_log: Log) -> ClockOffset:
    """Estimate the clock offset of a log from the accelerations that its channels explain.

    For each offset with sufficient overlap the changes of u and r over blocks of time are fitted by
    least squares. The regressors are integrals of velocities, and of w, w|w| and w u of each
    channel w. The result maximises the explained share of the residual of the velocities alone.

    Args:
        log: log with the motion, measured or derived from position and heading.
        other_log: log with the channels that cause the motion, or with velocities.

    Raises:
        DataError: if the log is too short.
    """
    # changes of u and r over blocks, in standard deviations
    motion_log = complete_motion(log, MotionConfig())
    stride = max(1, len(motion_log) // _MAX_SAMPLES)
    t = motion_log.t[::stride]
    block_length = max(4, round(_BLOCK_SECONDS / float(np.median(np.diff(t)))))
    blocks = OverlappingBlocks(
        t, np.arange(0, len(t) - block_length, max(1, block_length // 4)), block_length
    )
    if not blocks.starts.size:
        raise DataError(f"log {log.name}: {t[-1] - t[0]:.1f} s are too short for an estimate")

    def integrate_columns(*columns: np.ndarray) -> np.ndarray:
        """Return the integrals [B, k] of columns [T] over the blocks."""
        return blocks.make_integrator(np.stack(columns, axis=1))(0)

    is_finite = {name: np.isfinite(motion_log[name]) for name in ("u", "r")}
    u, r = (np.interp(t, motion_log.t[k], motion_log[n][k]) for n, k in is_finite.items())
    velocity_change = blocks.compute_changes(np.stack((u, r), axis=1))
    velocity_change /= np.maximum(velocity_change.std(axis=0), 1e-12)
    motion_regressors = integrate_columns(
        np.ones_like(u), u, u * np.abs(u), r, r * np.abs(r), u * r
    )
    # residual of a model without the channels of the other log: what these may explain
    motion_residual = (
        velocity_change
        - motion_regressors @ np.linalg.lstsq(motion_regressors, velocity_change, rcond=1e-9)[0]
    )
    squared_motion_residual = (motion_residual**2).sum(axis=1)
    total_variance = float(squared_motion_residual.sum())
    input_signals = [
        values for name, values in other_log.channels.items() if name not in STATE_NAMES
    ]
    # velocities in the other log change as those of this log do
    velocity_signals = [
        values for name, values in other_log.channels.items() if name in ("u", "v", "r")
    ]
    min_overlap = _MIN_OVERLAP * min(t[-1] - t[0], other_log.t[-1] - other_log.t[0])

    def explained_share(shift: float) -> float:
        """Return the share of the residual that the other log, `shift` s later, explains."""
        shifted_times = t - shift
        block_start = shifted_times[blocks.starts]
        block_end = shifted_times[blocks.starts + block_length]
        in_range = (block_start >= other_log.t[0]) & (block_end <= other_log.t[-1])
        if (
            in_range.sum()
            < 3 * (motion_regressors.shape[1] + 3 * len(input_signals) + len(velocity_signals))
            or not total_variance
        ):
            return 0.0

        def interpolate_signal(values: np.ndarray) -> np.ndarray:
            is_finite = np.isfinite(values)
            return np.asarray(np.interp(shifted_times, other_log.t[is_finite], values[is_finite]))

        columns = [motion_regressors[in_range]]
        columns += [
            blocks.compute_changes(w)[in_range, None]
            for w in map(interpolate_signal, velocity_signals)
        ]
        columns += [
            integrate_columns(w, w * np.abs(w), w * u)[in_range]
            for w in map(interpolate_signal, input_signals)
        ]
        regressors = np.concatenate(columns, axis=1)
        response = velocity_change[in_range]
        regressors = regressors / np.maximum(np.abs(regressors).max(axis=0), 1e-12)
        residual = response - regressors @ np.linalg.lstsq(regressors, response, rcond=1e-9)[0]
        # blocks outside of the other log count as unexplained
        return float(
            (squared_motion_residual[in_range].sum() - (residual**2).sum()) / total_variance
        )

    # coarse search over all offsets with sufficient overlap, then a fine one around the best
    lower_shift = t[0] - other_log.t[-1] + min_overlap
    upper_shift = t[-1] - other_log.t[0] - min_overlap
    coarse_shifts = np.arange(
        lower_shift, max(upper_shift, lower_shift + _COARSE_STEP), _COARSE_STEP
    )
    scores = np.array([explained_share(shift) for shift in coarse_shifts.tolist()])
    best_coarse_shift = float(coarse_shifts[scores.argmax()])
    fine_shifts = best_coarse_shift + np.arange(
        -_COARSE_STEP, _COARSE_STEP + _FINE_STEP, _FINE_STEP
    )
    fine_scores = np.array([explained_share(shift) for shift in fine_shifts.tolist()])
    seconds = float(fine_shifts[fine_scores.argmax()])
    # the score of the best other offset shows whether the estimate is ambiguous
    is_alternative = scores[np.abs(coarse_shifts - seconds) > _MIN_ALTERNATIVE_OFFSET]
    return ClockOffset(seconds, float(fine_scores.max()), float(is_alternative.max(initial=0.0)))


def group_trip_files(paths: Mapping[Path, tuple[str, ...]]) -> dict[str, list[Path]]:
    """Group files whose names differ in one word only, such as gnss_1.csv and motors_1.csv.

    Files of one group have the same columns. Incomplete trips are left out.

    Args:
        paths: file -> names of its columns.

    Returns:
        Word -> files in the order of the trips; empty if the files are no parts of trips.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, columns in paths.items():
        groups.setdefault(columns, []).append(path)
    file_groups = list(groups.values())
    if not 2 <= len(file_groups) <= 6:
        return {}
    file_words = [
        # `gnss` of gnss1, `6d` of run1_6d
        [{*re.findall(r"(?<![^\W_])\d[^\W\d_]+|[^\W\d_]+", path.stem)} for path in group]
        for group in file_groups
    ]
    # words that occur in all file names of a group, the longest first
    common_words = [
        sorted(set.intersection(*word_sets), key=lambda w: (-len(w), w)) for word_sets in file_words
    ]
    word_counts = Counter(
        shared_word for distinctive_words in common_words for shared_word in distinctive_words
    )
    distinctive_words = [
        [shared_word for shared_word in group_words if word_counts[shared_word] == 1]
        for group_words in common_words
    ]
    if not all(distinctive_words):
        return {}
    trips = {
        group_words[0]: {
            path.with_name(path.stem.replace(group_words[0], "\0")): path for path in group
        }
        for group_words, group in zip(distinctive_words, file_groups, strict=True)
    }
    first_trips, *other_trips = trips.values()
    complete_trips = [
        trip for trip in first_trips if all(trip in other_trip for other_trip in other_trips)
    ]
    return (
        {
            shared_word: [trip_paths[trip] for trip in complete_trips]
            for shared_word, trip_paths in trips.items()
        }
        if complete_trips
        else {}
    )
