"""Simulated turns of a vessel, for the planning of courses.

A turn has three phases: a constant rudder angle, counter-rudder until the yaw rate is zero, and
rudder amidships on the leg that follows. A turn table interpolates turns over the hold time, which
is the duration of the first phase. Positions are complex numbers, north + i east, in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
                self.rollouts[dt] = Rollout(self.vessel.nominal_model(dt))
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
        states, _, _ = Rollout(vessel.nominal_model(dt))(
            x, w.unsqueeze(1).expand(-1, steps, -1), variation
        )
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
