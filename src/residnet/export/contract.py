"""What holds for a stepped model in every format, checked before a file is written.

A format's file is loaded back and driven beside the model itself: 2,000 steps from a warmed-up
memory, then inputs, states and memories that no vessel has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.core.layout import RANGE_INPUTS, SURGE, motion
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.scripted import scripted
from residnet.dynamics.store import ModelSpec
from residnet.export.guard import GuardedDynamics

PARITY_STEPS = 2000
PAST = 50
"""Steps of measured past that warm the memory up."""
SINGLE, DOUBLE = 1e-5, 1e-12
"""Largest difference in each precision, as a share of a channel's range."""
Numbers = npt.NDArray[np.floating[Any]]


Rows = Callable[[Numbers, Numbers, Numbers], tuple[Numbers, Numbers, Any]]
"""States [B, 6], inputs [B, m] and memories [B, n_state] to those one step later, and flags [B]."""
_TRACKS, _HELD = 16, 20
"""Tracks whose inputs jump, and steps between the jumps: eight may all miss what grows."""


class Apart(ExportError):
    """A file that rounds otherwise than the model, and ends elsewhere for that alone."""


class Stepped(Protocol):
    """A file that was written, loaded back: one vessel, arrays without a batch."""

    def step(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, bool]:
        """Return state [6], memory [n_state] and flag one step later; inputs w [m]."""

    def warmup(self, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory [n_state] that states [T, 6] and inputs [T, m] leave."""


def require_numbers(spec: ModelSpec, model: HybridDynamics) -> None:
    """Refuse a model whose numbers are not all finite.

    Raises:
        ExportError: that names the first such number.
    """
    # limits of what has no limits are infinite from the start
    fresh = spec.build().state_dict()
    for name, value in model.state_dict().items():
        wrong = ~torch.isfinite(value)
        if name in fresh and fresh[name].shape == value.shape:
            wrong &= ~(torch.isinf(value) & (fresh[name].to(value.dtype) == value))
        if bool(wrong.any()):
            raise ExportError(
                f"model {spec.name}: {name} holds {float(value[wrong][0])}, so it is no model;"
                " fit it again"
            )


def checked(
    spec: ModelSpec,
    model: HybridDynamics,
    stepped: Stepped,
    what: str,
    dtype: torch.dtype = torch.float32,
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Return what a card says of the parity, once a file answers good and bad inputs as it must.

    Raises:
        ExportError: where it does not; see `require_parity` and `require_defined`.
    """
    shares = require_parity(spec, model, stepped, what, dtype, tolerance)
    if dtype == torch.float32:
        require_tracks(spec, model, _one_by_one(stepped), what, dtype, SINGLE)
    require_defined(spec, model, stepped, what, dtype)
    return {"steps": PARITY_STEPS, "share_of_range": shares}


def drive(spec: ModelSpec, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return states of the past [1, 50, 6] and inputs [1, 50 + steps, m] of the parity check.

    Inputs sweep the training range as slow sines, so that the run passes through what the model
    knows.
    """
    low, high = torch.tensor(spec.low, dtype=dtype), torch.tensor(spec.high, dtype=dtype)
    steps = torch.arange(PARITY_STEPS + PAST, dtype=dtype)
    phase = torch.arange(low.numel() - 3, dtype=dtype)
    sweep = 0.5 + 0.4 * torch.sin(0.02 * (1 + 0.37 * phase)[None] * steps[:, None] + phase[None])
    w = (low[RANGE_INPUTS] + sweep * (high - low)[RANGE_INPUTS]).unsqueeze(0)
    y = torch.zeros(1, PAST, len(STATE), dtype=dtype)
    y[:, :, SURGE] = 0.5 * (low[0] + high[0])
    return y, w


def require_sound(spec: ModelSpec, model: HybridDynamics, states: Tensor) -> None:
    """Refuse a model that diverges in a free run whose inputs stay within the training range.

    Raises:
        ExportError: that names the first step and channel beyond what exports accept.
    """
    guard = GuardedDynamics(model, spec)
    least, most = motion(guard.least), motion(guard.most)
    wrong = ~((states[0] >= least) & (states[0] <= most))
    if not bool(wrong.any()):
        return
    k = int(wrong.any(dim=1).to(torch.int).argmax())
    i = int(wrong[k].to(torch.int).argmax())
    raise ExportError(
        f"model {spec.name}: diverges in the export's free run, though its inputs stay within the"
        f" training range: {STATE[i]} is {float(states[0, k, i]):.3g} after {k * spec.dt:g} s,"
        f" accepted {float(least[i]):.3g} to {float(most[i]):.3g}; not exported, choose another"
        " model"
    )


def require_parity(
    spec: ModelSpec,
    model: HybridDynamics,
    stepped: Stepped,
    what: str,
    dtype: torch.dtype = torch.float32,
    tolerance: float | None = None,
) -> dict[str, float]:
    """Return the largest difference of each state from the model's, as a share of its range.

    Args:
        spec: the model's description.
        model: in the precision of `stepped`.
        stepped: what was written.
        what: was written, for messages.
        dtype: precision of both, float32 or float64.
        tolerance: largest share; None for that of the precision.

    Raises:
        Apart: where a share is larger than allowed.
        ExportError: where the model itself leaves what exports accept.
    """
    if not model.head.warms_by_steps():
        raise ExportError(
            f"{what}: an encoder of its own starts the memory of {spec.name}, which this format has"
            " no place for; export it as torchscript, or export a model without an encoder"
        )
    if tolerance is None:
        tolerance = DOUBLE if dtype == torch.float64 else SINGLE
    y, w = drive(spec, dtype)
    with torch.no_grad():
        eager = Rollout(model)(y[:, -1], w[:, PAST:], model.warmup(y, w[:, :PAST]))[0]
    require_sound(spec, model, eager)
    x, s = y[0, -1].numpy().copy(), stepped.warmup(y[0].numpy(), w[0, :PAST].numpy())
    path = [x]
    for k in range(PARITY_STEPS):
        x, s, _ = stepped.step(x, w[0, PAST + k].numpy(), s)
        path.append(x)
    states = eager[0].numpy()
    span = np.maximum(np.ptp(states, axis=0), 1e-6)
    worst = np.abs(np.stack(path) - states).max(axis=0) / span
    shares = dict(zip(STATE, worst.tolist(), strict=True))
    if not bool((worst <= tolerance).all()):
        raise Apart(
            f"model {spec.name}: {what} differs from the model by {shares} of each channel's range"
            f" over {PARITY_STEPS} steps; allowed {tolerance:g}"
        )
    return shares


def _one_by_one(stepped: Stepped) -> Rows:
    """Return a step of many rows that takes them one after the other."""

    def rows(x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, Any]:
        found = [stepped.step(*row) for row in zip(x, w, s, strict=True)]
        after, memory, outside = zip(*found, strict=True)
        return np.stack(after), np.stack(memory), outside

    return rows


def require_tracks(
    spec: ModelSpec,
    model: HybridDynamics,
    rows: Rows,
    what: str,
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """Refuse a precision whose rounding grows, on tracks whose inputs jump within the range.

    A format adds up in another order than torch. Where a model hardly damps, what that rounds
    otherwise differs much from track to track, so there are several, each from a state of its own.

    Args:
        spec: the model's description.
        model: in the precision of the format.
        rows: the format's step of many rows.
        what: was written, for messages.
        dtype: precision of both, float32 or float64.
        tolerance: largest difference as a share of a state's range.

    Raises:
        Apart: where a state of a track differs by more.
    """
    generator = torch.Generator().manual_seed(1)
    guard = GuardedDynamics(model, spec).to(dtype).eval()
    low, high = (torch.tensor(bound, dtype=dtype) for bound in (spec.low, spec.high))
    places = (_TRACKS, PARITY_STEPS // _HELD + 1, low.numel())
    seen = low + torch.rand(places, generator=generator).to(dtype) * (high - low)
    w = seen[:, :, 3:].repeat_interleave(_HELD, dim=1)[:, :PARITY_STEPS]
    # the last column is the guard's flag
    x0 = torch.cat((torch.zeros(_TRACKS, 3), seen[:, 0, :3], torch.zeros(_TRACKS, 1)), dim=1)
    x0, s0 = x0.to(dtype), model.initial_state(_TRACKS).to(dtype)
    with torch.no_grad():
        wanted = scripted(Rollout(guard), PARITY_STEPS)(x0, w, s0)[0][..., : len(STATE)].numpy()
    x, s = x0[:, : len(STATE)].numpy(), s0.numpy()
    path = [x]
    for k in range(PARITY_STEPS):
        x, s, _ = rows(x, w[:, k].numpy(), s)
        path.append(x)
    span = np.maximum(np.ptp(wanted, axis=1), 1e-6)
    worst = float((np.abs(np.stack(path, axis=1) - wanted).max(axis=1) / span).max())
    if not worst <= tolerance:
        raise Apart(
            f"model {spec.name}: {what} differs from the model by {worst:.2g} of a state's range"
            f" over {PARITY_STEPS} steps; allowed {tolerance:g}"
        )


def require_defined(
    spec: ModelSpec,
    model: HybridDynamics,
    stepped: Stepped,
    what: str,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Refuse what answers bad inputs, states or memories otherwise than the model's guard.

    Raises:
        ExportError: that names the first entry and its value.
    """
    guarded = GuardedDynamics(model, spec).to(dtype).eval()
    y, w = (part[0] for part in drive(spec, dtype))
    memory = guarded.warmup(y.unsqueeze(0), w[:PAST].unsqueeze(0))[0]
    good = torch.cat((y[-1], w[PAST], memory))
    names = [*STATE, *spec.signals.columns, *(f"memory {i}" for i in range(memory.numel()))]
    # a long memory is wrong in its first, its middle and its last entry
    ends = {len(STATE) + w.shape[1], len(names) // 2, len(names) - 1}
    places = [i for i in range(len(names)) if i < len(STATE) + w.shape[1] or i in ends]
    cases = [(i, bad) for i in places for bad in (torch.nan, torch.inf, -torch.inf, 1e30, -1e30)]
    rows = good.repeat(len(cases), 1)
    for row, (i, bad) in zip(rows, cases, strict=True):
        row[i] = bad
    parts = [len(STATE), w.shape[1], memory.numel()]
    x0, w0, s0 = rows.split(parts, dim=1)
    with torch.no_grad():
        wanted = guarded.flagged_step(x0, w0, s0)
    for k, (i, bad) in enumerate(cases):
        x, s, outside = stepped.step(x0[k].numpy(), w0[k].numpy(), s0[k].numpy())
        same = (
            np.allclose(x, wanted[0][k].numpy(), rtol=1e-4, atol=1e-4)
            and np.allclose(s, wanted[1][k].numpy(), rtol=1e-3, atol=1e-3)
            and bool(outside) == bool(wanted[2][k])
        )
        if not same:
            raise ExportError(
                f"model {spec.name}: {what} answers {names[i]} = {bad} with {x.tolist()}, outside"
                f" {bool(outside)}; the model with {wanted[0][k].tolist()}, {bool(wanted[2][k])}"
            )


def warmed(
    measured: Callable[[Numbers, Numbers], bool],
    step: Callable[[Numbers, Numbers, Numbers], tuple[Numbers, Numbers, bool]],
    y: Numbers,
    w: Numbers,
    empty: Numbers,
) -> Numbers:
    """Return the memory that steps along a measured past leave, where a format has only steps.

    In the place of a sample that is no measurement stands the last one before it that is, or else
    the first one behind it.
    """
    good = [k for k in range(len(y)) if measured(y[k], w[k])]
    s, at = empty, good[0] if good else 0
    for k in range(len(y) if good else 0):
        at = k if k in good else at
        s = step(y[at], w[at], s)[1]
    return s


def accepted(spec: ModelSpec, model: HybridDynamics) -> Callable[[Numbers, Numbers], bool]:
    """Return what tells whether state and inputs of one sample are measurements."""
    guard = GuardedDynamics(model, spec)
    least, most = guard.least.numpy(), guard.most.numpy()

    def measured(x: Numbers, w: Numbers) -> bool:
        seen = np.concatenate((x, w))
        return bool(((seen >= least) & (seen <= most)).all())

    return measured
