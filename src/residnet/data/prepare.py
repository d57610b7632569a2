"""From logs to identification data: a uniform grid, masks, smoothed states and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field

from residnet.core.arrays import paged
from residnet.core.columns import sinking
from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import ALIVE, POSE, Live
from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.core.stretches import stretch_numbers
from residnet.data.align import GridConfig, align
from residnet.data.channels import beyond_belief, without_spikes
from residnet.data.derivatives import DerivativeConfig, SavitzkyGolay
from residnet.data.masks import HARD, MaskConfig, apply_masks, scored, segments
from residnet.data.motion import MotionConfig, complete_motion, fill_sparse
from residnet.physics.signals import Signals

# share of the samples at either end of a velocity's range that may be bad
_FEW = 0.005


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
        beside: what states and inputs stand beside a rate that is learned. `samples`: those of its
            sample, the states smoothed. `means`: their means over the samples that the rate is
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
class Prepared:
    """One log on the grid, with all that identification and evaluation need.

    Arrays are float64 with T samples.

    Attributes:
        log: the aligned log with its masks.
        split: train, validation, test or external.
        y: measured states [T, 3 + n], the pose and what moves (`Live.moving`).
        smooth: states with smoothed velocities [T, 3 + n].
        nu_dot: rates of what moves [T, n].
        w: inputs held over the step that follows each sample [T, m].
        recorded: inputs that go with the rates [T, m]: those at the samples, or means beside them.
        piece: number of the stretch that nothing crosses, [T]; -1 where there is none.
        usable: samples that may be scored [T].
        good: samples whose smoothed state and derivative may be learned from [T].
        live: which velocities the log tells; the others are zero.
    """

    log: Log
    split: str
    y: np.ndarray
    smooth: np.ndarray
    nu_dot: np.ndarray
    w: np.ndarray
    recorded: np.ndarray
    piece: np.ndarray
    usable: np.ndarray
    good: np.ndarray
    live: Live = ALIVE

    def __len__(self) -> int:
        return len(self.log)

    def described(self, split: str) -> dict[str, str | float | None]:
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
            "learned_from": float(self.good.mean()),
        }

    def on_disk(self) -> Prepared:
        """Return the same with its arrays in a temporary file, out of memory."""
        moved: dict[str, Any] = {
            part.name: paged.on_disk(getattr(self, part.name))
            for part in fields(self)
            if part.name not in ("log", "split", "live")
        }
        return replace(self, log=self.log.on_disk(), **moved)


def prepare(
    log: Log, split: str, columns: Sequence[str], config: PrepareConfig, live: Live = ALIVE
) -> Prepared:
    """Align, mask, smooth and differentiate one log.

    Single samples that no vessel follows are bridged and left out (`Log.meta["spikes"]`).

    Args:
        log: canonical log; needs the channels x, y, psi and `columns`; u, v, r come from a
            smoother where it lacks them. A roll needs phi.
        columns: input channels, in the order of w.
        live: velocities that the model moves (`SignalsConfig.live`); the others are zero.

    Raises:
        UsageError: where a channel is missing.
        DataError: where no sample remains, or a value is none that a vessel can have.
    """
    large = paged.lies_on_disk(log.t)
    # a channel that the model does not use changes nothing
    needed = {*live.states, *columns}
    for name in (*live.states, *columns):
        if name in log.channels:
            bad = np.flatnonzero(beyond_belief(log[name], log.units[name]))
            if bad.size:
                raise DataError(
                    f"log {log.name}: {name} is {log[name][bad[0]]:g} {log.units[name]} at t ="
                    f" {log.t[bad[0]]:.2f} s, which no vessel reaches ({bad.size} such samples);"
                    " correct them, or set them to NaN"
                )
    log = without_spikes(log, needed)
    moving = complete_motion(log, config.motion, live)
    filled = fill_sparse(moving, (*live.states, *columns), config.grid.held)
    # masks look at the samples as recorded: interpolation hides a frozen sensor
    sensors = filled if moving is log else moving.replace(channels=moving.channels | log.channels)
    # what is zero at all times, or follows from it, is no sensor that stands still
    asked = {*(live.states if live.whole else live.channels), *columns}
    asked |= {name for mask in config.masks for name in mask.model_dump().get("channels", ())}
    sensed = {name: cells for name, cells in sensors.channels.items() if name in asked}
    masks = apply_masks(sensors.replace(channels=sensed), config.masks).masks
    log = align(filled.replace(masks=masks), config.grid, needed)
    y, w = log.stack(live.states), log.stack(tuple(columns))
    piece = np.where(np.isfinite(y).all(1) & np.isfinite(w).all(1), segments(log), -1)
    usable = scored(log) & (piece >= 0)
    if not usable.any():
        reasons = (
            ", ".join(
                f"{reason.removeprefix(HARD)} {mask.mean():.0%}"
                for reason, mask in log.masks.items()
                if mask.any()
            )
            or "NaN in a channel that the model needs"
        )
        raise DataError(
            f"log {log.name}: no sample is usable ({reasons}); check the masks and the channels"
            f" {', '.join((*live.states, *columns))}"
        )
    # derivatives must not see masked samples, so a piece ends at each of them
    clean = stretch_numbers(np.where(log.usable & usable, piece, -1))
    nu = y[:, live.columns]
    smooth_nu, nu_dot, valid = config.derivative.derive(nu, config.grid.step, clean)
    held = _means(w, piece) if config.hold == "mean" else w
    recorded = w
    if config.beside == "means":
        # the rate of an integral, by the same rule, is the mean that the rule takes
        steps = np.concatenate((0.5 * (nu[:-1] + nu[1:]), held[:-1]), axis=1)
        whole = np.concatenate((0.0 * steps[:1], np.nan_to_num(steps).cumsum(axis=0)))
        means = config.derivative.derive(config.grid.step * whole, config.grid.step, clean)[1]
        smooth_nu, recorded = (
            means[:, : live.size],
            np.where(valid[:, None], means[:, live.size :], w),
        )
    smooth = np.concatenate((y[:, POSE], np.where(valid[:, None], smooth_nu, nu)), axis=1)
    if live.rolls:
        # the rate of an angle is what its velocity says
        nu = smooth[:, live.columns]
        known = nu @ live.known_rates().numpy()
        if live.spatial:
            known = sinking(torch.from_numpy(known), torch.from_numpy(nu)).numpy()
        nu_dot = np.where(live.mask().numpy() > 0.0, nu_dot, known)
    trimmed = (log.t >= log.t[0] + config.trim - 1e-9) & (log.t <= log.t[-1] - config.trim + 1e-9)
    good = usable & valid & trimmed
    prepared = Prepared(log, split, y, smooth, nu_dot, held, recorded, piece, usable, good, live)
    return prepared.on_disk() if large else prepared


def _means(w: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Return the mean of each sample and the next [T, m]; the sample itself at a piece's end."""
    out = w.copy()
    on = (piece[:-1] >= 0) & (piece[1:] == piece[:-1])
    out[:-1][on] = 0.5 * (w[:-1] + w[1:])[on]
    return out


def channels(log: Prepared, signals: Signals, rows: np.ndarray | None = None) -> torch.Tensor:
    """Return what a model sees at the samples of a log, z [T, nz].

    States are the smoothed ones, inputs those at the samples: a rate at an instant belongs to the
    inputs of that instant, while a rollout is given what is held over each step (`Prepared.w`).
    Everything that sets a model against measured accelerations takes this.

    Args:
        log: prepared log.
        signals: of the model, float64.
        rows: samples that are wanted [T] bool; None for all, where gaps are filled with 0.
    """
    x, w = log.smooth, log.recorded
    x, w = (np.nan_to_num(x), np.nan_to_num(w)) if rows is None else (x[rows], w[rows])
    with torch.no_grad():
        z: torch.Tensor = signals(torch.from_numpy(x), signals.prepare(torch.from_numpy(w)))
    return z


def samples(logs: Sequence[Prepared], signals: Signals) -> Samples:
    """Return the samples of identification from prepared logs, float64.

    They hold smoothed channels and measured accelerations.
    """
    if not any(p.good.any() for p in logs):
        raise DataError(
            f"none of {len(logs)} training logs has a sample to learn from; are the logs shorter"
            " than the derivative's window?"
        )
    counts = [int(p.good.sum()) for p in logs]
    total = sum(counts)
    live = logs[0].live
    z, target, time = (
        paged.rows(total, *width) for width in ((len(signals.names),), (live.size,), ())
    )
    group = paged.rows(total, dtype=torch.int64)
    begin = 0
    for number, (p, count) in enumerate(zip(logs, counts, strict=True)):
        rows = slice(begin, begin + count)
        z[rows] = channels(p, signals, p.good)
        target[rows] = torch.from_numpy(p.nu_dot[p.good])
        if live.rolls:
            # what is known of an angle's rate is nothing to learn
            target[rows] *= live.mask()
        group[rows] = number
        time[rows] = torch.from_numpy(p.log.t[p.good] - p.log.t[0])
        begin += count
        paged.forget()
    kinds = tuple(p.log.manoeuvre for p in logs)
    return Samples(z, target, group, time, kinds, signals.names)


def envelope(logs: Sequence[Prepared]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest measured velocities and inputs, [n + m] each.

    Only usable samples count, and velocities no further beyond the quantiles of 0.5 % and 99.5 %
    than these lie apart.
    """
    bounds = []
    # one column at a time: of large data all of them would fill the memory
    for column in range(*logs[0].live.columns.indices(logs[0].y.shape[1])):
        values = np.concatenate([p.y[p.usable, column] for p in logs])
        low, high = values.min(), values.max()
        # a few bad samples must not widen the range in which a free run counts as sound
        few, most = np.quantile(values, (_FEW, 1.0 - _FEW), overwrite_input=True)
        bounds.append((max(low, few - (most - few)), min(high, most + (most - few))))
    least = np.min([p.w[p.usable].min(0) for p in logs if p.usable.any()], axis=0)
    largest = np.max([p.w[p.usable].max(0) for p in logs if p.usable.any()], axis=0)
    low, high = np.array(bounds).T
    return np.concatenate((low, least)), np.concatenate((high, largest))
