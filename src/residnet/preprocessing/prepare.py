"""Prepare logs for identification: uniform grid, masks, smoothed states and derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from residnet.core.arrays import paged
from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import POSE, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import POSE_NAMES
from residnet.core.sample_origins import SampleOrigins
from residnet.core.stretches import number_runs
from residnet.preprocessing.align import GridConfig, align_to_grid
from residnet.preprocessing.channel_values import SPIKE_REASON, bridge_spikes, is_implausible
from residnet.preprocessing.derivatives import DerivativeConfig, SavitzkyGolay
from residnet.preprocessing.masks import (
    HARD_PREFIX,
    MaskConfig,
    MaskRule,
    apply_masks,
    find_scored_samples,
    number_log_segments,
)
from residnet.preprocessing.motion import MotionConfig, complete_motion, fill_sparse

TAIL_SHARE = 0.005
"""Share of samples at each end of the range of a velocity that are treated as possible outliers."""


class PrepareConfig(Config):
    """Settings of the preparation of logs.

    Attributes:
        grid: uniform time grid; its step is the time step of the model.
        masks: rules that exclude samples.
        derivative: smoothing and differentiation of velocities.
        motion: completion of states that were not measured, or not at every sample.
        trim: duration in s at the start and the end of every log that is excluded from
            identification.
        hold: input over the step that follows a sample. `start`: the value at the sample, exact for
            a command that changes on the grid. `mean`: the mean of the values at both ends of the
            step, for a measured quantity such as shaft revolutions; its value at the sample would
            lag by half a step.
        beside: states and inputs that are paired with a derivative in regressions. `samples`: those
            at the sample, with smoothed states. `means`: their weighted means over the samples of
            the derivative filter, with the weights of the filter. With `means` the derivative does
            not lag a step of an input, and short oscillations are attenuated equally on both sides
            of the equation.
    """

    grid: GridConfig
    masks: tuple[MaskConfig, ...] = ()
    derivative: DerivativeConfig = Field(default_factory=SavitzkyGolay)
    motion: MotionConfig = MotionConfig()
    trim: Seconds = Field(default=0.0, ge=0)
    hold: Literal["start", "mean"] = "start"
    beside: Literal["samples", "means"] = "samples"


@dataclass(frozen=True)
class PreparedLog:
    """One log on the grid with all data for identification and evaluation.

    Arrays are float64 with T samples.

    Attributes:
        log: the aligned log with its masks.
        split: train, validation, test or external.
        y: measured states [T, 3 + n]: pose and dynamic states (`DegreesOfFreedom.state_names`).
        smoothed: states with smoothed dynamic states [T, 3 + n].
        nu_dot: derivatives of the dynamic states [T, n].
        w: inputs over the step that follows each sample [T, m].
        regression_inputs: inputs that are paired with the derivatives [T, m], see
            `PrepareConfig.beside`.
        segment: segment number of each sample [T]; -1 outside of segments.
        usable: samples at which free runs are scored [T] bool.
        trainable: samples whose smoothed state and derivative enter fits [T] bool.
        dof: active velocities; the others are zero.
    """

    log: Log
    split: str
    y: np.ndarray
    smoothed: np.ndarray
    nu_dot: np.ndarray
    w: np.ndarray
    regression_inputs: np.ndarray
    segment: np.ndarray
    usable: np.ndarray
    trainable: np.ndarray
    dof: DegreesOfFreedom = SURGE_SWAY_YAW

    def __len__(self) -> int:
        return len(self.log)

    def to_table_row(self, split: str) -> dict[str, str | float | None]:
        """Return a row of the table of logs, with the shares of usable and trainable samples.

        Args:
            split: split in the table.
        """
        return {
            "log": self.log.name,
            "split": split,
            "manoeuvre": self.log.manoeuvre,
            "seconds": float(self.log.t[-1] - self.log.t[0]),
            "samples": len(self),
            "usable": float(self.usable.mean()),
            "learned_from": float(self.trainable.mean()),
        }

    def on_disk(self) -> PreparedLog:
        """Return the log with its arrays in a memory-mapped temporary file."""
        paged_arrays: dict[str, Any] = {
            field_.name: paged.copy_to_disk(getattr(self, field_.name))
            for field_ in fields(self)
            if field_.name not in ("log", "split", "dof")
        }
        return replace(self, log=self.log.move_to_disk(), **paged_arrays)


def prepare_log(
    log: Log,
    split: str,
    input_names: Sequence[str],
    config: PrepareConfig,
    dof: DegreesOfFreedom = SURGE_SWAY_YAW,
) -> PreparedLog:
    """Align, mask, smooth and differentiate one log.

    Spikes are interpolated and excluded (`Log.meta["spikes"]`).

    Args:
        log: canonical log with the channels x, y, psi and `input_names`; missing u, v, r are
            estimated by a smoother. A model with roll needs phi.
        split: train, validation, test or external.
        input_names: input channels in the order of w.
        config: settings of the preparation.
        dof: active velocities of the model; the others are zero.

    Raises:
        UsageError: if a channel is missing.
        DataError: if no sample is usable, or a value is outside the range of any vessel.
    """
    is_on_disk = paged.is_memory_mapped(log.t)
    # channels that the model does not use must not change the result
    channel_names = (*dof.state_names, *input_names)
    required_channels = set(channel_names)
    _require_plausible_values(log, channel_names)
    log = bridge_spikes(log, required_channels)
    completed_log = complete_motion(log, config.motion, dof)
    filled_log = fill_sparse(completed_log, channel_names, config.grid.held)
    # masks are applied to the samples as recorded: interpolation hides a frozen sensor
    recorded_log = (
        filled_log
        if completed_log is log
        else completed_log.replace(channels=completed_log.channels | log.channels)
    )
    masks = _apply_masks_of_model(recorded_log, input_names, config.masks, dof)
    log = align_to_grid(filled_log.replace(masks=masks), config.grid, required_channels)
    y = log.stack(dof.state_names)
    w = log.stack(tuple(input_names))
    segment = np.where(np.isfinite(y).all(1) & np.isfinite(w).all(1), number_log_segments(log), -1)
    usable = find_scored_samples(log) & (segment >= 0)
    if not usable.any():
        raise _unusable_log_error(log, channel_names)
    # a segment ends at each masked sample, so that no derivative depends on it; only interpolated
    # spikes are crossed, since a gap of one sample would change derivatives more than they do
    other_masks = {reason: mask for reason, mask in log.masks.items() if reason != SPIKE_REASON}
    is_clean = log.replace(masks=other_masks).usable & (segment >= 0)
    clean_segment = number_runs(np.where(is_clean, segment, -1))
    nu = y[:, dof.dynamic_columns]
    smoothed_nu, nu_dot, has_derivative = config.derivative.derive(
        nu, config.grid.step, clean_segment
    )
    held_inputs = _step_means(w, segment) if config.hold == "mean" else w
    regression_inputs = w
    if config.beside == "means":
        # the derivative of an integral by the same filter is the weighted mean over its window
        step_values = np.concatenate((0.5 * (nu[:-1] + nu[1:]), held_inputs[:-1]), axis=1)
        cumulative_steps = np.concatenate(
            (0.0 * step_values[:1], np.nan_to_num(step_values).cumsum(axis=0))
        )
        window_means = config.derivative.derive(
            config.grid.step * cumulative_steps, config.grid.step, clean_segment
        )[1]
        smoothed_nu = window_means[:, : dof.n_dynamic]
        regression_inputs = np.where(has_derivative[:, None], window_means[:, dof.n_dynamic :], w)
    elif "v_dot" in log.meta.get("smoothed", ()):
        # the reconstruction estimates sway with its derivative: differentiation would add the noise
        # of a second estimate, and a second filter would attenuate both
        sway = dof.state_names.index("v") - len(POSE_NAMES)
        has_derivative &= np.isfinite(log["v_dot"])
        smoothed_nu[:, sway] = nu[:, sway]
        nu_dot[:, sway] = np.where(has_derivative, log["v_dot"], np.nan)
    smoothed = np.concatenate(
        (y[:, POSE], np.where(has_derivative[:, None], smoothed_nu, nu)), axis=1
    )
    if dof.has_roll:
        # the derivative of an angle follows from the kinematics
        nu = smoothed[:, dof.dynamic_columns]
        # roll is rare: planar logs are prepared, and configs checked, without PyTorch
        import torch

        from residnet.core.columns import with_depth_rate

        kinematic_rates = nu @ dof.angle_rate_matrix().numpy()
        if dof.is_six_dof:
            kinematic_rates = with_depth_rate(
                torch.from_numpy(kinematic_rates), torch.from_numpy(nu)
            ).numpy()
        nu_dot = np.where(dof.equation_mask().numpy() > 0.0, nu_dot, kinematic_rates)
    is_inside_trim = (log.t >= log.t[0] + config.trim - 1e-9) & (
        log.t <= log.t[-1] - config.trim + 1e-9
    )
    trainable = usable & log.usable & has_derivative & is_inside_trim
    prepared = PreparedLog(
        log,
        split,
        y,
        smoothed,
        nu_dot,
        held_inputs,
        regression_inputs,
        segment,
        usable,
        trainable,
        dof,
    )
    return prepared.on_disk() if is_on_disk else prepared


def _require_plausible_values(log: Log, channel_names: Sequence[str]) -> None:
    """Refuse values that no vessel reaches.

    Raises:
        DataError: if there are such values; it names the first one.
    """
    for name in channel_names:
        if name not in log.channels:
            continue
        indices = np.flatnonzero(is_implausible(log[name], log.units[name]))
        if indices.size:
            raise DataError(
                f"log {log.name}: {name} is {log[name][indices[0]]:g} {log.units[name]} at t ="
                f" {log.t[indices[0]]:.2f} s, which no vessel reaches ({indices.size} such"
                " samples); correct them, or set them to NaN"
            )


def _apply_masks_of_model(
    log: Log, input_names: Sequence[str], rules: Sequence[MaskRule], dof: DegreesOfFreedom
) -> Mapping[str, np.ndarray]:
    """Return the masks of recorded samples by reason, from the channels that a model uses."""
    # inactive states are constant zero and must not be marked as a frozen sensor
    checked_channels = {*(dof.state_names if dof.is_complete else dof.active_states), *input_names}
    checked_channels |= {name for rule in rules for name in rule.model_dump().get("channels", ())}
    checked_values = {
        name: values for name, values in log.channels.items() if name in checked_channels
    }
    return apply_masks(log.replace(channels=checked_values), rules).masks


def _unusable_log_error(log: Log, channel_names: Sequence[str]) -> DataError:
    """Return the error that names the share of each mask in a log without usable samples."""
    reasons = [
        f"{reason.removeprefix(HARD_PREFIX)} {mask.mean():.0%}"
        for reason, mask in log.masks.items()
        if mask.any()
    ]
    reasons_text = ", ".join(reasons) or "NaN in a channel that the model needs"
    return DataError(
        f"log {log.name}: no sample is usable ({reasons_text}); check the masks and the channels"
        f" {', '.join(channel_names)}"
    )


def _step_means(w: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return the mean of each sample and the next [T, m]; the sample itself at a segment's end."""
    means = w.copy()
    is_followed = (segment[:-1] >= 0) & (segment[1:] == segment[:-1])
    means[:-1][is_followed] = 0.5 * (w[:-1] + w[1:])[is_followed]
    return means


def require_trainable(logs: Sequence[PreparedLog]) -> None:
    """Check that some log has a trainable sample.

    Raises:
        DataError: if none has.
    """
    if not any(log.trainable.any() for log in logs):
        raise DataError(
            f"none of {len(logs)} training logs has a trainable sample; check whether the logs are"
            " shorter than the window of the derivative"
        )


def find_sample_origins(logs: Sequence[PreparedLog]) -> SampleOrigins:
    """Return manoeuvre and time of the trainable samples of prepared logs.

    Raises:
        DataError: if no log has trainable samples.
    """
    require_trainable(logs)
    return SampleOrigins(
        np.concatenate(
            [np.full(int(log.trainable.sum()), index) for index, log in enumerate(logs)]
        ),
        np.concatenate([log.log.t[log.trainable] - log.log.t[0] for log in logs]),
        tuple(log.log.manoeuvre for log in logs),
    )


def compute_training_ranges(logs: Sequence[PreparedLog]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds of measured velocities and inputs, [n + m] each.

    Only usable samples count. The bounds of velocities exceed the 0.5 % and 99.5 % quantiles by at
    most the distance between these quantiles.
    """
    velocity_bounds = []
    # one column at a time, to limit the memory for large data
    for column in range(*logs[0].dof.dynamic_columns.indices(logs[0].y.shape[1])):
        values = np.concatenate([log.y[log.usable, column] for log in logs])
        lower = values.min()
        upper = values.max()
        # a few outliers must not widen the range in which a free run is valid
        low_quantile, high_quantile = np.quantile(
            values, (TAIL_SHARE, 1.0 - TAIL_SHARE), overwrite_input=True
        )
        velocity_bounds.append(
            (
                max(lower, low_quantile - (high_quantile - low_quantile)),
                min(upper, high_quantile + (high_quantile - low_quantile)),
            )
        )
    min_inputs = np.min([log.w[log.usable].min(0) for log in logs if log.usable.any()], axis=0)
    max_inputs = np.max([log.w[log.usable].max(0) for log in logs if log.usable.any()], axis=0)
    lower, upper = np.array(velocity_bounds).T
    return np.concatenate((lower, min_inputs)), np.concatenate((upper, max_inputs))
