"""Physical checks of a model: damping, stability, symmetry, bounded motion.

Faults at recorded states and inputs make a model unsound, so that an equally good sound model is
selected instead. Faults elsewhere are reported and do not affect the selection.

Some full hulls are unstable on a straight course. Instability is therefore a fault only if the
vessel itself, with constant inputs, settled after a disturbance such as the entry of a turn, and
remained settled for several growth times of the model's disturbances. An undisturbed straight run
is no evidence. The model is then simulated with disturbances as large as the deviations in the log.
In unmeasured wind these are not zero, and a model may oscillate in a steady turn as the vessel did.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from residnet.core.columns import all_but_pose
from residnet.core.format import display_unit, format_interval, format_number
from residnet.core.layout import LATERAL, POSE, SURGE, SWAY
from residnet.core.names import WIND_INPUTS, get_pair_parity
from residnet.core.stretches import find_runs
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout
from residnet.evaluation.records import SANITY_CHECKS, SanityFile, SanityRow
from residnet.physics.symmetry import (
    find_heeling_propellers,
    get_axis_parities,
    get_channel_parity,
    get_partners,
)
from residnet.preprocessing.prepare import PreparedLog

SCHEMA: Final = "residnet.sanity/1"
DAMPING, STABILITY, SYMMETRY, BOUNDEDNESS = SANITY_CHECKS

_N_CHECK_POINTS = 90
"""Number of recorded states to check, without those of extreme inputs; chosen by hand."""
_NEGLIGIBLE_SLOPE_SHARE = 0.05
"""A positive slope below this share of the typical magnitude does not count as a wrong sign."""
_MAX_DOUBLING_TIME = 300.0
"""Longest doubling time in s of a disturbance that counts as unstable."""
_MAX_ASYMMETRY = 0.1
"""Largest asymmetric part of the acceleration of a symmetric model, relative to its spread."""
_LONG_RUN_DURATION = 300.0
"""Shortest duration in s of the runs with constant inputs that check for bounded motion; equal to
the longest doubling time."""
_MEMORY_SETTLING_TIME = 10.0
"""Time in s in constant states after which the memory of a head counts as settled."""
_STEADY_TOLERANCE = 1e-4
"""Change of the velocities, relative to their limits, below which a free run counts as steady."""
_SPEED_FRACTIONS = (0.0, 0.25, 0.5, 0.67, 1.0, 1.5)
"""Speeds of straight running, relative to the largest training speed."""
_CRUISE_FRACTION = 0.67
"""Speed among these that is called cruise."""
_MAX_CORNERS = 64
"""Largest number of corners of the input ranges: all corners of up to six inputs."""
_CONSTANT_INPUT_TOLERANCE = 0.02
"""Tolerance of a constant input relative to its range."""
_MIN_CONSTANT_DURATION = 5.0
"""Shortest duration in s of a run with constant inputs."""
_MIN_MODEL_GROWTH = 20.0
"""A steady run contradicts a model whose disturbances would grow by more than this factor in it."""
_MAX_MEASURED_GROWTH = 3.0
"""A run is steady if its measured deviation grows by less than this factor."""
_MIN_MEASURED_DECAY = 3.0
"""A run shows that the vessel is stable if its initial deviation decays by more than this factor.
"""
_MAX_STEADY_RUNS = 20
"""Number of steady runs that are checked."""
_SETTLING_SHARE = 0.25
"""Initial share of a steady run in which the motion settles."""
_DISTURBANCE_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Signs of the initial disturbances of sway and yaw."""


@dataclass(frozen=True)
class SteadyRun:
    """A segment of a log with constant inputs.

    Attributes:
        log: name of the log.
        duration: duration in s without the settling time.
        mean_state: mean state [3 + n] with the pose at zero.
        mean_inputs: mean inputs [m].
        decay: distance of the lateral velocities from their final mean at the start of the segment,
            over that at its end.
        growth: distance of the lateral velocities from the mean of the first third in the last
            third, over that in the first third.
        scatter: standard deviations of the lateral velocities [2].
    """

    log: str
    duration: float
    mean_state: np.ndarray
    mean_inputs: np.ndarray
    decay: float
    growth: float
    scatter: np.ndarray


@dataclass(frozen=True)
class TrainingPoints:
    """States, inputs and steady runs of the training logs for the checks.

    Attributes:
        x: recorded states [K, 3 + n] with the pose at zero.
        w: inputs [K, m].
        longest_duration: duration of the longest log in s.
        steady_runs: segments with constant inputs.
    """

    x: Tensor
    w: Tensor
    longest_duration: float
    steady_runs: Sequence[SteadyRun]

    @classmethod
    def from_logs(cls, logs: Sequence[PreparedLog], dt: float) -> TrainingPoints:
        """Return samples at evenly spaced speeds, samples of extreme inputs, and steady runs."""
        # large data sets do not fit into memory: only speeds are concatenated over all logs, states
        # only at the selected samples
        usable_indices = [np.flatnonzero(log.usable) for log in logs]
        logs_and_indices = list(zip(logs, usable_indices, strict=True))
        speed = np.concatenate(
            [
                np.hypot(*log.smoothed[sample_indices, SURGE : SURGE + 2].T)
                for log, sample_indices in logs_and_indices
            ]
        )
        # evenly spaced ranks of the speed cover rare speeds in proportion to their samples
        speed_order = np.argsort(speed, kind="stable")
        evenly_spread = speed_order[
            np.linspace(0, len(speed_order) - 1, min(_N_CHECK_POINTS, len(speed_order)))
            .round()
            .astype(int)
        ]
        extreme_indices = []
        for column in range(logs[0].w.shape[1]):
            w = np.concatenate(
                [log.w[sample_indices, column] for log, sample_indices in logs_and_indices]
            )
            extreme_indices += [w.argmin(), w.argmax()]
        selected_samples = np.union1d(
            evenly_spread, np.array(extreme_indices, dtype=evenly_spread.dtype)
        )
        cumulative_counts = np.cumsum([len(sample_indices) for sample_indices in usable_indices])
        selected_by_log = [
            (
                log,
                sample_indices[
                    selected_samples[
                        (selected_samples >= cumulative_count - len(sample_indices))
                        & (selected_samples < cumulative_count)
                    ]
                    - (cumulative_count - len(sample_indices))
                ],
            )
            for (log, sample_indices), cumulative_count in zip(
                logs_and_indices, cumulative_counts, strict=True
            )
        ]
        x = np.concatenate(
            [log.smoothed[sample_indices] for log, sample_indices in selected_by_log]
        )
        w = np.concatenate([log.w[sample_indices] for log, sample_indices in selected_by_log])
        x[:, POSE] = 0.0
        longest_duration = max(float(log.log.t[-1] - log.log.t[0]) for log in logs)
        return cls(
            torch.from_numpy(x), torch.from_numpy(w), longest_duration, find_steady_runs(logs, dt)
        )


def find_steady_runs(logs: Sequence[PreparedLog], dt: float) -> list[SteadyRun]:
    """Return the segments of logs with inputs constant within 2 % of their ranges.

    Segments last at least five seconds. The statistics exclude the first quarter of each, in which
    the motion settles.
    """
    usable_inputs = [log.w[log.usable] for log in logs if log.usable.any()]
    input_ranges = np.max([inputs.max(0) for inputs in usable_inputs], 0) - np.min(
        [inputs.min(0) for inputs in usable_inputs], 0
    )
    tolerance = _CONSTANT_INPUT_TOLERANCE * np.maximum(input_ranges, 1e-12)
    # logs with steps of several seconds (AIS) would have segments without any sample
    min_length = max(round(_MIN_CONSTANT_DURATION / dt), 2)
    runs = []
    for log in logs:
        for run_start, run_end in _constant_input_runs(log, tolerance, min_length):
            settled_slice = slice(run_start + int(_SETTLING_SHARE * (run_end - run_start)), run_end)
            settled_states = log.smoothed[settled_slice]
            lateral_velocities = log.smoothed[settled_slice, LATERAL]
            mean_state = settled_states.mean(0)
            mean_state[POSE] = 0.0
            third_length = max(len(lateral_velocities) // 3, 1)
            first_mean = lateral_velocities[:third_length].mean(0)
            last_mean = lateral_velocities[-third_length:].mean(0)
            entry_velocities = log.smoothed[
                run_start : run_start + max(third_length // 10, 1), LATERAL
            ]
            initial_deviation, final_deviation, early_deviation, late_deviation = (
                np.abs(velocities - reference_mean).mean(0)
                for velocities, reference_mean in (
                    (entry_velocities, last_mean),
                    (lateral_velocities[-third_length:], last_mean),
                    (lateral_velocities[:third_length], first_mean),
                    (lateral_velocities[-third_length:], first_mean),
                )
            )
            decay = float((initial_deviation / np.maximum(final_deviation, 1e-9)).max())
            growth = float((late_deviation / np.maximum(early_deviation, 1e-9)).max())
            inputs = log.w[settled_slice].mean(0)
            lateral_std = lateral_velocities.std(0)
            runs.append(
                SteadyRun(
                    log.log.name,
                    len(settled_states) * dt,
                    mean_state,
                    inputs,
                    decay,
                    growth,
                    lateral_std,
                )
            )
    return runs


def _constant_input_runs(
    log: PreparedLog, tolerance: np.ndarray, min_length: int
) -> Iterator[tuple[int, int]]:
    """Return first sample and end of each segment with constant inputs.

    Inputs differ from the first sample by at most a tolerance [m]. Segments do not overlap.
    """
    for segment_start, segment_end in zip(*find_runs(log.segment), strict=True):
        start = int(segment_start)
        while segment_end - start >= min_length:
            exceeds_tolerance = (np.abs(log.w[start:segment_end] - log.w[start]) > tolerance).any(1)
            run_stop = start + (
                int(exceeds_tolerance.argmax()) if exceeds_tolerance.any() else segment_end - start
            )
            if run_stop - start >= min_length:
                yield start, run_stop
            start = max(run_stop, start + 1)


def check_model(
    spec: ModelSpec,
    model: HybridDynamics,
    training_points: TrainingPoints,
    divergence_factor: float = 3.0,
) -> list[SanityRow]:
    """Return the results of all checks of one model, in the order of `SANITY_CHECKS`.

    Args:
        spec: description of the model; it holds the training ranges.
        model: the model, which is not modified.
        training_points: states, inputs and steady runs of the training logs.
        divergence_factor: multiple of the largest training velocity above which a run has diverged.
    """
    # a copy, since the checks convert it to float64
    model = copy.deepcopy(model).to(torch.float64).eval()
    n_threads = torch.get_num_threads()
    # for such small matrices a second thread costs more time than it saves
    torch.set_num_threads(1)
    # the memory of an ensemble is too large for a Jacobian at each point; its free runs are checked
    ensemble_text = "not checked for a mean of several models; see the check of bounded free runs"
    straight_text = "not checked: the model has neither sway nor yaw"
    straight_text = straight_text if spec.signals.velocities == ("u",) else ""
    skip_reason = straight_text or (ensemble_text if isinstance(model, MeanOfTrajectories) else "")
    try:
        return [
            check_damping(spec, model, training_points),
            _skip_check(spec, STABILITY, skip_reason)
            if skip_reason
            else check_stability(spec, model, training_points),
            _skip_check(spec, SYMMETRY, straight_text)
            if straight_text
            else check_symmetry(spec, model, training_points),
            check_boundedness(spec, model, training_points, divergence_factor),
        ]
    finally:
        torch.set_num_threads(n_threads)


def _to_sanity_finding(
    spec: ModelSpec, check: str, passed: bool, text: str, fault: str
) -> SanityRow:
    full_text = f"unsound: {fault}. {text}" if fault else text
    return SanityRow(
        model=spec.name, check=check, ok=passed and not fault, text=full_text, fault=fault
    )


def _skip_check(spec: ModelSpec, check: str, reason: str) -> SanityRow:
    """Return the finding of a check that does not apply or could not be made."""
    return SanityRow(model=spec.name, check=check, ok=None, text=reason)


def settle_memory(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return the memory [B, n_state] after ten seconds in states x [B, 3 + n], inputs w [B, m]."""
    n_steps = max(round(_MEMORY_SETTLING_TIME / model.dt), 1) if model.n_state else 0
    return model.warmup(x[:, None].expand(-1, n_steps, -1), w[:, None].expand(-1, n_steps, -1))


def settled_acceleration(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return nu_dot [B, n] of baseline and head together, with the head's memory settled.

    The memory of a head with innovation input is zero: constant states would appear to it as the
    effect of an external force.
    """
    memory = (
        model.initial_state(len(x)).to(x) if model.has_innovation else settle_memory(model, x, w)
    )
    return model.acceleration(x, w, memory)


def check_damping(
    spec: ModelSpec, model: HybridDynamics, training_points: TrainingPoints
) -> SanityRow:
    """Check that each velocity is damped: d u_dot/du < 0, d v_dot/dv < 0 and so on.

    No derivative may be positive at more than half of the recorded points, unless it is negligible
    against its values at the other points.
    """
    x, dof = training_points.x.clone().requires_grad_(), spec.signals.dof
    # autograd needs a dependence on x, which a model without velocity terms does not have
    nu_dot = settled_acceleration(model, x, training_points.w) + 0.0 * all_but_pose(x)
    damping_slopes = np.stack(
        [
            torch.autograd.grad(nu_dot[:, i].sum(), x, retain_graph=True)[0][:, SURGE + i].numpy()
            for i in dof.active_velocity_indices
        ],
        axis=1,
    )
    # the median, since a few points near zero speed may have any sign
    median_slopes = np.median(damping_slopes, axis=0)
    # a high quantile: the typical damping at the speeds of the logs
    typical_sizes = np.quantile(np.abs(damping_slopes), 0.9, axis=0)
    wrong_signs = [
        f"d({name}_dot)/d{name} {median_slopes[i]:+.2g} 1/s, positive at"
        f" {100.0 * (damping_slopes[:, i] > 0).mean():.0f} %"
        for i, name in enumerate(dof.velocities)
        if median_slopes[i] > _NEGLIGIBLE_SLOPE_SHARE * typical_sizes[i]
    ]
    fault = f"its damping has the wrong sign at most recorded states ({'; '.join(wrong_signs)})"
    medians_text = ", ".join(
        f"d({name}_dot)/d{name} {median_slopes[i]:+.3g}" for i, name in enumerate(dof.velocities)
    )
    text = f"medians over the training data: {medians_text} 1/s"
    return _to_sanity_finding(spec, DAMPING, True, text, fault if wrong_signs else "")


@dataclass(frozen=True)
class OperatingPoint:
    """Straight running at one speed.

    Attributes:
        label: `rest` or `cruise`; empty for other speeds.
        speed: speed in m/s.
        x: state [3 + n].
        w: inputs [m].
        is_inside_training_range: whether state and inputs are in the range of the training data.
    """

    label: str
    speed: float
    x: Tensor
    w: Tensor
    is_inside_training_range: bool

    def __str__(self) -> str:
        label_text = f"{self.label}, " if self.label else ""
        outside_text = "" if self.is_inside_training_range else " (outside the training data)"
        return f"{label_text}u = {format_number(self.speed)} m/s{outside_text}"


def find_operating_points(spec: ModelSpec, model: HybridDynamics) -> list[OperatingPoint]:
    """Return operating points of straight motion from zero to 1.5 times the training speed.

    The propulsion command of each point holds its speed approximately. All inputs that do not steer
    move together from the lower to the upper end of their ranges; rudders are amidships and there
    is no wind, as far as the ranges allow.
    """
    input_names = spec.signals.input_columns
    dof = spec.signals.dof
    lower, upper = (
        _range_tensor(range_limits)[dof.n_dynamic :].clone()
        for range_limits in (spec.low, spec.high)
    )
    mirror_partners = get_partners(input_names)
    for name, partner_name in mirror_partners.items():
        # both sides get equal inputs, within their common range
        pair_columns = [input_names.index(name), input_names.index(partner_name)]
        lower[pair_columns], upper[pair_columns] = (
            lower[pair_columns].max(),
            upper[pair_columns].min(),
        )
    neutral_columns = [
        i
        for i, name in enumerate(input_names)
        if name in WIND_INPUTS or (name not in mirror_partners and get_channel_parity(name) == -1)
    ]
    input_candidates = lower + torch.linspace(0.0, 1.0, 41, dtype=torch.float64)[:, None] * (
        upper - lower
    )
    input_candidates[:, neutral_columns] = torch.zeros(
        len(neutral_columns), dtype=torch.float64
    ).clamp(lower[neutral_columns], upper[neutral_columns])
    points = []
    for speed_fraction in (
        _SPEED_FRACTIONS if "u" in spec.signals.velocities else _SPEED_FRACTIONS[:1]
    ):
        speed = speed_fraction * max(spec.high[0], 1e-6)
        x = torch.zeros(len(input_candidates), len(dof.state_names), dtype=torch.float64)
        x[:, SURGE] = speed
        with torch.no_grad():
            best_index = int(settled_acceleration(model, x, input_candidates)[:, 0].abs().argmin())
        label = {0.0: "rest", _CRUISE_FRACTION: "cruise"}.get(speed_fraction, "")
        is_inside = spec.low[0] <= speed <= spec.high[0]
        points.append(
            OperatingPoint(label, speed, x[best_index], input_candidates[best_index], is_inside)
        )
    return points


def _range_tensor(limits: Sequence[float]) -> Tensor:
    return torch.tensor(limits, dtype=torch.float64)


def check_stability(
    spec: ModelSpec, model: HybridDynamics, training_points: TrainingPoints
) -> SanityRow:
    """Check the growth of small disturbances of sway, yaw, roll and memory in straight running."""
    motion_names = {"v": "sway", "r": "yaw", "p": "roll"}
    motion_text = " and ".join(
        motion_names[name] for name in motion_names if name in spec.signals.velocities
    )
    verb = "are" if " " in motion_text else "is"
    rates_and_points = [
        (compute_growth_rate(model, point.x, point.w), point)
        for point in find_operating_points(spec, model)
    ]
    summary = "; ".join(
        f"{point}: slowest mode "
        + (
            f"halves in {format_number(-math.log(2) / mode_rate, 2)} s"
            if mode_rate < 0
            else f"has rate {mode_rate:+.2g} 1/s"
        )
        for mode_rate, point in rates_and_points
        if point.label
    )
    fault = find_contradicting_steady_run(model, training_points.steady_runs)
    unstable_points = [
        rate_and_point
        for rate_and_point in rates_and_points
        if rate_and_point[0] > math.log(2.0) / _MAX_DOUBLING_TIME
    ]
    if not unstable_points:
        speeds = format_interval(
            [rates_and_points[0][1].speed, rates_and_points[-1][1].speed], digits=2
        )
        text = (
            f"{motion_text} {verb} stable in straight running at {speeds} m/s (no mode doubles"
            f" within {_MAX_DOUBLING_TIME:.0f} s). {summary}"
        )
        return _to_sanity_finding(spec, STABILITY, True, text, fault)
    unstable_inside = [
        rate_and_point
        for rate_and_point in unstable_points
        if rate_and_point[1].is_inside_training_range
    ]
    mode_rate, worst_point = max(
        unstable_inside or unstable_points, key=lambda rate_and_point: rate_and_point[0]
    )
    range_text = "inside the training data" if unstable_inside else "only outside the training data"
    text = (
        f"{motion_text} unstable in straight running, {range_text}: worst at {worst_point},"
        f" where a disturbance doubles in {format_number(math.log(2) / mode_rate, 2)} s. Some full"
        " hulls are unstable in reality; for other vessels long free runs there are unreliable."
        f" {summary}"
    )
    return _to_sanity_finding(spec, STABILITY, False, text, fault)


def compute_growth_rate(model: HybridDynamics, x: Tensor, w: Tensor) -> float:
    """Return the largest growth rate [1/s] of a small disturbance of all but surge at a point.

    It is the logarithm of the step map's spectral radius over dt.

    Args:
        model: model in float64 and evaluation mode.
        x: state [3 + n].
        w: inputs [m].
    """
    memory = settle_memory(model, x[None], w[None])
    perturbed_variables = torch.cat((x[SWAY:], memory[0])).detach()
    n_variables = perturbed_variables.numel()
    n_velocities = len(x) - SWAY
    variables = perturbed_variables.expand(n_variables, n_variables).clone().requires_grad_()
    states = torch.cat((x[:SWAY].expand(n_variables, SWAY), variables[:, :n_velocities]), dim=1)
    next_states, next_memory = model.step(
        states, w.expand(n_variables, -1), variables[:, n_velocities:]
    )
    # row i of the batch is used for output i only, so that one backward pass gives the Jacobian
    next_variables = torch.cat((next_states[:, SWAY:], next_memory), dim=1)
    jacobian = torch.autograd.grad(next_variables.diagonal().sum(), variables)[0]
    spectral_radius = float(torch.linalg.eigvals(jacobian).abs().max())
    return math.log(max(spectral_radius, 1e-12)) / model.dt


def find_contradicting_steady_run(model: HybridDynamics, steady_runs: Sequence[SteadyRun]) -> str:
    """Return a short text on logs that contradict an unstable model; empty if none do.

    A disturbance of the model, linearised about the mean of a steady run, would have grown
    twentyfold during the run, whereas the vessel settled to a third of its initial deviation, and
    its deviation did not grow threefold. The model itself, started with the observed deviations,
    ends at more than three times the observed deviation. The twenty longest runs of this kind are
    checked.
    """
    # an undisturbed straight run would also be steady for an unstable vessel under control
    informative_runs = [
        run
        for run in steady_runs
        if run.decay > _MIN_MEASURED_DECAY and run.growth < _MAX_MEASURED_GROWTH
    ]
    for run in sorted(informative_runs, key=lambda run: -run.duration)[:_MAX_STEADY_RUNS]:
        model_rate = compute_growth_rate(
            model, torch.from_numpy(run.mean_state), torch.from_numpy(run.mean_inputs)
        )
        if (
            model_rate * run.duration > math.log(_MIN_MODEL_GROWTH)
            and _final_deviation(model, run) > _MAX_MEASURED_GROWTH
        ):
            return (
                "it is unstable where the logs are not (a disturbance would double in"
                f" {format_number(math.log(2.0) / model_rate, 2)} s; log {run.log} is steady"
                f" for {run.duration:.0f} s)"
            )
    return ""


def _final_deviation(model: HybridDynamics, run: SteadyRun) -> float:
    """Return the final deviation of the model from a steady run, relative to that of the vessel.

    Runs start with deviations as large as the observed scatter. The result is the mean over the
    last third; infinite for a run that is not finite.
    """
    deviation_scale = torch.from_numpy(np.maximum(run.scatter, 1e-9))
    initial_states = torch.from_numpy(run.mean_state).repeat(len(_DISTURBANCE_SIGNS), 1)
    initial_states[:, LATERAL] += (
        torch.tensor(_DISTURBANCE_SIGNS, dtype=torch.float64) * deviation_scale
    )
    inputs = torch.from_numpy(run.mean_inputs).expand(len(initial_states), -1)
    model_without_pose = copy.deepcopy(model)
    model_without_pose.has_position = False
    n_steps = max(round(run.duration / model.dt), 3)
    with torch.no_grad():
        states, _, _ = Rollout(model_without_pose)(
            initial_states,
            inputs[:, None].expand(-1, n_steps, -1),
            settle_memory(model, initial_states, inputs),
        )
    deviations = states[:, -(n_steps // 3) :, LATERAL] - torch.from_numpy(run.mean_state)[LATERAL]
    return float(torch.nan_to_num(deviations.abs() / deviation_scale, nan=math.inf).mean(1).max())


def mirror_inputs(input_names: Sequence[str], w: Tensor) -> Tensor | None:
    """Return mirrored inputs w [B, m]; None if the mirror image of an input is unknown.

    Rudders and the lateral wind change sign, port and starboard inputs are exchanged.
    """
    mirror_partners = get_partners(input_names)
    parity_by_name = {"wind_speed": 1, "wind_dir": -1}
    mirrored_columns = []
    has_steering = False
    for column, name in enumerate(input_names):
        parity = parity_by_name.get(name, get_channel_parity(name))
        if name in mirror_partners:
            parity = get_pair_parity(name)
            column = input_names.index(mirror_partners[name])
        if parity is None:
            return None
        has_steering |= name in mirror_partners or (parity < 0 and name not in parity_by_name)
        mirrored_columns.append(parity * w[:, column])
    return torch.stack(mirrored_columns, dim=1) if has_steering else None


def check_symmetry(
    spec: ModelSpec, model: HybridDynamics, training_points: TrainingPoints
) -> SanityRow:
    """Check that mirrored states and inputs give the mirrored acceleration, at recorded points."""
    input_names = spec.signals.input_columns
    x = training_points.x
    w = training_points.w
    mirror_image = mirror_inputs(input_names, w)
    if mirror_image is None:
        text = (
            f"not checked: no steering input is recognised among {', '.join(spec.signals.inputs)}"
            " (known are delta and pairs *_port/*_stbd)"
        )
        return _skip_check(spec, SYMMETRY, text)
    dof = spec.signals.dof
    parity = torch.tensor(get_axis_parities(model.signals.names), dtype=x.dtype)
    mirrored_states = x * torch.cat((x.new_tensor([1.0, -1.0, -1.0]), parity))
    mirrored_channels = torch.cat((all_but_pose(mirrored_states), mirror_image), dim=1)
    is_inside = (
        (mirrored_channels >= _range_tensor(spec.low))
        & (mirrored_channels <= _range_tensor(spec.high))
    ).all(1)
    if not bool(is_inside.any()):
        text = "not checked: no recorded state has its mirror image within the training ranges"
        return _skip_check(spec, SYMMETRY, text)
    with torch.no_grad():
        accelerations = settled_acceleration(model, x[is_inside], w[is_inside])
        mirrored_accelerations = settled_acceleration(
            model, mirrored_states[is_inside], mirror_image[is_inside]
        )
    mirrored_accelerations = mirrored_accelerations * parity
    asymmetry = 0.5 * (accelerations - mirrored_accelerations).abs()
    acceleration_std = torch.cat((accelerations, mirrored_accelerations)).std(0).clamp(min=1e-12)
    rms_asymmetry = asymmetry.square().mean(0).sqrt() / acceleration_std
    max_asymmetry = asymmetry.amax(0) / acceleration_std
    # the torque of a single propeller heels the vessel to one side
    roll_excluded = {"p"} if find_heeling_propellers(model.signals.names) else set()
    checked_velocities = [name for name in dof.velocities if name not in roll_excluded]
    percentages = (100 * torch.stack((rms_asymmetry, max_asymmetry), dim=1)).tolist()
    percentages_by_name = dict(zip(dof.dynamic_states, percentages, strict=True))
    max_percentage = max(percentages_by_name[name][0] for name in checked_velocities)
    is_symmetric = max_percentage <= 100 * _MAX_ASYMMETRY
    details = ", ".join(
        "{}_dot {:.1f} % (largest {:.1f} %)".format(name, *percentages_by_name[name])
        for name in dof.velocities
    )
    details += (
        "; roll is not checked, because the torque of a single propeller heels the vessel"
        if roll_excluded
        else ""
    )
    reason = (
        "Possible reasons are a single propeller, an offset of the steering, or too few turns to"
        " one side. "
    )
    text = (
        f"port and starboard {'alike' if is_symmetric else 'differ'}: the asymmetric part of the"
        f" acceleration is up to {max_percentage:.0f} % of its spread."
        f" {'' if is_symmetric else reason}RMS over"
        f" {int(is_inside.sum())} points of the training data: {details}"
    )
    return SanityRow(model=spec.name, check=SYMMETRY, ok=is_symmetric, text=text)


def check_boundedness(
    spec: ModelSpec,
    model: HybridDynamics,
    training_points: TrainingPoints,
    divergence_factor: float,
) -> SanityRow:
    """Check that the motion with constant inputs is bounded.

    Runs start at the recorded points with their inputs, and at zero velocity with inputs at the
    ends of their ranges. They last 300 s, or as long as the longest log.
    """
    max_velocities = spec.signals.dof.range_limits(np.array(spec.low), np.array(spec.high))
    velocity_limits = torch.from_numpy(max_velocities).clamp(min=1e-9)
    lower, upper = (
        _range_tensor(range_limits)[spec.signals.dof.n_dynamic :]
        for range_limits in (spec.low, spec.high)
    )
    n_inputs = lower.numel()
    if 2**n_inputs <= _MAX_CORNERS:
        # binary digits of the corner number select lower or upper limits
        corner_bits = (torch.arange(2**n_inputs)[:, None] >> torch.arange(n_inputs)) & 1
    else:
        generator = torch.Generator().manual_seed(0)
        corner_bits = torch.randint(0, 2, (_MAX_CORNERS, n_inputs), generator=generator)
    corners = lower + corner_bits.double() * (upper - lower)
    n_recorded = len(training_points.x)
    x = torch.cat(
        (training_points.x, training_points.x.new_zeros(len(corners), training_points.x.shape[1]))
    )
    w = torch.cat((training_points.w, corners))
    memory = model.initial_state(len(x)).double()
    previous_velocities = all_but_pose(x)
    chunk_steps = max(round(_MEMORY_SETTLING_TIME / model.dt), 1)
    # the position does not affect the velocities
    model_without_pose = copy.deepcopy(model)
    model_without_pose.has_position = False
    n_steps = round(max(_LONG_RUN_DURATION, training_points.longest_duration) / model.dt)
    rollout = compile_rollout(Rollout(model_without_pose), n_steps)
    constant_inputs = w.unsqueeze(1).expand(-1, chunk_steps, -1)
    divergence_time = torch.zeros(len(x))
    with torch.no_grad():
        # in chunks, so that the loop ends early when all runs are steady or have diverged
        for k in range(chunk_steps, n_steps + 1, chunk_steps):
            states, _, memory = rollout(x, constant_inputs, memory)
            x = states[:, -1]
            velocity_ratio = torch.nan_to_num(
                all_but_pose(x).abs() / velocity_limits, nan=math.inf
            ).amax(1)
            divergence_time = torch.where(
                (divergence_time == 0.0) & (velocity_ratio > divergence_factor),
                k * model.dt,
                divergence_time,
            )
            velocity_change = (
                (all_but_pose(x) - previous_velocities).abs() / velocity_limits
            ).amax(1)
            previous_velocities = all_but_pose(x)
            if bool((divergence_time[:n_recorded] > 0.0).any()) or bool(
                ((velocity_change < _STEADY_TOLERANCE) | (divergence_time > 0)).all()
            ):
                break
    first_diverged = int((divergence_time > 0.0).double().argmax())
    inputs = ", ".join(
        f"{name} {format_number(factor * float(value))} {unit}".removesuffix(" -")
        for name, value in zip(spec.signals.input_columns, w[first_diverged], strict=True)
        for unit, factor in [display_unit(spec.signals.channel_units().get(name, "-"))]
    )
    limit_text = f"(more than {divergence_factor:g} times the largest training velocity)"
    if not bool((divergence_time > 0.0).any()):
        text = (
            f"{n_recorded} runs of {_LONG_RUN_DURATION:.0f} s or longer from recorded states, and"
            f" {len(corners)}"
            " from zero speed with inputs at their limits, are bounded"
        )
        return _to_sanity_finding(spec, BOUNDEDNESS, True, text, "")
    if first_diverged < n_recorded:
        fault = (
            f"it diverges within {float(divergence_time[first_diverged]):.0f} s from a recorded"
            f" state with recorded"
            f" inputs ({inputs})"
        )
        return _to_sanity_finding(spec, BOUNDEDNESS, False, limit_text.strip("()"), fault)
    text = (
        f"diverges within {float(divergence_time[first_diverged]):.0f} s with {inputs} held"
        f" from rest {limit_text}"
    )
    return _to_sanity_finding(spec, BOUNDEDNESS, False, text, "")


def build_sanity_file(findings: Mapping[str, Sequence[SanityRow]]) -> SanityFile:
    """Return the contents of sanity.json from the findings of each model."""
    rows = [row for model_rows in findings.values() for row in model_rows]
    return SanityFile(schema=SCHEMA, findings=tuple(rows))
