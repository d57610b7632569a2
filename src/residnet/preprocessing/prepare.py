"""From logs to identification data: a uniform grid, masks, smoothed states and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field

from residnet.core.arrays import paged
from residnet.core.columns import with_depth_rate
from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import POSE, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.core.stretches import number_runs
from residnet.physics.signals import Signals
from residnet.preprocessing.align import GridConfig, align_to_grid
from residnet.preprocessing.channel_values import bridge_spikes, is_implausible
from residnet.preprocessing.derivatives import DerivativeConfig, SavitzkyGolay
from residnet.preprocessing.masks import (
    HARD_PREFIX,
    MaskConfig,
    apply_masks,
    find_scored_samples,
    number_log_segments,
)
from residnet.preprocessing.motion import MotionConfig, complete_motion, fill_sparse

# share of the samples at either end of a velocity's range that may be bad
_TAIL_SHARE = 0.005


class PrepareConfig(Config):
    """How logs become samples.

    Attributes:
        grid: the uniform time grid; its step is the model's dt.
        masks: which samples are excluded, and why.
        derivative: how velocities are smoothed and differentiated.
        motion: how the motion is told where a log holds position and heading only, or some of
            the motion at some samples only.
        trim: seconds cut from the start and the end of every log before samples are taken for
            identification.
        hold: what a model is given as an input over the step that follows a sample. `start`: the
            sample itself, exact for a command that changes on the grid. `mean`: the mean of the
            samples at both ends of the step, for a measured quantity that moves on during the step,
            such as shaft revolutions; held from the start it would lag by half a step.
        beside: what states and inputs stand beside a rate that is learned. `make_samples`: those of its
            sample, the states smoothed. `window_means`: their means over the samples that the rate is
            taken from, weighed as it weighs these. A smoothed rate is such a mean of rates; beside
            means it lags no step of an input, and a swing as short as the smoothing is no softer
            in it than in them.
        dead_commands: what is done with stretches in which all inputs rest while the vessel moves
            as a model of the other logs does not explain: somebody took over by hand, or the record
            stopped. `mask` splits the log there, `keep` takes them as they are.
    """

    grid: GridConfig
    masks: tuple[MaskConfig, ...] = ()
    derivative: DerivativeConfig = Field(default_factory=SavitzkyGolay)
    motion: MotionConfig = MotionConfig()
    trim: Seconds = Field(default=0.0, ge=0)
    hold: Literal["start", "mean"] = "start"
    beside: Literal["samples", "means"] = "samples"
    dead_commands: Literal["mask", "keep"] = "mask"


@dataclass(frozen=True)
class PreparedLog:
    """One log on the grid, with all that identification and evaluation need.

    Arrays are float64 with T samples.

    Attributes:
        log: the aligned log with its masks.
        split: train, validation, test or external.
        y: measured states [T, 3 + n], the pose and what moves (`Live.moving`).
        smoothed: states with smoothed velocities [T, 3 + n].
        nu_dot: rates of what moves [T, n].
        w: inputs held over the step that follows each sample [T, m].
        rate_inputs: inputs that go with the rates [T, m]: those at the samples, or means beside them.
        segment: number of the stretch that nothing crosses, [T]; -1 where there is none.
        usable: samples that may be scored [T].
        trainable: samples whose smoothed state and derivative may be learned from [T].
        dof: which velocities the log tells; the others are zero.
    """

    log: Log
    split: str
    y: np.ndarray
    smoothed: np.ndarray
    nu_dot: np.ndarray
    w: np.ndarray
    rate_inputs: np.ndarray
    segment: np.ndarray
    usable: np.ndarray
    trainable: np.ndarray
    dof: DegreesOfFreedom = SURGE_SWAY_YAW

    def __len__(self) -> int:
        return len(self.log)

    def to_table_row(self, split: str) -> dict[str, str | float | None]:
        """Return a row of a table: what the log is, and which shares are usable and learned from.

        Args:
            split: that it stands under in the table.
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
        """Return the same with its arrays in a temporary file, out of memory."""
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

    Single samples that no vessel follows are bridged and left out (`Log.meta["spikes"]`).

    Args:
        log: canonical log; needs the channels x, y, psi and `input_names`; u, v, r come from a
            smoother where it lacks them. A roll needs phi.
        input_names: input channels, in the order of w.
        dof: velocities that the model moves (`SignalsConfig.live`); the others are zero.

    Raises:
        UsageError: where a channel is missing.
        DataError: where no sample remains, or a value is none that a vessel can have.
    """
    is_on_disk = paged.is_memory_mapped(log.t)
    # a channel that the model does not use changes nothing
    required_channels = {*dof.state_names, *input_names}
    for name in (*dof.state_names, *input_names):
        if name in log.channels:
            implausible_indices = np.flatnonzero(is_implausible(log[name], log.units[name]))
            if implausible_indices.size:
                raise DataError(
                    f"log {log.name}: {name} is {log[name][implausible_indices[0]]:g} {log.units[name]} at t ="
                    f" {log.t[implausible_indices[0]]:.2f} s, which no vessel reaches ({implausible_indices.size} such samples);"
                    " correct them, or set them to NaN"
                )
    log = bridge_spikes(log, required_channels)
    completed_log = complete_motion(log, config.motion, dof)
    filled_log = fill_sparse(completed_log, (*dof.state_names, *input_names), config.grid.held)
    # masks look at the samples as recorded: interpolation hides a frozen sensor
    recorded_channels = (
        filled_log
        if completed_log is log
        else completed_log.replace(channels=completed_log.channels | log.channels)
    )
    # what is zero at all times, or follows from it, is no sensor that stands still
    checked_channels = {*(dof.state_names if dof.is_complete else dof.active_states), *input_names}
    checked_channels |= {
        name for mask in config.masks for name in mask.model_dump().get("channels", ())
    }
    checked_values = {
        name: values
        for name, values in recorded_channels.channels.items()
        if name in checked_channels
    }
    masks = apply_masks(recorded_channels.replace(channels=checked_values), config.masks).masks
    log = align_to_grid(filled_log.replace(masks=masks), config.grid, required_channels)
    y, w = log.stack(dof.state_names), log.stack(tuple(input_names))
    segment = np.where(np.isfinite(y).all(1) & np.isfinite(w).all(1), number_log_segments(log), -1)
    usable = find_scored_samples(log) & (segment >= 0)
    if not usable.any():
        reasons_text = (
            ", ".join(
                f"{reason.removeprefix(HARD_PREFIX)} {mask.mean():.0%}"
                for reason, mask in log.masks.items()
                if mask.any()
            )
            or "NaN in a channel that the model needs"
        )
        raise DataError(
            f"log {log.name}: no sample is usable ({reasons_text}); check the masks and the channels"
            f" {', '.join((*dof.state_names, *input_names))}"
        )
    # derivatives must not see masked samples, so a piece ends at each of them
    clean_segment = number_runs(np.where(log.usable & usable, segment, -1))
    nu = y[:, dof.dynamic_columns]
    smoothed_nu, nu_dot, has_derivative = config.derivative.derive(
        nu, config.grid.step, clean_segment
    )
    held_inputs = _step_means(w, segment) if config.hold == "mean" else w
    rate_inputs = w
    if config.beside == "means":
        # the rate of an integral, by the same rule, is the mean that the rule takes
        step_values = np.concatenate((0.5 * (nu[:-1] + nu[1:]), held_inputs[:-1]), axis=1)
        cumulative_steps = np.concatenate(
            (0.0 * step_values[:1], np.nan_to_num(step_values).cumsum(axis=0))
        )
        window_means = config.derivative.derive(
            config.grid.step * cumulative_steps, config.grid.step, clean_segment
        )[1]
        smoothed_nu, rate_inputs = (
            window_means[:, : dof.n_dynamic],
            np.where(has_derivative[:, None], window_means[:, dof.n_dynamic :], w),
        )
    smoothed = np.concatenate(
        (y[:, POSE], np.where(has_derivative[:, None], smoothed_nu, nu)), axis=1
    )
    if dof.has_roll:
        # the rate of an angle is what its velocity says
        nu = smoothed[:, dof.dynamic_columns]
        kinematic_rates = nu @ dof.angle_rate_matrix().numpy()
        if dof.is_six_dof:
            kinematic_rates = with_depth_rate(
                torch.from_numpy(kinematic_rates), torch.from_numpy(nu)
            ).numpy()
        nu_dot = np.where(dof.equation_mask().numpy() > 0.0, nu_dot, kinematic_rates)
    is_inside_trim = (log.t >= log.t[0] + config.trim - 1e-9) & (
        log.t <= log.t[-1] - config.trim + 1e-9
    )
    trainable = usable & has_derivative & is_inside_trim
    prepared = PreparedLog(
        log, split, y, smoothed, nu_dot, held_inputs, rate_inputs, segment, usable, trainable, dof
    )
    return prepared.on_disk() if is_on_disk else prepared


def _step_means(w: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return the mean of each sample and the next [T, m]; the sample itself at a piece's end."""
    means = w.copy()
    is_followed = (segment[:-1] >= 0) & (segment[1:] == segment[:-1])
    means[:-1][is_followed] = 0.5 * (w[:-1] + w[1:])[is_followed]
    return means


def compute_channels(
    log: PreparedLog, signals: Signals, is_selected: np.ndarray | None = None
) -> torch.Tensor:
    """Return what a model sees at the samples of a log, z [T, nz].

    States are the smoothed ones, inputs those at the samples: a rate at an instant belongs to the
    inputs of that instant, while a rollout is given what is held over each step (`Prepared.w`).
    Everything that sets a model against measured accelerations takes this.

    Args:
        log: prepared log.
        signals: of the model, float64.
        is_selected: samples that are wanted [T] bool; None for all, where gaps are filled with 0.
    """
    states, inputs = log.smoothed, log.rate_inputs
    states, inputs = (
        (np.nan_to_num(states), np.nan_to_num(inputs))
        if is_selected is None
        else (states[is_selected], inputs[is_selected])
    )
    with torch.no_grad():
        channel_values: torch.Tensor = signals(
            torch.from_numpy(states), signals.prepare(torch.from_numpy(inputs))
        )
    return channel_values


def make_samples(logs: Sequence[PreparedLog], signals: Signals) -> Samples:
    """Return the samples of identification from prepared logs, float64.

    They hold smoothed channels and measured accelerations.
    """
    if not any(log.trainable.any() for log in logs):
        raise DataError(
            f"none of {len(logs)} training logs has a sample to learn from; are the logs shorter"
            " than the derivative's window?"
        )
    n_trainable = [int(log.trainable.sum()) for log in logs]
    n_samples = sum(n_trainable)
    dof = logs[0].dof
    channel_values, target, time = (
        paged.allocate_rows(n_samples, *shape)
        for shape in ((len(signals.names),), (dof.n_dynamic,), ())
    )
    group = paged.allocate_rows(n_samples, dtype=torch.int64)
    row_start = 0
    for log_index, (log, n_rows) in enumerate(zip(logs, n_trainable, strict=True)):
        row_slice = slice(row_start, row_start + n_rows)
        channel_values[row_slice] = compute_channels(log, signals, log.trainable)
        target[row_slice] = torch.from_numpy(log.nu_dot[log.trainable])
        if dof.has_roll:
            # what is known of an angle's rate is nothing to learn
            target[row_slice] *= dof.equation_mask()
        group[row_slice] = log_index
        time[row_slice] = torch.from_numpy(log.log.t[log.trainable] - log.log.t[0])
        row_start += n_rows
        paged.release_pages()
    manoeuvre_kinds = tuple(log.log.manoeuvre for log in logs)
    return Samples(channel_values, target, group, time, manoeuvre_kinds, signals.names)


def compute_training_ranges(logs: Sequence[PreparedLog]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest measured velocities and inputs, [n + m] each.

    Only usable samples count, and velocities no further beyond the quantiles of 0.5 % and 99.5 %
    than these lie apart.
    """
    velocity_bounds = []
    # one column at a time: of large data all of them would fill the memory
    for column in range(*logs[0].dof.dynamic_columns.indices(logs[0].y.shape[1])):
        values = np.concatenate([log.y[log.usable, column] for log in logs])
        lower, upper = values.min(), values.max()
        # a few bad samples must not widen the range in which a free run counts as sound
        low_quantile, high_quantile = np.quantile(
            values, (_TAIL_SHARE, 1.0 - _TAIL_SHARE), overwrite_input=True
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
