"""Samples of a fit from prepared logs: channels of a model and measured accelerations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from residnet.core.arrays import paged
from residnet.core.samples import Samples
from residnet.physics.signals import Signals
from residnet.preprocessing.prepare import PreparedLog, require_trainable


def compute_channels(
    log: PreparedLog, signals: Signals, is_selected: np.ndarray | None = None
) -> torch.Tensor:
    """Compute the channels z [T, nz] of a model at the samples of a log.

    States are smoothed, and inputs are paired with the derivatives (`regression_inputs`): the
    derivative at an instant depends on the inputs at that instant, whereas a rollout uses the
    inputs over each step (`PreparedLog.w`). Comparisons with measured accelerations use these
    channels.

    Args:
        log: prepared log.
        signals: signals of the model, float64.
        is_selected: selected samples [T] bool; None for all, with 0 in gaps.
    """
    states = log.smoothed
    inputs = log.regression_inputs
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
    """Collect the trainable samples of prepared logs, float64.

    The samples contain smoothed channels and measured accelerations.

    Raises:
        DataError: if no log has trainable samples.
    """
    require_trainable(logs)
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
            # the rate of an angle follows from the kinematics and is not learned
            target[row_slice] *= dof.equation_mask()
        group[row_slice] = log_index
        time[row_slice] = torch.from_numpy(log.log.t[log.trainable] - log.log.t[0])
        row_start += n_rows
        paged.release_pages()
    manoeuvre_kinds = tuple(log.log.manoeuvre for log in logs)
    return Samples(channel_values, target, group, time, manoeuvre_kinds, signals.names)
