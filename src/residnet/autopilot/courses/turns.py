"""Simulated turns of a vessel, and routes that join turns by straight legs.

A turn has three phases: a constant rudder angle, counter-rudder until the yaw rate is zero, and
rudder amidships on the leg that follows. A turn table interpolates turns over the hold time, which
is the duration of the first phase. Positions are complex numbers, north + i east, in m.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.engine.rollout import Rollout

Array = NDArray[np.float64]
_COUNTER_RUDDER_TIME = 1.5
"""Simulated duration of the counter-rudder in time constants; Nomoto's model needs T ln 2."""
_MAX_TURN_STEP = 0.25
"""Largest time step of simulated turns in time constants."""
_MAX_STEP_HALVINGS = 6
"""Largest number of times that this step is halved."""
_STEP_TOLERANCE = 1e-3
"""Accepted difference from a simulation with half the step, in turning radii and in rad."""


@dataclass(frozen=True)
class Turn:
    """A simulated turn that starts at the origin with heading north, and the leg after it.

    Attributes:
        rudder: rudder angle of the first phase in rad, positive to starboard; the counter-rudder
            has the opposite sign.
        hold_time: duration of the first phase in s.
        duration: duration of the first phase and the counter-rudder in s.
        rudder_phase: state [nx] by the time in s since the start of the first phase.
        counter_rudder_phase: state [nx] by the time in s since the start of the counter-rudder.
        leg_phase: state [nx] by the time in s since the start of the leg.
        pose_columns: columns of north, east and heading in the state.
    """

    rudder: float
    hold_time: float
    duration: float
    rudder_phase: PPoly
    counter_rudder_phase: PPoly
    leg_phase: PPoly
    pose_columns: tuple[int, int, int]

    def track_at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [M, 2] in m and headings [M] in rad of the turn at times [M] in s."""
        is_holding = (times <= self.hold_time)[:, None]
        counter_rudder_states = self.counter_rudder_phase(np.maximum(times - self.hold_time, 0.0))
        return self._pose_of(
            np.where(
                is_holding,
                self.rudder_phase(np.minimum(times, self.hold_time)),
                counter_rudder_states,
            )
        )

    def leg_at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [M, 2] and headings [M] of the leg at times [M] in s since its start."""
        return self._pose_of(self.leg_phase(times))

    def _pose_of(self, states: Array) -> tuple[Array, Array]:
        return states[:, list(self.pose_columns[:2])], states[:, self.pose_columns[2]]


@final
class TurnMaker:
    """Simulate turns of the nominal vessel: constant rudder, counter-rudder, rudder amidships.

    Each phase is a separate simulation that starts at the end of the previous phase, so that the
    end of a turn is a smooth function of the hold time.

    Args:
        vessel: steered vessel.
        nomoto: K, T and speed of the vessel.
        dt: time step in s; shorter steps are used while a steering gear moves the rudder.
    """

    def __init__(self, vessel: SteeredVessel, nomoto: NomotoModel, dt: float) -> None:
        self.vessel = vessel
        self.nomoto = nomoto
        self.dt = dt
        self.pose_columns = (
            vessel.state_column("x"),
            vessel.state_column("y"),
            vessel.state_column("psi"),
        )
        self.rollouts: dict[float, Rollout] = {}
        x, self.nominal_inputs = vessel.straight_course(torch.ones(1, dtype=torch.float64))
        self.straight_state: Array = x[0].numpy()

    def __call__(
        self, hold_times: Array, rudder: Array, initial_states: Sequence[Array], leg_time: float
    ) -> list[list[Turn]]:
        """Simulate the turns of n rudder angles with K hold times each.

        Args:
            hold_times: hold times [n, K] in s.
            rudder: rudder angles [n] in rad, positive to starboard.
            initial_states: initial state [nx] for each rudder angle; position and heading are set
                to zero.
            leg_time: simulated duration of the leg in s.
        """
        n, k = hold_times.shape
        x = np.stack(initial_states)
        # turns are tabulated from the origin with heading north and moved to their place by the
        # planner
        x[:, list(self.pose_columns)] = 0.0
        largest = float(np.abs(rudder).max())
        rudder_phase = self._simulate_phase(x, rudder, float(hold_times.max()), 2.0 * largest)
        rows = np.repeat(np.arange(n), k)
        # one simulation per hold time from here on; the first phase is shared by all hold times
        counter_rudder_phase = self._simulate_phase(
            _evaluate_rows(rudder_phase, hold_times.ravel(), rows),
            -rudder[rows],
            _COUNTER_RUDDER_TIME * self.nomoto.time,
            2.0 * largest,
        )
        stop_times = self._stop_times(counter_rudder_phase, np.sign(rudder)[rows])
        turn_index = np.arange(n * k)
        leg_phase = self._simulate_phase(
            _evaluate_rows(counter_rudder_phase, stop_times, turn_index),
            np.zeros(n * k),
            leg_time,
            largest,
        )
        turns = [
            Turn(
                float(rudder[row]),
                float(hold_time),
                float(hold_time + stop),
                _row_spline(rudder_phase, int(row)),
                _row_spline(counter_rudder_phase, number),
                _row_spline(leg_phase, number),
                self.pose_columns,
            )
            for number, (row, hold_time, stop) in enumerate(
                zip(rows, hold_times.ravel(), stop_times, strict=True)
            )
        ]
        return [turns[k * i : k * i + k] for i in range(n)]

    def _simulate_phase(
        self, x: Array, rudder: Array, duration: float, rudder_change: float
    ) -> CubicSpline:
        """Simulate the states [B, nx] from initial states x [B, nx] under rudder angles [B] in rad.

        Args:
            x: initial states.
            rudder: rudder angles.
            duration: simulated time in s.
            rudder_change: largest movement of the rudder in rad.
        """
        w = self.nominal_inputs.unsqueeze(1).repeat(len(x), 1, 1)
        w[:, 0, 0] = torch.from_numpy(rudder)
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(x), -1)
        times = [np.zeros(1)]
        state_parts = [torch.from_numpy(x).unsqueeze(1)]
        step_plan = []
        remaining_time = max(duration, 3.0 * self.dt)
        if self.vessel.rate is not None:
            rudder_travel_time = rudder_change / self.vessel.rate
            # the rudder is constant within a step and lags by half a step on average, which changes
            # the heading by up to K delta dt / 2
            short_step = min(self.dt, 4.0 * _STEP_TOLERANCE / (self.nomoto.gain * rudder_change))
            count = math.ceil(min(1.1 * rudder_travel_time, remaining_time) / short_step)
            step_plan = [(short_step, count)]
            remaining_time = remaining_time - count * short_step
        for dt, count in (
            [*step_plan, (self.dt, math.ceil(remaining_time / self.dt))]
            if remaining_time > 0
            else step_plan
        ):
            if dt not in self.rollouts:
                self.rollouts[dt] = Rollout(self.vessel.model(dt))
            with torch.no_grad():
                states, _, _ = self.rollouts[dt](
                    state_parts[-1][:, -1], w.expand(-1, count, -1), nominal
                )
            state_parts.append(states[:, 1:])
            times.append(times[-1][-1] + dt * np.arange(1, count + 1))
        return CubicSpline(
            np.concatenate(times), torch.cat(state_parts, dim=1).transpose(0, 1).numpy()
        )

    def _stop_times(self, countered: CubicSpline, turn_signs: Array) -> Array:
        """Return the times [B] in s at which the yaw rate reaches zero, else the end time.

        Args:
            countered: states under counter-rudder as a function of the time.
            turn_signs: +1 [B] for turns to starboard, -1 to port.
        """
        column = self.vessel.state_column("r")
        stop_times = []
        for row, initial_yaw_rate in enumerate(turn_signs * countered.c[-1, 0, :, column]):
            yaw = PPoly(countered.c[:, :, row, column], countered.x)
            # the root of the spline is continuous in the hold time, unlike the nearest time step
            roots = yaw.roots(extrapolate=False) if initial_yaw_rate > 0 else np.zeros(1)
            stop_times.append(float(roots[0]) if len(roots) else float(countered.x[-1]))
        return np.array(stop_times)


def _evaluate_rows(states: CubicSpline, times: Array, rows: NDArray[np.intp]) -> Array:
    """Evaluate the spline of M rows at one time [M] in s each; returns states [M, nx]."""
    interval = np.clip(np.searchsorted(states.x, times, side="right") - 1, 0, len(states.x) - 2)
    time_in_interval = (times - states.x[interval])[:, None]
    # `polyval` evaluates each row with its own coefficients, which `PPoly` cannot
    row_states: Array = np.asarray(
        np.polyval(states.c[:, interval, rows], time_in_interval), dtype=np.float64
    )
    return row_states


def _row_spline(states: CubicSpline, row: int) -> PPoly:
    """Return the piecewise polynomial of one row of a spline."""
    return PPoly(states.c[:, :, row], states.x)


def choose_time_step(vessel: SteeredVessel, nomoto: NomotoModel, rudder: float) -> float:
    """Choose the largest time step in s at which turns and legs have converged.

    A step is accepted if half the step changes positions and headings by less than
    `_STEP_TOLERANCE`, for three hold times.

    Args:
        vessel: steered vessel.
        nomoto: K, T and speed of the vessel.
        rudder: rudder angle in rad.
    """
    hold_times = nomoto.time * np.array([[0.5, 1.5, 3.0]])
    radius = nomoto.speed / (nomoto.gain * rudder)
    dt = _MAX_TURN_STEP * nomoto.time
    # the first step has no coarser simulation to compare with
    previous_ends = None
    for _ in range(_MAX_STEP_HALVINGS):
        turn_maker = TurnMaker(vessel, nomoto, dt)
        (turns,) = turn_maker(
            hold_times, np.array([rudder]), [turn_maker.straight_state], nomoto.time
        )
        end_poses = []
        for turn in turns:
            track, heading = turn.leg_at(np.array([0.0, nomoto.time]))
            end_poses.append(np.concatenate((track / radius, heading[:, None]), axis=1))
        current_ends = np.stack(end_poses)
        if (
            previous_ends is not None
            and np.abs(current_ends - previous_ends).max() < _STEP_TOLERANCE
        ):
            return 2.0 * dt
        previous_ends = current_ends
        dt = 0.5 * dt
    return 2.0 * dt


@dataclass(frozen=True)
class SteadyTurn:
    """A steady turn at a constant rudder angle.

    Attributes:
        radius: radius of the track in m.
        speed: speed in m/s.
        yaw_rate: yaw rate in rad/s.
        step: time step of the simulation in s.
    """

    radius: float
    speed: float
    yaw_rate: float
    step: float


def simulate_steady_turn(
    vessel: SteeredVessel, rudder: float, duration: float, dt: float
) -> SteadyTurn:
    """Simulate the steady turn at a constant rudder angle.

    At the rudder limit it is the tightest turn of the vessel.

    Args:
        vessel: steered vessel.
        rudder: rudder angle in rad.
        duration: simulated time in s; the last tenth is evaluated.
        dt: time step in s.
    """
    x, w = vessel.straight_course(torch.ones(1, dtype=torch.float64))
    w[:, 0] = rudder
    variation = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    steps = math.ceil(duration / dt)
    with torch.no_grad():
        states, _, _ = Rollout(vessel.model(dt))(x, w.unsqueeze(1).expand(-1, steps, -1), variation)
    psi = states[0, :, vessel.state_column("psi")]
    track = states[0, :, [vessel.state_column("x"), vessel.state_column("y")]]
    # the last tenth of the simulation is steady
    first_step = steps - max(steps // 10, 1)
    distance = float((track[first_step + 1 :] - track[first_step:-1]).norm(dim=-1).sum())
    heading_change = float((psi[-1] - psi[first_step]).abs())
    # length of the arcs from that of their chords: factor (a / 2) / sin(a / 2) for an angle a
    half_step_angle = 0.5 * heading_change / (steps - first_step)
    distance *= half_step_angle / math.sin(half_step_angle)
    elapsed = (steps - first_step) * dt
    return SteadyTurn(distance / heading_change, distance / elapsed, heading_change / elapsed, dt)


N_TURN_POINTS = 28
"""Number of points of a turn, without its start."""
_MAX_TURN_ANGLE = math.radians(500.0)
"""The largest angle of a turn in a table."""
_N_HOLD_TIMES = 56
"""Number of turns in a table; their angles differ by about nine degrees."""
_RESIDUAL_MOTION_TOLERANCE = 2e-3
"""Residual motion after a turn that is neglected: relative to speed and radius, and angles in
rad.
"""
_SETTLING_TIME = 4.0
"""Number of time constants after which the motion behind a turn has decayed."""


class TrackPart(NamedTuple):
    """Points, final headings and durations of n turns or legs, or the derivatives of these.

    Attributes:
        points: complex positions [n, K] in m.
        headings: final headings [n] in rad.
        times: durations [n] in s.
    """

    points: np.ndarray
    headings: Array
    times: Array


@final
class TurnTable:
    """Turns to starboard at one rudder angle, interpolated over the hold time by cubic splines.

    Args:
        hold_times: hold times [K] in s, increasing from 0.
        points: complex positions [K, P] at `N_TURN_POINTS` times in m in the frame of the start;
            the last one is the start of the leg.
        headings: headings [K, P] of the vessel in rad; the last one is the direction of the
            leg.
        times: durations [K] of the turns in s.
        rudder: rudder angle in rad.
        leg: north, east and heading of the leg by its length, in the frame of its start; None for
            a straight leg.
    """

    def __init__(
        self,
        hold_times: Array,
        points: np.ndarray,
        headings: Array,
        times: Array,
        rudder: float,
        leg: CubicSpline | None = None,
    ) -> None:
        rows = np.concatenate((points.real, points.imag, headings, times[:, None]), axis=1)
        self.rudder = rudder
        self.max_hold_time = float(hold_times[-1])
        self.leg = leg
        self.leg_derivative = None if leg is None else leg.derivative()
        self.spline = CubicSpline(hold_times, rows)
        self.spline_derivative = self.spline.derivative()
        self.angles = headings[:, -1]
        self.hold_times = hold_times
        self.end_positions = points[:, -1]

    def __call__(self, hold_time: float) -> tuple[np.ndarray, Array, float]:
        """Return points [P], headings [P] and duration of the turn with a hold time; P points."""
        row = self.spline(hold_time)
        return (
            row[:N_TURN_POINTS] + 1j * row[N_TURN_POINTS : 2 * N_TURN_POINTS],
            row[2 * N_TURN_POINTS : -1],
            float(row[-1]),
        )

    def leg_at(self, lengths: Array) -> tuple[TrackPart, TrackPart]:
        """Return the leg at lengths [..., K] in m, and its derivatives by each length."""
        zero_angles = np.zeros(lengths.shape[:-1])
        if self.leg is None or self.leg_derivative is None:
            straight_points = lengths.astype(complex)
            return TrackPart(straight_points, zero_angles, zero_angles), TrackPart(
                np.ones_like(straight_points), zero_angles, zero_angles
            )
        clipped_lengths = np.minimum(lengths, self.leg.x[-1])
        leg_rows = self.leg(clipped_lengths)
        leg_slopes = self.leg_derivative(clipped_lengths)
        final_direction = np.exp(1j * leg_rows[..., 2])
        is_tabulated = lengths <= self.leg.x[-1]
        positions = (
            leg_rows[..., 0] + 1j * leg_rows[..., 1] + (lengths - clipped_lengths) * final_direction
        )
        position_slopes = np.where(
            is_tabulated, leg_slopes[..., 0] + 1j * leg_slopes[..., 1], final_direction
        )
        heading_slopes = np.where(is_tabulated, leg_slopes[..., 2], 0.0)
        return TrackPart(positions, leg_rows[..., -1, 2], zero_angles), TrackPart(
            position_slopes, heading_slopes[..., -1], zero_angles
        )

    def hold_time(self, angle: float) -> float:
        """Return the hold time in s of a turn by `angle` rad."""
        return float(np.interp(angle, self.angles, self.hold_times))

    @cached_property
    def fitted_arc(self) -> tuple[float, float, float]:
        """Radius of an arc and lengths of the straight lines before and after it, in m.

        Line, arc and line approximate the end positions of the turns by least squares.
        """
        # short turns are dominated by the start-up, and beyond 300 deg legs do not occur
        is_usable = (self.angles > math.radians(20.0)) & (self.angles < math.radians(300.0))
        turn_rotation = np.exp(1j * self.angles[is_usable])
        usable_ends = self.end_positions[is_usable]
        columns = np.stack(
            (1j * (1.0 - turn_rotation), np.ones_like(turn_rotation), turn_rotation), axis=1
        )
        coefficients = np.linalg.lstsq(
            np.concatenate((columns.real, columns.imag)),
            np.concatenate((usable_ends.real, usable_ends.imag)),
            rcond=None,
        )[0]
        return (
            float(coefficients[0]),
            max(float(coefficients[1]), 0.0),
            max(float(coefficients[2]), 0.0),
        )


@dataclass(frozen=True)
class TurnTables:
    """Turn tables of a vessel for several rudder angles.

    Attributes:
        tables: turn tables in order of decreasing rudder angle.
        speed: speed on straight legs in m/s.
        min_radius: smallest radius of a turn in m.
        is_settled: whether each turn is assumed to start without motion from the previous one.
    """

    tables: tuple[TurnTable, ...]
    speed: float
    min_radius: float
    is_settled: bool = True

    def turns_at(
        self, table_numbers: Sequence[int], hold_times: Array
    ) -> tuple[TrackPart, TrackPart]:
        """Return starboard turns of n tables for hold times [n] in s, and their derivatives."""
        rows, slopes = np.zeros((2, len(hold_times), 3 * N_TURN_POINTS + 1))
        for number, turn_indices in _group_by_table(table_numbers):
            rows[turn_indices] = self.tables[number].spline(hold_times[turn_indices])
            slopes[turn_indices] = self.tables[number].spline_derivative(hold_times[turn_indices])
        turn_parts, derivatives = (
            TrackPart(
                part[:, :N_TURN_POINTS] + 1j * part[:, N_TURN_POINTS : 2 * N_TURN_POINTS],
                part[:, -2],
                part[:, -1],
            )
            for part in (rows, slopes)
        )
        return turn_parts, derivatives

    def legs_after(
        self, table_numbers: Sequence[int], lengths: Array
    ) -> tuple[TrackPart, TrackPart]:
        """Return the legs after turns of n tables at lengths [n, K] in m, and derivatives."""
        count = len(lengths)
        leg_and_derivative = [
            TrackPart(np.zeros(lengths.shape, complex), np.zeros(count), np.zeros(count))
            for _ in range(2)
        ]
        for number, turn_indices in _group_by_table(table_numbers):
            for target_part, table_part in zip(
                leg_and_derivative, self.tables[number].leg_at(lengths[turn_indices]), strict=True
            ):
                for target, source in zip(target_part, table_part, strict=True):
                    target[turn_indices] = source
        return leg_and_derivative[0], leg_and_derivative[1]


def _group_by_table(table_indices: Sequence[int]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return each table's number with the indices of the turns that use it."""
    table_numbers = np.array(table_indices, dtype=np.intp)
    return [
        (int(number), np.flatnonzero(table_numbers == number))
        for number in np.unique(table_numbers)
    ]


def arc_turns(radii: Array, speed: float) -> TurnTables:
    """Return turn tables of a vessel without yaw inertia: arcs of the radii [n] in m."""
    angles = np.linspace(0.0, _MAX_TURN_ANGLE, _N_HOLD_TIMES)
    headings = angles[:, None] * np.linspace(0.0, 1.0, N_TURN_POINTS + 1)[1:]
    tables = [
        TurnTable(
            angles * radius / speed,
            1j * radius * (1.0 - np.exp(1j * headings)),
            headings,
            angles * radius / speed,
            0.0,
        )
        for radius in radii
    ]
    return TurnTables(tuple(tables), speed, float(radii[0]))


def simulate_turns(turn_maker: TurnMaker, rudder: Array, radius: float) -> TurnTables:
    """Simulate turn tables for rudder angles [n], each turn from a straight course.

    The sway velocity decays after a turn. The leg is placed on the final straight track, and the
    last part of the turn is shifted smoothly towards it.

    Args:
        turn_maker: simulates the turns.
        rudder: rudder angles in rad, in decreasing order.
        radius: smallest turning radius of the vessel in m.
    """
    nomoto = turn_maker.nomoto
    hold_grid = np.stack(
        [_hold_times(np.linspace(0.0, 1.0, _N_HOLD_TIMES), angle, nomoto) for angle in rudder]
    )
    settling_time = _SETTLING_TIME * nomoto.time
    simulated = turn_maker(
        hold_grid[:, 1:], rudder, [turn_maker.straight_state] * len(rudder), settling_time
    )
    share = np.linspace(0.0, 1.0, N_TURN_POINTS + 1)[1:]
    tables = []
    residual_motion = 0.0
    for angle, table_holds, group in zip(rudder, hold_grid, simulated, strict=True):
        points, headings, times = _sample_turns(group)
        for k, turn in enumerate(group):
            track, course = turn.leg_at(np.linspace(0.0, settling_time, 60))
            distance = float(np.hypot(*np.diff(track, axis=0).T).sum())
            leg_origin = complex(*track[-1]) - distance * np.exp(1j * course[-1])
            speed_change = abs(distance / (nomoto.speed * settling_time) - 1.0)
            lateral_shift = abs(leg_origin - points[k, -1]) / radius
            residual_motion = max(
                residual_motion,
                speed_change,
                lateral_shift,
                abs(float(course[-1]) - headings[k, -1]),
            )
            # a cubic weight leaves the start of the turn and its slope and curvature there
            # unchanged
            points[k] += share**3 * (leg_origin - points[k, -1])
            headings[k] += share**3 * (course[-1] - headings[k, -1])
        zero_row = np.zeros((1, N_TURN_POINTS))
        tables.append(
            TurnTable(
                table_holds,
                np.concatenate((zero_row, points)),
                np.concatenate((zero_row, headings)),
                np.concatenate(([0.0], times)),
                float(angle),
            )
        )
    return TurnTables(
        tuple(tables), nomoto.speed, radius, residual_motion < _RESIDUAL_MOTION_TOLERANCE
    )


def simulate_following_turns(
    turn_maker: TurnMaker,
    hold_grid: Array,
    rudder: Array,
    initial_states: Sequence[Array],
    radius: float,
) -> tuple[TurnTables, list[Turn]]:
    """Simulate tables of n consecutive turns, each with its own initial motion.

    Args:
        turn_maker: simulates the turns.
        hold_grid: hold times [n, K] in s, with K odd.
        rudder: rudder angles [n] in rad, positive to starboard.
        initial_states: initial state of the vessel [nx] for each turn.
        radius: smallest turning radius of the vessel in m.

    Returns:
        The tables, and the turn at the middle of each table's grid.
    """
    settling_time = 2.0 * _SETTLING_TIME * turn_maker.nomoto.time
    simulated = turn_maker(hold_grid, rudder, initial_states, settling_time)
    tables = []
    middles = []
    for angle, table_holds, group in zip(rudder, hold_grid, simulated, strict=True):
        points, headings, times = _sample_turns(group)
        middle_turn = group[len(group) // 2]
        track, course = middle_turn.leg_at(np.linspace(0.0, settling_time, 80))
        positions = (track - track[0]) @ (1.0, 1j) * np.exp(-1j * course[0])
        leg = np.stack((positions.real, positions.imag, course - course[0]), axis=-1)
        # tables hold turns to starboard; turns to port are mirrored
        if angle < 0:
            points = points.conj()
            headings = -headings
            leg[:, 1:] *= -1.0
        distance = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(positions)))))
        tables.append(
            TurnTable(
                table_holds, points, headings, times, abs(float(angle)), CubicSpline(distance, leg)
            )
        )
        middles.append(middle_turn)
    return TurnTables(tuple(tables), turn_maker.nomoto.speed, radius), middles


def state_after_turn(turn: Turn, length: float) -> Array:
    """Return the state of the vessel [nx] after `length` m of the leg that follows a turn."""
    times = np.linspace(0.0, float(turn.leg_phase.x[-1]), 80)
    track, _ = turn.leg_at(times)
    distance = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))))
    state: Array = turn.leg_phase(float(np.interp(length, distance, times)))
    return state


def _sample_turns(group: Sequence[Turn]) -> tuple[np.ndarray, Array, Array]:
    """Sample K turns uniformly in time: points and headings [K, P], and durations [K]."""
    share = np.linspace(0.0, 1.0, N_TURN_POINTS + 1)[1:]
    points = np.zeros((len(group), N_TURN_POINTS), dtype=complex)
    headings = np.zeros((len(group), N_TURN_POINTS))
    for k, turn in enumerate(group):
        track, headings[k] = turn.track_at(share * turn.duration)
        points[k] = track @ (1.0, 1j)
    return points, headings, np.array([turn.duration for turn in group])


def _hold_times(share: Array, rudder: float, nomoto: NomotoModel) -> Array:
    """Return hold times in s for fractions of the largest turn angle.

    In Nomoto's model a turn with hold time t1 has the angle K d (t1 - t2) with
    t2 = T ln(2 - exp(-t1 / T)).

    Args:
        share: fractions of the largest turn angle.
        rudder: rudder angle d in rad.
        nomoto: K and T of the vessel.
    """
    max_hold_time = _MAX_TURN_ANGLE / (nomoto.gain * rudder) + math.log(2.0) * nomoto.time
    # a finer grid for short turns, whose shape changes more with the hold time
    return share**1.3 * max_hold_time


N_LEG_POINTS = 12
"""Number of points of a leg, without its start."""
_OVERSAMPLING = 8
"""Factor by which the final route has more points per turn than the route in the search."""


@dataclass(frozen=True)
class TurnSpec:
    """A turn of a route outline, whose hold time is not yet fitted.

    Attributes:
        turn_sign: +1 to starboard, -1 to port.
        angle: turn angle in rad, positive.
        table: number of the turn table.
        passed_buoys: numbers of the buoys that are passed during the turn.
    """

    turn_sign: int
    angle: float
    table: int
    passed_buoys: tuple[int, ...] = ()


@dataclass(frozen=True)
class RouteOutline:
    """Legs and turns of a route before the fit of their lengths and hold times.

    Attributes:
        heading: heading of the first leg in rad.
        legs: lengths of the n + 1 legs in m.
        turns: the n turns between the legs.
        passed_on_legs: for each leg, the numbers of the buoys that are passed on it.
    """

    heading: float
    legs: tuple[float, ...]
    turns: tuple[TurnSpec, ...]
    passed_on_legs: tuple[tuple[int, ...], ...]

    def simplify(self, min_leg: float, min_angle: float) -> RouteOutline:
        """Merge turns to the same side that a short leg separates, and remove small turns.

        Args:
            min_leg: length in m below which the leg between two turns is removed.
            min_angle: angle in rad below which a turn is removed.
        """
        sketch = self
        k = 0
        while k < len(sketch.turns):
            turn = sketch.turns[k]
            if turn.angle < min_angle:
                sketch = sketch._remove_turn(k)
                k = max(k - 1, 0)
                continue
            next_turn = sketch.turns[k + 1] if k + 1 < len(sketch.turns) else None
            if next_turn and next_turn.turn_sign == turn.turn_sign and sketch.legs[k + 1] < min_leg:
                sketch = sketch._merge_turns(k)
                continue
            k += 1
        return sketch

    def _remove_turn(self, k: int) -> RouteOutline:
        """Return the outline without turn k; the legs before and after it become one leg."""
        legs = (*self.legs[:k], self.legs[k] + self.legs[k + 1], *self.legs[k + 2 :])
        merged_passed = (
            *self.passed_on_legs[k],
            *self.turns[k].passed_buoys,
            *self.passed_on_legs[k + 1],
        )
        passed_on_legs = (*self.passed_on_legs[:k], merged_passed, *self.passed_on_legs[k + 2 :])
        return RouteOutline(
            self.heading, legs, (*self.turns[:k], *self.turns[k + 1 :]), passed_on_legs
        )

    def _merge_turns(self, k: int) -> RouteOutline:
        """Return the outline with turns k and k + 1 merged into one."""
        first = self.turns[k]
        second = self.turns[k + 1]
        wider_turn = max(first, second, key=lambda bend: bend.angle)
        merged_turn = replace(
            wider_turn,
            angle=first.angle + second.angle,
            passed_buoys=(*first.passed_buoys, *self.passed_on_legs[k + 1], *second.passed_buoys),
        )
        half_leg = 0.5 * self.legs[k + 1]
        legs = (
            *self.legs[:k],
            self.legs[k] + half_leg,
            self.legs[k + 2] + half_leg,
            *self.legs[k + 3 :],
        )
        passed_on_legs = (*self.passed_on_legs[: k + 1], *self.passed_on_legs[k + 2 :])
        return RouteOutline(
            self.heading, legs, (*self.turns[:k], merged_turn, *self.turns[k + 2 :]), passed_on_legs
        )


@dataclass(frozen=True)
class RouteGeometry:
    """Points and duration of a route, with their derivatives by the route variables z.

    A point depends on the variable of its own part of the route and on the variables of all earlier
    parts. An earlier variable translates the point and rotates it about the end of its part.

    Attributes:
        points: complex positions [S] in m.
        time: duration in s.
        heading: heading of the last leg in rad.
        time_gradient: derivatives [nz] of the duration.
        heading_gradient: derivatives [nz] of the last heading.
        own_point_derivatives: derivatives [S] of the points by the variable of their own part.
        part_index: number of that variable in z, [S].
        first_point_after: first point after the part of each variable, [nz].
        shift_derivatives: translation of later points by each variable, complex [nz].
        rotation_derivatives: rotation of later points by each variable [nz] in rad.
        rotation_pivot: centre of that rotation, complex [nz] in m.
        units: unit of each variable [nz].
    """

    points: np.ndarray
    time: float
    heading: float
    time_gradient: Array
    heading_gradient: Array
    own_point_derivatives: np.ndarray
    part_index: NDArray[np.intp]
    first_point_after: NDArray[np.intp]
    shift_derivatives: np.ndarray
    rotation_derivatives: Array
    rotation_pivot: np.ndarray
    units: Array

    def point_jacobian(self, point_numbers: NDArray[np.intp]) -> np.ndarray:
        """Return the derivatives [P, nz] of the points with numbers [P] by z."""
        offsets = self.points[point_numbers][:, None] - self.rotation_pivot
        rows = np.where(
            point_numbers[:, None] >= self.first_point_after,
            self.shift_derivatives + 1j * self.rotation_derivatives * offsets,
            0.0,
        )
        own_parts = self.part_index[point_numbers]
        movable = np.flatnonzero(own_parts > 0)
        rows[movable, own_parts[movable]] = self.own_point_derivatives[point_numbers[movable]]
        result: np.ndarray = rows * self.units
        return result


def _mirror_to_side(points: np.ndarray, turn_signs: Array) -> np.ndarray:
    """Mirror starboard turns [n, K] where the sign [n] is -1 (port)."""
    result: np.ndarray = points.real + 1j * turn_signs[:, None] * points.imag
    return result


@final
@dataclass
class Route:
    """A route as a differentiable function of its variables z.

    z is (first heading, leg, hold time, leg, hold time, ..., leg), with headings in rad, legs in m
    and hold times in s, each divided by its unit.

    Attributes:
        start: complex start position in m.
        turn_signs: +1 (starboard) or -1 (port) for each of the n turns.
        table_numbers: number of the turn table for each turn.
        turns: the turn tables.
        units: units [2 n + 2] of z.
    """

    start: complex
    turn_signs: tuple[int, ...]
    table_numbers: tuple[int, ...]
    turns: TurnTables
    units: Array = field(init=False)

    def __post_init__(self) -> None:
        self.units = np.ones(2 + 2 * len(self.turn_signs))
        # variables of order one, so that one trust radius applies to all of them
        self.units[1::2] = self.turns.min_radius
        self.units[2::2] = self.turns.min_radius / self.turns.speed

    def initial_z(self, sketch: RouteOutline) -> Array:
        """Convert an outline to z, with legs shortened by the space that the turns need."""
        z = np.zeros(len(self.units))
        z[0] = sketch.heading
        legs = np.array(sketch.legs)
        for k, turn in enumerate(sketch.turns):
            table = self.turns.tables[turn.table]
            _, lead_in, lead_out = table.fitted_arc
            z[2 + 2 * k] = table.hold_time(turn.angle)
            # small turns need less straight length; 0.8 rad is where the full length is needed
            room_share = min(turn.angle / 0.8, 1.0)
            legs[k] -= room_share * lead_in
            legs[k + 1] -= room_share * lead_out
        z[1::2] = np.maximum(legs, 0.0)
        result: Array = z / self.units
        return result

    def lower_bounds(self) -> Array:
        """Return the smallest z."""
        lower = np.zeros(len(self.units))
        lower[0] = -np.inf
        lower[2::2] = [self.turns.tables[number].hold_times[0] for number in self.table_numbers]
        result: Array = lower / self.units
        return result

    def upper_bounds(self) -> Array:
        """Return the largest z."""
        upper = np.full(len(self.units), np.inf)
        upper[2::2] = [self.turns.tables[number].max_hold_time for number in self.table_numbers]
        result: Array = upper / self.units
        return result

    def passing_points(self, sketch: RouteOutline, buoys: np.ndarray) -> NDArray[np.intp]:
        """Return the point indices [N] at which an outline passes its N buoys, in order."""
        z = self.initial_z(sketch)
        points = self(z).points
        passing_indices = np.zeros(len(buoys), dtype=np.intp)
        previous_index = 0
        point_ranges: list[tuple[int, int, Sequence[int]]] = []
        first_point = 0
        for k, on_leg in enumerate(sketch.passed_on_legs):
            point_ranges.append((first_point, first_point + N_LEG_POINTS, on_leg))
            first_point += N_LEG_POINTS
            if k < len(sketch.turns):
                point_ranges.append(
                    (first_point, first_point + N_TURN_POINTS, sketch.turns[k].passed_buoys)
                )
                first_point += N_TURN_POINTS
        for range_start, range_stop, passed_buoys in point_ranges:
            for buoy in passed_buoys:
                search_start = min(max(range_start, previous_index), range_stop)
                nearest_index = search_start + int(
                    np.abs(points[search_start : range_stop + 1] - buoys[buoy]).argmin()
                )
                passing_indices[buoy] = previous_index = nearest_index
        return passing_indices

    def __call__(self, z: Array) -> RouteGeometry:
        """Compute points and duration of the route z with their derivatives."""
        z = z * self.units
        n_variables = len(z)
        n_turns = len(self.turn_signs)
        speed = self.turns.speed
        signs = np.array(self.turn_signs, dtype=float)
        first_heading = float(z[0])
        first_length = float(z[1])
        shares = np.linspace(0.0, 1.0, N_LEG_POINTS + 1)[1:]
        turn_parts, turn_derivatives = self.turns.turns_at(self.table_numbers, z[2::2])
        leg_parts, leg_derivatives = self.turns.legs_after(
            self.table_numbers, z[3::2, None] * shares
        )
        turn_parts, turn_derivatives, leg_parts, leg_derivatives = (
            part._replace(points=_mirror_to_side(part.points, signs))
            for part in (turn_parts, turn_derivatives, leg_parts, leg_derivatives)
        )
        turn_angles = signs * turn_parts.headings
        leg_angles = signs * leg_parts.headings
        headings = first_heading + np.concatenate(([0.0], np.cumsum(turn_angles + leg_angles)))
        leg_directions = np.exp(1j * headings)
        exit_directions = np.exp(1j * (headings[:-1] + turn_angles))
        track = leg_directions[:-1, None] * turn_parts.points
        leg = exit_directions[:, None] * leg_parts.points
        first_corner = self.start + first_length * leg_directions[0]
        leg_ends = first_corner + np.cumsum(track[:, -1:] + leg[:, -1:])
        turn_ends = np.concatenate(([first_corner], leg_ends))[:-1] + track[:, -1]
        turn_starts = np.concatenate(([first_corner], leg_ends))[:-1]
        track_points = np.concatenate(
            (turn_starts[:, None] + track, turn_ends[:, None] + leg), axis=1
        )
        points = np.concatenate(
            (
                [self.start],
                self.start + first_length * leg_directions[0] * shares,
                track_points.ravel(),
            )
        )
        own_point_derivatives = np.concatenate(
            (
                leg_directions[:-1, None] * turn_derivatives.points,
                shares * exit_directions[:, None] * leg_derivatives.points,
            ),
            axis=1,
        )
        shift_derivatives = np.zeros(n_variables, complex)
        rotation_derivatives = np.zeros(n_variables)
        # each variable moves all later parts of the route as a rigid body
        rotation_pivot = np.full(n_variables, self.start)
        rotation_derivatives[0] = 1.0
        shift_derivatives[1] = leg_directions[0]
        rotation_pivot[1] = first_corner
        rotation_derivatives[2::2] = signs * turn_derivatives.headings
        rotation_derivatives[3::2] = signs * leg_derivatives.headings
        shift_derivatives[2::2] = leg_directions[:-1] * turn_derivatives.points[:, -1]
        shift_derivatives[3::2] = exit_directions * leg_derivatives.points[:, -1]
        rotation_pivot[2::2] = turn_ends
        rotation_pivot[3::2] = leg_ends
        lengths = np.array([1, N_LEG_POINTS, *(N_TURN_POINTS, N_LEG_POINTS) * n_turns])
        time_gradient = np.zeros(n_variables)
        time_gradient[1::2] = 1.0 / speed
        time_gradient[2::2] = turn_derivatives.times
        return RouteGeometry(
            points,
            float(z[1::2].sum()) / speed + float(turn_parts.times.sum()),
            float(headings[-1]),
            time_gradient * self.units,
            rotation_derivatives * self.units,
            np.concatenate(([0.0], leg_directions[0] * shares, own_point_derivatives.ravel())),
            np.repeat(np.arange(n_variables), lengths),
            np.concatenate(([0], np.cumsum(lengths)[1:])),
            shift_derivatives,
            rotation_derivatives,
            rotation_pivot,
            self.units,
        )

    def to_segments(self, z: Array) -> list[tuple[np.ndarray, Array, float]]:
        """Return each part of a route: complex points [K] in m, headings [K], rudder angle, rad."""
        z = z * self.units
        heading_offset = float(z[0])
        position = self.start
        direction = cmath.exp(1j * heading_offset)
        segments = [
            (
                np.array([position, position + float(z[1]) * direction]),
                np.full(2, heading_offset),
                0.0,
            )
        ]
        position += float(z[1]) * direction
        for k, (turn_sign, number) in enumerate(
            zip(self.turn_signs, self.table_numbers, strict=True)
        ):
            hold_time = float(z[2 + 2 * k])
            leg_length = float(z[3 + 2 * k])
            table = self.turns.tables[number]
            track, heading, duration = table(hold_time)
            share = min(hold_time / duration, 1.0) if duration > 0 else 1.0
            switch_index = min(
                max(round(share * _OVERSAMPLING * N_TURN_POINTS), 1), _OVERSAMPLING * N_TURN_POINTS
            )
            track = np.concatenate(([0.0], track if turn_sign > 0 else track.conj()))
            heading = np.concatenate(([0.0], turn_sign * heading))
            uniform_grid = np.linspace(0.0, 1.0, N_TURN_POINTS + 1)
            track_spline = CubicSpline(
                uniform_grid, np.stack((track.real, track.imag, heading.real), axis=-1)
            )
            fine_track = track_spline(np.linspace(0.0, 1.0, _OVERSAMPLING * N_TURN_POINTS + 1))
            points = position + direction * (fine_track[:, 0] + 1j * fine_track[:, 1])
            heading = fine_track[:, 2]
            segments.append(
                (
                    points[: switch_index + 1],
                    heading_offset + heading[: switch_index + 1],
                    turn_sign * table.rudder,
                )
            )
            segments.append(
                (
                    points[switch_index:],
                    heading_offset + heading[switch_index:],
                    -turn_sign * table.rudder,
                )
            )
            heading_offset += float(heading[-1])
            direction = cmath.exp(1j * heading_offset)
            position = complex(points[-1])
            leg_part, _ = table.leg_at(leg_length * np.linspace(0.0, 1.0, 100)[:, None] ** 2)
            leg_points = leg_part.points[:, 0] if turn_sign > 0 else leg_part.points[:, 0].conj()
            segments.append(
                (
                    position + direction * leg_points,
                    heading_offset + turn_sign * leg_part.headings,
                    0.0,
                )
            )
            heading_offset += turn_sign * float(leg_part.headings[-1])
            direction = cmath.exp(1j * heading_offset)
            position = complex(segments[-1][0][-1])
        return segments
