"""Entries of a channel map: units, signs and frames from headers, values and physics.

A vessel moves approximately in the direction of its heading, and its yaw rate is the derivative of
the heading. Columns are regressed on these quantities to determine their factors and signs.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.frames import rotate
from residnet.core.names import BOW_WIND_CHANNELS, CHANNEL_UNITS, port_starboard_pairs
from residnet.core.units import to_si
from residnet.io.drafting.motion_columns import MAGNETIC_PATTERN, MOTION_AND_WIND_CHANNELS
from residnet.io.drafting.motion_regression import (
    MIN_STANDARD_ERRORS,
    POSE_FRAMES,
    ROS_POSE_FRAMES,
    Motion,
    PoseFrame,
    RawTable,
    ScaleFit,
    convert_heading,
    differentiate_on_grid,
    estimate_motion,
    estimate_rudder_gain,
    fit_rate_to_angle,
    fit_to_motion,
    forward_alignment,
)
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.velocities import (
    BODY_AXES,
    EARTH_AXES,
    EXCHANGED_EARTH_AXES,
    MAX_CONTRADICTION,
    HeadingOffset,
    Meaning,
    MeaningChoice,
    MeasuredVelocities,
    choose_meaning,
    estimate_drift_free_offset,
    measure_contradiction,
)
from residnet.io.header_vocabulary import (
    Scaling,
    find_earth_velocities,
    guess_scaling,
    guess_unit_from_size,
    infer_unit,
    match_axis_velocity,
    parse_header_unit,
    parse_name,
)
from residnet.preprocessing.channel_values import NEGLIGIBLE_MOTION_SHARE

QUATERNION_HEADING = "heading of the quaternion [rad]"
"""Column of a heading that is derived from a quaternion."""
_OVERRULING_CORRELATION = 0.9
"""Smallest correlation for which an estimated factor overrules the header."""
_MIN_FACTOR_RATIO = 0.6
"""Smallest ratio of an estimated factor to that of a unit at which both agree."""
_MAX_FACTOR_RATIO = 1.6
"""Largest such ratio."""
_MIN_FRAME_SCORE = 0.5
"""Smallest consistency of position, heading and velocities in a frame that is not questioned."""
_MIN_BODY_CONSISTENCY = 0.85
"""Smallest consistency with position and heading of u and v that are certainly in body axes."""
_MAX_NOISE_SHARE = 0.2
"""Largest standard deviation of the noise of a dead gyro, as share of that of the yaw rate."""
_MAX_WIND_SPREAD_RATIO = 0.8
"""Largest ratio of true-wind standard deviations for a reference other than that of the name.

In 120 simulated logs with turns the reference was right in all. With turns of less than one radian
the reference of the name was used in a third of the logs.
"""
_MIN_WIND_SAMPLES = 50
"""Smallest number of samples of a wind for a decision."""


@final
class ChannelMapper:
    """Builder of the entries of a channel map from names, headers, values and physics."""

    def __init__(
        self,
        names: Mapping[str, str],
        logs: Sequence[RawTable],
        draft_notes: DraftNotes,
        degrees_per_count: float,
        candidate_frames: Sequence[PoseFrame] = POSE_FRAMES,
    ) -> None:
        """Create a builder.

        Args:
            names: channel -> column.
            logs: tables.
            draft_notes: receives guesses and notes.
            degrees_per_count: unit of the columns x and y in deg; 0 if they are lengths.
            candidate_frames: frames to test, the most probable first.
        """
        self._degrees_per_count = float(degrees_per_count)
        self._candidate_frames = tuple(candidate_frames)
        # whether position and heading have the names of a ROS pose
        self._is_ros_pose = self._candidate_frames == ROS_POSE_FRAMES
        self._names = dict(names)
        self._logs = list(logs)
        self._draft_notes = draft_notes
        self._pose_frame = self._candidate_frames[0]
        self._motions: list[Motion | None] = [None] * len(logs)
        self._psi_unit = "rad"
        self._sign_flipped: set[str] = set()
        self._is_swapped = False
        self._is_earth_fixed = False
        self._heading_offset: HeadingOffset | None = None

    def draft_entries(self) -> dict[str, dict[str, Any]]:
        """Choose units, signs and frames, and return the entry of each channel in a channel map."""
        if self._is_named_earth_fixed and "psi" not in self._names:
            columns = " and ".join(f"'{self._names.pop(name)}'" for name in ("u", "v"))
            text = f"{columns} are left out: velocities along north and east need a heading"
            self._draft_notes.add_note(CHANNELS_KEY, text)
        if {"x", "y", "psi"} <= set(self._names):
            self._choose_velocity_meaning()
            self.choose_frame()
            for name in [
                velocity_name for velocity_name in ("u", "v", "r") if velocity_name in self._names
            ]:
                self._drop_constant_velocity(name)
        elif "psi" in self._names:
            self._psi_unit = self._infer_unit("psi")
            self._is_earth_fixed = self._is_named_earth_fixed
        self._choose_wind_reference()
        entries = {name: self._make_entry(name) for name in self._names}
        if {"x", "y", "psi"} <= entries.keys():
            self._require_compatible_velocities(entries)
        if "psi" in entries and MAGNETIC_PATTERN.search(self._names["psi"]):
            entries["psi"] |= self._correct_magnetic_heading(self._names["psi"])
        for force, velocity in (("tau_y", "v"), ("tau_n", "r")):
            # forces have the same axes as the velocities of the file
            is_reversed = entries.get(velocity, {}).get("sign") == -1
            if is_reversed and force in entries and "sign" not in entries[force]:
                entries[force]["sign"] = -1
                text = f"assumed in the axes of {velocity}, which is positive to port in the file"
                self._draft_notes.add_guess((*CHANNELS_KEY, force), text)
        return entries

    def _drop_constant_velocity(self, name: str) -> None:
        """Leave out a velocity that does not move while position and heading do."""
        motions = [motion for motion in self._motions if motion is not None]
        component_index = {"u": 1, "v": 2, "r": 3}[name]
        factor = to_si(self._infer_unit(name, should_note=False), CHANNEL_UNITS[name])
        spread = factor * float(np.nanstd(self._concatenate_values(name)))
        # a yaw rate without a correlation may have another clock, but no smaller amplitude
        fit = fit_to_motion(self._logs, self._motions, name)
        is_noise = name == "r" and not fit.is_significant
        max_share = _MAX_NOISE_SHARE if is_noise else NEGLIGIBLE_MOTION_SHARE
        if not motions:
            return
        reference = np.concatenate([motion[component_index] for motion in motions])
        # jumps of the heading, as where it was interpolated across a full circle, are no motion
        limit = 3.0 * float(np.quantile(np.abs(reference), 0.9))
        if spread < max_share * float(np.std(np.clip(reference, -limit, limit))):
            column = self._names.pop(name)
            text = f"'{column}' does not move, but position and heading do; left out: {name} is"
            self._draft_notes.add_note(CHANNELS_KEY, f"{text} derived from them")

    @property
    def _is_named_earth_fixed(self) -> bool:
        """Whether u and v have the names of velocities along north and east."""
        columns = tuple(self._names.get(name, "") for name in ("u", "v"))
        return find_earth_velocities(columns) == columns

    @property
    def _vertical_sign(self) -> int:
        """-1 if the vertical axes of the file point up: those of a quaternion in ENU; else 1."""
        is_quaternion = self._names.get("psi") == QUATERNION_HEADING
        return -1 if is_quaternion and self._pose_frame.is_from_east else 1

    def _concatenate_values(self, name: str) -> np.ndarray:
        parts = [raw.columns[name] for raw in self._logs if name in raw.columns]
        return np.concatenate(parts) if parts else np.zeros(0)

    def choose_frame(self) -> None:
        """Choose unit and frame of the heading that are most consistent with the motion."""
        x, y = parse_name(self._names["x"]), parse_name(self._names["y"])
        is_named_north_east = (
            x.has_all("north") and y.has_all("east") and not (x.text == "x" or y.text == "y")
        )
        is_named_north_east = is_named_north_east or self._degrees_per_count > 0.0
        if is_named_north_east:
            self._candidate_frames = tuple(
                dict.fromkeys(PoseFrame(False, f.is_from_east) for f in self._candidate_frames)
            )
        score = self._search_heading_frame()
        if self._pose_frame.is_reversed:
            text = "the motion is consistent with the heading only if it is positive to port"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), text)
        if parse_header_unit(self._names["psi"], "rad") is None:
            reason = f"position and heading are most consistent in {self._psi_unit}"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), f"the header has no unit; {reason}")
        if not is_named_north_east and not self._is_ros_pose and self._is_mirrored():
            is_swapped, is_from_east, is_reversed = self._pose_frame
            self._pose_frame = PoseFrame(not is_swapped, not is_from_east, is_reversed)
            self._motions = [
                estimate_motion(table, self._psi_unit, self._pose_frame) for table in self._logs
            ]
            text = "the mirrored motion is as consistent, but more thrust on port turns it to port"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), text)
        self._name_position_axes(score, is_named_north_east)
        if self._pose_frame.is_from_east:
            text = "the motion is consistent with the heading only if the heading is from east"
            if self._is_ros_pose:
                text = "the heading is assumed from east, as in a pose of ROS (REP 103)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), text)
        if score < _MIN_FRAME_SCORE:
            text = f"position, heading and velocities are inconsistent ({score:.2f} of 1)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), f"{text}: check units and axes")
        # swapped columns have been exchanged by name
        self._is_swapped = self._pose_frame.is_swapped
        self._pose_frame = self._pose_frame._replace(is_swapped=False)

    def _search_heading_frame(self) -> float:
        """Set the most consistent unit and frame of the heading; returns their score, at most 1."""
        header_unit = parse_header_unit(self._names["psi"], "rad")
        unit_from_size, _ = guess_unit_from_size("psi", self._concatenate_values("psi"))
        # an unwrapped heading in rad may be large, so that its size decides only without motion
        alternative_unit = "rad" if unit_from_size == "deg" else "deg"
        candidate_units = [header_unit] if header_unit else [unit_from_size, alternative_unit]
        largest_value = np.nanmax(np.abs(self._concatenate_values("psi")), initial=0.0)
        if not header_unit and largest_value > 720.0:
            candidate_units.append("cdeg")
        best_candidate = (-np.inf, "rad", self._candidate_frames[0])
        for is_reversed, unit, frame in itertools.product(
            (False, True), candidate_units, self._candidate_frames
        ):
            # a heading positive to port is rare: the usual frames must fail
            if is_reversed and best_candidate[0] >= _MIN_FRAME_SCORE:
                break
            frame = frame._replace(is_reversed=is_reversed)
            motions = [estimate_motion(table, unit, frame) for table in self._logs]
            score = self._score_consistency(motions)
            # a later candidate must be clearly better: the first ones are the usual ones
            min_score = _MIN_BODY_CONSISTENCY if is_reversed else -np.inf
            if score > max(best_candidate[0] + 0.02, min_score):
                best_candidate = (score, unit, frame)
                self._motions = motions
        score, self._psi_unit, self._pose_frame = best_candidate
        return score

    def _name_position_axes(self, score: float, is_named_north_east: bool) -> None:
        """Assign the position columns to north and east by the frame, and note the guess.

        Args:
            score: consistency of position and heading, 1 at most.
            is_named_north_east: whether the names of the columns define their axes.
        """
        if self._pose_frame.is_swapped:
            self._names["x"], self._names["y"] = self._names["y"], self._names["x"]
            text = "the motion is consistent with the heading only if the column called y is north"
            if self._is_ros_pose and self._pose_frame.is_from_east:
                text = "x is assumed east and y north, as in a pose of ROS (REP 103)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "x"), text)
        elif not is_named_north_east and not self._pose_frame.is_from_east:
            text = f"x is assumed north and y east: consistent with the heading ({score:.2f} of 1)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "x"), text)

    def _is_mirrored(self) -> bool:
        """Return whether more thrust on the port side turns the vessel to port."""
        for port, stbd in port_starboard_pairs(self._names).items():
            if re.match(r"(cmd_)?(delta|azimuth)", port):
                continue
            thruster_differences = [
                (RawTable(table.t, {"port": table.columns[port] - table.columns[stbd]}), motion)
                for table, motion in zip(self._logs, self._motions, strict=True)
                if motion is not None and {port, stbd} <= table.columns.keys()
            ]
            rates = {
                k: np.interp(table.t, m.t, m.yaw_rate)
                for k, (table, m) in enumerate(thruster_differences)
            }
            gain, standard_error = estimate_rudder_gain(
                [table for table, _ in thruster_differences], "port", rates
            )
            return gain < -MIN_STANDARD_ERRORS * standard_error
        return False

    def _choose_velocity_meaning(self) -> None:
        """Choose whether u and v are in body axes, in earth axes, or a speed.

        Frame and heading are determined without the velocities. Velocities in earth axes are
        rotated to body axes for the further tests; a speed is left out.
        """
        names = [name for name in ("u", "v") if name in self._names]
        if not names:
            return
        choice = MeaningChoice(BODY_AXES, BODY_AXES, 0.0, "")
        as_named = self._try_heading_frame(self._names)
        # a vessel that sways as much as it surges has a frame with its velocities only
        is_consistent = as_named._score_consistency(as_named._motions) > _MIN_BODY_CONSISTENCY
        # in a far too large unit the heading is constant, and earth axes look like body axes
        unit_from_size, _ = guess_unit_from_size("psi", self._concatenate_values("psi"))
        header_unit = parse_header_unit(self._names["psi"], "rad")
        is_consistent &= (header_unit or unit_from_size) == as_named._psi_unit
        reference = as_named
        if len(names) < 2 or not is_consistent or self._is_named_earth_fixed:
            other_names = {n: column for n, column in self._names.items() if n not in names}
            reference = self._try_heading_frame(other_names)
            if logs := reference.measure_velocities(names, self._logs):
                choice = choose_meaning(logs)
        meaning = self._select_meaning(choice, names)
        if meaning == BODY_AXES:
            for name in names:
                if match_axis_velocity(parse_name(self._names[name])) is not None:
                    text = "assumed in body axes, consistent with position and heading"
                    self._draft_notes.add_guess((*CHANNELS_KEY, name), text)
            return
        if "speed" in meaning.components:
            text = (
                f"'{self._names.pop('v')}' is left out, v is derived from positions: {choice.text}"
            )
            self._draft_notes.add_note(CHANNELS_KEY, text)
            return
        if meaning == EXCHANGED_EARTH_AXES:
            self._names["u"], self._names["v"] = self._names["v"], self._names["u"]
        # names such as vx say nothing about axes; u and v say something else
        is_named_by_axes = all(match_axis_velocity(parse_name(self._names[n])) for n in names)
        is_named_by_axes |= self._is_named_earth_fixed
        add = self._draft_notes.add_note if is_named_by_axes else self._draft_notes.add_guess
        add((*CHANNELS_KEY, "u"), choice.text or "velocities along north and east by their names")
        self._is_earth_fixed = True
        self._logs = [
            reference._rotate_to_body(table, meaning == EXCHANGED_EARTH_AXES)
            for table in self._logs
        ]

    def _select_meaning(self, choice: MeaningChoice, names: Sequence[str]) -> Meaning:
        """Return the chosen meaning of u and v; if it is ambiguous, that of the names or answer."""
        if self._is_named_earth_fixed and (choice.is_ambiguous or choice.meaning == BODY_AXES):
            # a wrong name contradicts the positions, see `require_compatible`
            return EARTH_AXES
        if not choice.is_ambiguous:
            return choice.meaning
        options = (choice.meaning.description, choice.runner_up.description)
        columns = " and ".join(f"'{self._names[name]}'" for name in names)
        question = f"meaning of {columns}"
        answer = self._draft_notes.ask_question(
            (*CHANNELS_KEY, names[-1]), question, options[0], choice.text, options
        )
        return choice.meaning if answer == options[0] else choice.runner_up

    def _try_heading_frame(self, names: Mapping[str, str]) -> ChannelMapper:
        """Return a mapper of some of the channels with its frame, without notes."""
        mapper = ChannelMapper(
            names, self._logs, DraftNotes(), self._degrees_per_count, self._candidate_frames
        )
        mapper.choose_frame()
        return mapper

    def measure_velocities(
        self, names: Sequence[str], logs: Sequence[RawTable]
    ) -> list[MeasuredVelocities]:
        """Return the motion of the logs with columns of velocities, on uniform grids.

        Args:
            names: channels of the columns, u or v or both.
            logs: tables with these columns.
        """
        measured = []
        north, east = ("y", "x") if self._is_swapped else ("x", "y")
        for table, motion in zip(logs, self._motions, strict=True):
            if motion is None or not {*names} <= table.columns.keys():
                continue
            heading = convert_heading(table, self._psi_unit, self._pose_frame)

            def resample(values: np.ndarray, t: np.ndarray, grid: np.ndarray) -> np.ndarray:
                is_finite = np.isfinite(values) & np.isfinite(t)
                if is_finite.sum() < 2:
                    return np.full(grid.size, np.nan)
                return np.asarray(np.interp(grid, t[is_finite], values[is_finite]))

            position = [resample(table.columns[n], table.t, motion.t) for n in (north, east)]
            surge = motion.surge_velocity
            sway = motion.sway_velocity
            heading_on_grid = resample(heading, table.t, motion.t)
            earth_velocities = rotate(surge, sway, heading_on_grid)
            components = dict(zip(("north", "east"), earth_velocities, strict=True))
            components |= {"surge": surge, "sway": sway, "speed": np.hypot(surge, sway)}
            measured.append(
                MeasuredVelocities(
                    motion.t,
                    np.stack(position, axis=1),
                    heading_on_grid,
                    components,
                    {name: resample(table.columns[name], table.t, motion.t) for name in names},
                )
            )
        return measured

    def _rotate_to_body(self, table: RawTable, is_exchanged: bool) -> RawTable:
        """Return a table with u and v in body axes, from north and east."""
        if not {"u", "v", "psi"} <= table.columns.keys():
            return table
        heading = convert_heading(table, self._psi_unit, self._pose_frame)
        north, east = (table.columns[name] for name in ("v", "u")[:: 1 if is_exchanged else -1])
        u, v = rotate(north, east, -heading)
        return RawTable(table.t, {**table.columns, "u": u, "v": v})

    def _require_compatible_velocities(self, entries: Mapping[str, Mapping[str, Any]]) -> None:
        """Estimate the offset of the heading; stop where velocities contradict the positions.

        Args:
            entries: channel -> entry, with units and signs of u and v.

        Raises:
            DataError: if integrated velocities leave the positions by a tenth of the distance.
        """
        names = ("u", "v")
        if not {*names} <= entries.keys():
            self._heading_offset = estimate_drift_free_offset(
                self.measure_velocities((), self._logs)
            )
            return
        factors = {
            name: entries[name].get("sign", 1) * to_si(entries[name]["unit"]) for name in names
        }
        logs = [
            dataclasses.replace(
                log, columns={name: factors[name] * part for name, part in log.columns.items()}
            )
            for log in self.measure_velocities(names, self._logs)
        ]
        contradiction = measure_contradiction(logs)
        if contradiction is None:
            return
        self._heading_offset = contradiction.heading_offset
        if contradiction.share > MAX_CONTRADICTION:
            raise DataError(
                f"the velocities {' and '.join(self._names[name] for name in names)}, integrated,"
                f" differ from the positions by {100.0 * contradiction.share:.0f} % of the distance"
                f" travelled (at most {100.0 * MAX_CONTRADICTION:.0f} % is possible); no heading"
                " offset, scale, current or frame explains it: these channels are not one motion;"
                " check units and clocks, or delete these columns in the files"
            )

    def _score_consistency(self, motions: Sequence[Motion | None]) -> float:
        """Return the consistency of position, heading and velocities, at most 1."""
        velocity_fits = [
            fit_to_motion(self._logs, motions, name) for name in ("u", "v") if name in self._names
        ]
        if len(velocity_fits) == 2:
            # the sign counts for the surge velocity only
            return (
                sum(fit.correlation * (fit.factor > 0 or i) for i, fit in enumerate(velocity_fits))
                / 2
            )
        return forward_alignment(motions)

    def _choose_wind_reference(self) -> None:
        """Choose the reference of the wind direction: north or bow, true or apparent wind.

        A wind with speed or direction only is left out.
        """
        for name_pair in (BOW_WIND_CHANNELS[1:], ("wind_speed", "wind_dir")):
            if len(present := {*name_pair} & {*self._names}) == 1:
                column = self._names.pop(present.pop())
                text = f"'{column}' is left out: a wind needs speed and direction"
                self._draft_notes.add_note(CHANNELS_KEY, text)
        if "wind_dir" in self._names and BOW_WIND_CHANNELS[2] in self._names:
            columns = ", ".join(self._names.pop(name) for name in BOW_WIND_CHANNELS[1:])
            self._draft_notes.add_note(
                CHANNELS_KEY, f"the true wind exists too; left out: {columns}"
            )
        current_names = (
            BOW_WIND_CHANNELS[1:]
            if BOW_WIND_CHANNELS[2] in self._names
            else ("wind_speed", "wind_dir")
        )
        if current_names[1] not in self._names:
            return
        hypotheses = ["felt", "felt to port", "bow", "bow to port"]
        if current_names[1] == "wind_dir":
            is_true_wind = parse_name(self._names["wind_dir"]).has_all("true")
            hypotheses = ["north", *hypotheses[2 * is_true_wind :]]
        spreads = self._wind_spreads(*current_names)
        best_hypothesis = min(hypotheses, key=lambda hypothesis: spreads.get(hypothesis, np.inf))
        if spreads.get(best_hypothesis, np.inf) > _MAX_WIND_SPREAD_RATIO * spreads.get(
            hypotheses[0], 0.0
        ):
            best_hypothesis = hypotheses[0]
        if best_hypothesis == "north":
            text = "assumed the direction from which the true wind blows, clockwise from north"
            self._draft_notes.add_guess((*CHANNELS_KEY, "wind_dir"), text)
            return
        is_apparent = best_hypothesis.startswith("felt")
        side_text = " to port" if best_hypothesis.endswith("port") else ""
        new_names = BOW_WIND_CHANNELS[1:] if is_apparent else ("wind_speed", BOW_WIND_CHANNELS[0])
        names = dict(zip(current_names, new_names, strict=True))
        self._names = {names.get(name, name): column for name, column in self._names.items()}
        self._logs = [
            RawTable(
                table.t, {names.get(name, name): values for name, values in table.columns.items()}
            )
            for table in self._logs
        ]
        self._sign_flipped |= {new_names[1]} if side_text else set()
        wind = "apparent" if is_apparent else "true"
        ratio = spreads.get(best_hypothesis, 1.0) / max(spreads.get("north", 1.0), 1e-9)
        text = (
            f"assumed the direction of the {wind} wind from the bow{side_text}: so the true wind is"
            f" steadiest ({ratio:.2f} of its standard deviation with a direction from north)"
        )
        self._draft_notes.add_guess((*CHANNELS_KEY, new_names[1]), text)

    def _wind_spreads(self, speed: str, angle: str) -> dict[str, float]:
        """Return the standard deviation of the true wind in m/s for each possible reference.

        The references are north, bow (clockwise), bow to port, and the last two for the apparent
        wind (`felt`), which includes the velocity of the vessel.

        Args:
            speed: channel of the wind speed.
            angle: channel of the wind direction.
        """
        factors = [
            to_si(self._infer_unit(n, should_note=False), CHANNEL_UNITS[n]) for n in (speed, angle)
        ]
        variances: dict[str, list[float]] = {}
        for table, motion in zip(self._logs, self._motions, strict=True):
            psi = self._log_heading(table)
            if psi is None or not {speed, angle} <= table.columns.keys():
                continue
            wind_speed, wind_angle = (
                table.columns[n] * f for n, f in zip((speed, angle), factors, strict=True)
            )
            vessel_velocity = self._vessel_velocity(table, motion)
            bow_direction = np.exp(1j * psi)
            winds = {"north": wind_speed * np.exp(1j * wind_angle)}
            for suffix, sign in (("", 1.0), (" to port", -1.0)):
                winds[f"bow{suffix}"] = wind_speed * np.exp(1j * sign * wind_angle) * bow_direction
                if vessel_velocity is not None:
                    winds[f"felt{suffix}"] = winds[f"bow{suffix}"] - vessel_velocity * bow_direction
            is_finite = np.isfinite(np.stack([*winds.values()])).all(axis=0)
            if is_finite.sum() >= _MIN_WIND_SAMPLES:
                for name, wind in winds.items():
                    variances.setdefault(name, []).append(float(np.var(wind[is_finite])))
        return {name: float(np.sqrt(np.mean(parts))) for name, parts in variances.items()}

    def _vessel_velocity(self, table: RawTable, motion: Motion | None) -> np.ndarray | None:
        """Return u + iv [T] in m/s from the log or from its motion, or None."""
        if {"u", "v"} <= self._names.keys() & table.columns.keys():
            u, v = (
                table.columns[n] * to_si(self._infer_unit(n, should_note=False), "m/s")
                for n in ("u", "v")
            )
        elif motion is not None:
            u, v = (np.interp(table.t, motion.t, part) for part in motion[1:3])
        else:
            return None
        return np.asarray(u + 1j * v)

    def _log_heading(self, table: RawTable) -> np.ndarray | None:
        """Return the heading [T] of a log in rad, or the integral of its yaw rate, or None."""
        if {"psi"} <= self._names.keys() & table.columns.keys():
            return convert_heading(table, self._psi_unit, self._pose_frame)
        if {"r"} <= self._names.keys() & table.columns.keys():
            rate = table.columns["r"] * to_si(self._infer_unit("r", should_note=False), "rad/s")
            time_steps = np.diff(table.t, prepend=table.t[:1])
            return np.asarray(np.cumsum(np.nan_to_num(rate * time_steps)))
        return None

    def _infer_unit(self, name: str, *, should_note: bool = True) -> str:
        """Return the unit of a channel from its header or its values, noting a guess."""
        values = self._concatenate_values(name)
        scaling = infer_unit(name, self._names[name], values)
        if (
            name in ("phi", "theta")
            and scaling.reason
            and "psi" in self._names
            and self._psi_unit != "cdeg"
            and np.nanmax(np.abs(values * to_si(self._psi_unit, "rad")), initial=0.0) < np.pi
        ):
            # small angles in deg have the size of angles in rad
            reason = f"the header has no unit; assumed that of the heading, {self._psi_unit}"
            scaling = Scaling({"unit": self._psi_unit}, reason)
        if should_note and scaling.reason:
            self._draft_notes.add_guess((*CHANNELS_KEY, name), scaling.reason)
        return str(scaling.settings["unit"])

    def _make_entry(self, name: str) -> dict[str, Any]:
        """Return column, unit and frame of a channel for the channel map of a reader."""
        column = self._names[name]
        entry: dict[str, Any] = {"column": column}
        if self._degrees_per_count and name in ("x", "y"):
            return (
                entry
                | {"unit": "deg"}
                | ({"scale": self._degrees_per_count} if self._degrees_per_count < 1.0 else {})
            )
        if name == "psi":
            entry["unit"] = self._psi_unit
            entry |= {"sign": -1} if self._pose_frame.is_reversed else {}
            return entry | ({"frame": "enu"} if self._pose_frame.is_from_east else {})
        if self._is_earth_fixed and name in ("u", "v"):
            entry["frame"] = "ned"
        if name in ("u", "v", "r") and {"x", "y", "psi"} <= set(self._names):
            return entry | self._settle_rate(name, self._fit_velocity(name), "position and heading")
        if name == "r" and "psi" in self._names:
            fit = fit_rate_to_angle(self._logs, "psi", self._psi_unit, name, self._pose_frame)
            return entry | self._settle_rate(name, fit, "headings")
        if name in ("w", "p", "q") and (vertical_fit := self._fit_vertical_motion(name)):
            return entry | self._settle_rate(name, vertical_fit, "positions and attitude")
        if name == "p" and "phi" in self._names:
            unit = self._infer_unit("phi", should_note=False)
            fit = fit_rate_to_angle(self._logs, "phi", unit, name)
            return entry | self._settle_rate(name, fit, "roll angles")
        if name not in MOTION_AND_WIND_CHANNELS and (
            scaling := guess_scaling(name, column, self._concatenate_values(name))
        ):
            self._draft_notes.add_guess((*CHANNELS_KEY, name), scaling.reason)
            return entry | scaling.settings
        sign = -1 if name in self._sign_flipped else self._conventional_sign(name)
        return entry | {"unit": self._infer_unit(name)} | ({"sign": sign} if sign < 0 else {})

    def _correct_magnetic_heading(self, column: str) -> dict[str, Any]:
        """Return the offset of a magnetic heading from the motion, noting how it was estimated."""
        key = (*CHANNELS_KEY, "psi")
        offset = self._heading_offset
        if self._pose_frame.is_from_east or offset is None or not offset.is_determined:
            text = (
                f"'{column}' is magnetic by its name, and is assumed true: set `offset` to"
                " minus the magnetic declination"
            )
            self._draft_notes.add_guess(key, text)
            return {}
        factor = to_si(self._psi_unit, "rad")
        text = (
            f"'{column}' is magnetic by its name; the motion gives an offset of"
            f" {np.degrees(offset.angle):.1f} deg, standard error"
            f" {np.degrees(offset.standard_error):.1f} deg, {offset.source}: compare it with minus"
            " the magnetic declination"
        )
        self._draft_notes.add_guess(key, text)
        return {"offset": float(f"{offset.angle / factor:.3g}")}

    def _fit_velocity(self, name: str) -> ScaleFit:
        """Regress a velocity from position and heading on its column.

        A receiver forward of the vessel's centre adds its lever arm times the yaw rate to the sway
        velocity, which may change its size and sign. Hence a factor of v that contradicts its
        unit is compared with a lever arm.

        Args:
            name: `u`, `v` or `r`.
        """
        fit = fit_to_motion(self._logs, self._motions, name)
        if name != "v" or "u" not in self._names or not fit.is_significant:
            return fit
        surge_fit = fit_to_motion(self._logs, self._motions, "u")
        unit = parse_header_unit(self._names["v"], "m/s") or surge_fit.matching_unit("m/s")
        if unit is None or _MIN_FACTOR_RATIO < fit.factor / to_si(unit) < _MAX_FACTOR_RATIO:
            return fit
        factors = [to_si(unit), -to_si(unit)]
        # a weak correlation, as with a late heading, is no evidence for another unit than that of u
        if fit.correlation >= _OVERRULING_CORRELATION:
            factors.append(fit.factor)
        squares = np.zeros(len(factors))
        for table, motion in zip(self._logs, self._motions, strict=True):
            if motion is None or "v" not in table.columns:
                continue
            is_finite = np.isfinite(table.columns["v"])
            column = np.interp(motion.t, table.t[is_finite], table.columns["v"][is_finite])
            sway, v, yaw_rate = (
                values - values.mean() for values in (motion.sway_velocity, column, motion.yaw_rate)
            )
            for number, factor in enumerate(factors):
                excess = sway - factor * v
                if number < 2:
                    norm = max(float(yaw_rate @ yaw_rate), 1e-300)
                    excess = excess - float(excess @ yaw_rate) / norm * yaw_rate
                squares[number] += float(excess @ excess)
        return fit._replace(factor=factors[int(np.argmin(squares))])

    def _conventional_sign(self, name: str) -> int:
        """Return -1 for an axis that points up or to port in the file (REP 103), else 1."""
        if name == "z" and self._names.get("psi") == QUATERNION_HEADING:
            text = "completes the six degrees of freedom with the quaternion"
            text += "; positive up in the file" if self._vertical_sign < 0 else ""
            self._draft_notes.add_guess((*CHANNELS_KEY, name), text)
        if name in ("z", "w", "q"):
            return self._vertical_sign
        if not self._is_ros_pose or name not in ("v", "r"):
            return 1
        text = "assumed positive to port, as for a pose of ROS (REP 103)"
        self._draft_notes.add_guess((*CHANNELS_KEY, name), text)
        return -1

    def _fit_vertical_motion(self, name: str) -> ScaleFit | None:
        """Regress the heave velocity, roll rate or pitch rate on a column.

        The body velocities are R^T times the derivative of the position, and the angular velocity
        follows from the derivatives of the Euler angles (Fossen 2021, equations 2.31 and 2.41).

        Args:
            name: `w`, `p` or `q`.

        Returns:
            The regression; None without position, depth and all angles.
        """
        if not {"x", "y", "z", "psi", "phi", "theta"} <= self._names.keys():
            return None
        factors = {
            key: to_si(self._infer_unit(key, should_note=False), CHANNEL_UNITS[key])
            for key in ("z", "phi", "theta")
        }
        tables = []
        motions = []
        for table, motion in zip(self._logs, self._motions, strict=True):
            if motion is None or not {*factors, name} <= table.columns.keys():
                continue
            is_finite = np.isfinite([table.t, *(table.columns[key] for key in factors)]).all(axis=0)
            if is_finite.sum() < 30:
                continue
            t = table.t[is_finite]
            depth, roll, pitch = (factors[key] * table.columns[key][is_finite] for key in factors)
            depth *= self._vertical_sign
            pitch *= self._vertical_sign
            depth_rate, roll_rate, pitch_rate = (
                differentiate_on_grid(motion.t, t, values) for values in (depth, roll, pitch)
            )
            roll, pitch = (np.interp(motion.t, t, angle) for angle in (roll, pitch))
            expected = {
                "w": np.cos(roll)
                * (np.sin(pitch) * motion.surge_velocity + np.cos(pitch) * depth_rate)
                - np.sin(roll) * motion.sway_velocity,
                "p": roll_rate - np.sin(pitch) * motion.yaw_rate,
                "q": np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * motion.yaw_rate,
            }
            tables.append(RawTable(table.t, {"r": table.columns[name]}))
            motions.append(motion._replace(yaw_rate=expected[name]))
        return fit_to_motion(tables, motions, "r") if tables else None

    def _settle_rate(self, name: str, fit: ScaleFit, reference: str) -> dict[str, Any]:
        """Return unit and sign of a velocity from its header and a regression.

        Args:
            name: channel of the velocity.
            fit: regression of the derivative of the reference on the column.
            reference: name of the reference, for messages.
        """
        key = (*CHANNELS_KEY, name)
        column = self._names[name]
        expected_unit = CHANNEL_UNITS[name]
        header_unit = parse_header_unit(column, expected_unit)
        measured_unit = fit.matching_unit(expected_unit) if fit.is_significant else None
        unit = header_unit or measured_unit or self._infer_unit(name)
        if header_unit is None and measured_unit is not None:
            text = f"the header has no unit; {reference} give {measured_unit}"
            self._draft_notes.add_guess(key, f"{text} (correlation {fit.correlation:.2f})")
        elif header_unit and measured_unit and fit.correlation >= _OVERRULING_CORRELATION:
            header_factor = to_si(header_unit, expected_unit)
            ratio = abs(fit.factor) / header_factor
            is_same_scale = _MIN_FACTOR_RATIO < ratio < _MAX_FACTOR_RATIO
            if to_si(measured_unit) != header_factor and not is_same_scale:
                text = (
                    f"the header has {header_unit}, {reference} give {measured_unit} (factor"
                    f" {ratio:.3g})"
                )
                question = f"unit of '{column}'"
                unit = self._draft_notes.ask_question(
                    key, question, measured_unit, text, (measured_unit, header_unit)
                )
        entry: dict[str, Any] = {"unit": unit}
        if fit.is_significant and fit.factor < 0.0:
            entry["sign"] = -1
            directions = {"u": "astern", "w": "up", "q": "bow down"}
            direction = directions.get(name, "to port")
            text = f"positive {direction} by {reference} (correlation {fit.correlation:.2f})"
            self._draft_notes.add_guess(key, text)
        elif not fit.is_significant and self._conventional_sign(name) < 0:
            entry["sign"] = -1
        if not fit.is_significant and header_unit is None:
            self._draft_notes.add_guess(key, f"{reference} do not confirm the unit {unit}")
        return entry
