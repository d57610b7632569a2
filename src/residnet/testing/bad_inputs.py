"""The contract of exported models under bad inputs, states and memories."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from residnet.core.layout import PLANAR
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.guard import GuardedDynamics
from residnet.testing.checks import require, require_equal, require_finite

_PAST, _STEPS = 6, 8
_BAD_STEP = 3
"""Step of bad values: good ones come before it and after it."""
_FAR = (1e38, -1e38, 1e20, -1e20, 1e9, -1e9, 1e5)
_WRONG = (float("nan"), float("inf"), float("-inf"), *_FAR)
"""Values that stand in the place of an entry; times of the range's edge are drawn as well."""


def check_bad_inputs(
    exported: Any, spec: ModelSpec, model: HybridDynamics, *, cases: int = 200, seed: int = 0
) -> None:
    """Check that an exported model gives a flag and finite numbers, whatever it is given.

    Each case is a short free run in which entries of a state, of inputs or of a memory are replaced
    at one step by what is no number, infinite or far off. All that comes out is finite; what is
    beyond the training range is flagged, and nothing else; what is not flagged is the model's own
    answer; good samples after the bad one are answered as if it had not been.

    Args:
        exported: anything with `initial_state`, `warmup`, `step` and `rollout` that takes and gives
            tensors, as `residnet.export.base` says.
        spec: of the model that was exported.
        model: that model; its precision is changed to float32.
        cases: number of free runs.
        seed: of the cases.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"exported {spec.name}"
    guard = GuardedDynamics(model.float().eval(), spec)
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        x, w, past, given = _good_samples(guard, cases, random)
        s = exported.warmup(past, given)
        require_equal(s, model.warmup(past, given), 1e-4, f"{who}: warms up otherwise")
        _check_steps(exported, guard, x, w, s, random, who)
        _check_rollout(exported, x, w, s, random, who)
        _check_histories(exported, past, given, random, who)


def _good_samples(
    guard: GuardedDynamics, rows: int, random: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return states [B, 3 + n] and inputs [B, T, m] in the training range, and a past of both."""
    first, n = PLANAR.pose_columns.stop, guard.dof
    low, high = guard.low[first:], guard.high[first:]
    share = 0.05 + 0.9 * torch.rand(rows, _PAST + _STEPS, low.numel(), generator=random)
    seen = low + share * (high - low)
    pose = 40.0 * torch.rand(rows, _PAST + _STEPS, 3, generator=random) - 20.0
    y, w = torch.cat((pose, seen[..., :n]), dim=-1), seen[..., n:]
    return y[:, _PAST], w[:, _PAST:], y[:, :_PAST], w[:, :_PAST]


def _damage(values: Tensor, edge: Tensor, share: float, random: torch.Generator) -> Tensor:
    """Return values [B, k] with a share of the entries replaced, some just beyond the edge [k]."""
    wrong = torch.tensor(_WRONG)[torch.randint(len(_WRONG), values.shape, generator=random)]
    times = 10.0 ** (6.0 * torch.rand(values.shape, generator=random) - 2.0)
    beyond = (edge + edge.abs().clamp(min=1e-3) * times).expand_as(values)
    kind = torch.rand(values.shape, generator=random)
    chosen = torch.rand(values.shape, generator=random) < share
    return torch.where(chosen, torch.where(kind < 0.7, wrong, beyond), values)


def _check_steps(
    exported: Any,
    guard: GuardedDynamics,
    x: Tensor,
    w: Tensor,
    s: Tensor,
    random: torch.Generator,
    who: str,
) -> None:
    """Step freely with one bad sample, then on with good ones."""
    columns = x.shape[1]
    for k in range(w.shape[1]):
        before, inputs, memory = x, w[:, k], s
        if k == _BAD_STEP:
            where = torch.rand(3, len(x), 1, generator=random) < 0.5
            before = torch.where(where[0], _damage(x, guard.high[:columns], 0.4, random), x)
            edge = guard.high[columns:]
            inputs = torch.where(where[1], _damage(inputs, edge, 0.5, random), inputs)
            edge = guard.memory_high
            memory = torch.where(where[2], _damage(s, edge, 1.0 / (1 + s.shape[1]), random), s)
        x, s, outside = exported.step(before, inputs, memory)
        _check_answer(guard, (before, inputs, memory), (x, s, outside), f"{who}, step {k}")
        if k == _BAD_STEP:
            # what the controller measures next is good again, and so is what it remembers
            middle = 0.5 * (guard.low + guard.high).expand(len(x), -1)
            measured, inputs = middle[:, :columns], middle[:, columns:]
            for kept in (s, exported.initial_state(len(x))):
                answer = exported.step(measured, inputs, kept)
                _check_answer(guard, (measured, inputs, kept), answer, f"{who}, after a bad sample")


def _check_answer(
    guard: GuardedDynamics,
    given: tuple[Tensor, Tensor, Tensor],
    answer: tuple[Tensor, Tensor, Tensor],
    who: str,
) -> None:
    """Check what came out of one step: finite, flagged where it must be, else the model's own."""
    x, w, s = given
    after, memory, outside = answer
    require(outside.dtype == torch.bool, f"{who}: the flag is {outside.dtype}, not bool")
    require(outside.shape == (len(x),), f"{who}: the flag has the shape {outside.shape}, not [B]")
    require_finite(after, f"{who}: a state is not finite")
    require_finite(memory, f"{who}: a memory is not finite")
    seen = torch.cat((x, w), dim=-1)
    inside = ((seen >= guard.low) & (seen <= guard.high)).all(dim=-1)
    inside &= guard.remembers(s)
    missed = ~inside & ~outside
    require(not bool(missed.any()), f"{who}: {int(missed.sum())} bad samples are not flagged")
    own, left = guard.model.step(x, w, s)
    sound = inside & (own >= guard.least[:6]).all(dim=-1) & (own <= guard.most[:6]).all(dim=-1)
    false = sound & outside
    require(not bool(false.any()), f"{who}: {int(false.sum())} good samples are flagged")
    require_equal(after[sound], own[sound], 1e-4, f"{who}: a good sample is answered otherwise")
    require_equal(memory[sound], left[sound], 1e-4, f"{who}: a good sample is remembered otherwise")
    expected, kept, _ = guard.flagged_step(x, w, s)
    require_equal(after, expected, 1e-4, f"{who}: a bad sample is answered otherwise than stated")
    require_equal(memory, kept, 1e-4, f"{who}: a bad sample is remembered otherwise than stated")


def _check_rollout(
    exported: Any, x: Tensor, w: Tensor, s: Tensor, random: torch.Generator, who: str
) -> None:
    """Check that a rollout with bad samples is the same as its steps."""
    w = w.clone()
    w[:, _BAD_STEP] = _damage(w[:, _BAD_STEP], w.amax((0, 1)), 0.5, random)
    first = _damage(x, x.amax(0), 0.1, random)
    states, last, flags = exported.rollout(first, w, s)
    require(
        states.shape == (len(x), w.shape[1] + 1, x.shape[1]) and flags.shape == w.shape[:2],
        f"{who}: a rollout gives the shapes {tuple(states.shape)} and {tuple(flags.shape)}",
    )
    require_finite(states, f"{who}: a rollout gives a state that is not finite")
    after, memory, raised = first, s, []
    for k in range(w.shape[1]):
        after, memory, outside = exported.step(after, w[:, k], memory)
        raised.append(outside)
        message = f"{who}: a rollout differs from its steps at step {k}"
        require_equal(states[:, k + 1], after, 1e-5, message)
    require(
        torch.equal(flags, torch.stack(raised, dim=1)),
        f"{who}: a rollout raises other flags than its steps",
    )
    require_equal(last, memory, 1e-5, f"{who}: a rollout ends with another memory than its steps")


def _check_histories(
    exported: Any, past: Tensor, given: Tensor, random: torch.Generator, who: str
) -> None:
    """Check that bad samples of a history are left out."""
    y, w = past.clone(), given.clone()
    bad = torch.rand(y.shape[:2], generator=random) < 0.4
    y[bad] = torch.nan
    w[bad.roll(1, dims=0)] = torch.inf
    require_finite(exported.warmup(y, w), f"{who}: a history with gaps leaves what is no number")
    empty = exported.initial_state(len(y))
    nothing = exported.warmup(torch.full_like(y, torch.nan), w)
    require_equal(nothing, empty, 0.0, f"{who}: a history without a number leaves a memory")
    held = past.clone()
    held[:, 2], w = held[:, 1], given.clone()
    w[:, 2] = w[:, 1]
    lost = past.clone()
    lost[:, 2, 4] = torch.nan
    require_equal(
        exported.warmup(lost, given),
        exported.warmup(held, w),
        1e-5,
        f"{who}: the last good sample does not stand for a bad one in a history",
    )


def check_bad_measurements(
    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    initial_state: Callable[[Tensor], Tensor],
    low: Tensor,
    high: Tensor,
    memory: tuple[Tensor, Tensor],
    limit: float,
    *,
    cases: int = 200,
    seed: int = 0,
) -> None:
    """Check that an exported controller commands finite angles and flags what is wrong.

    Among good measurements stand bad ones, bad memories, and memories whose entries lie within
    their ranges but do not belong together.

    Args:
        step: command [B, 1], memory and fault [B] from measurements y [B, k] and memory.
        initial_state: the memory from measurements.
        low: smallest accepted measurements [k].
        high: largest accepted measurements [k].
        memory: smallest and largest accepted memory [n].
        limit: of the command.
        cases: number of rows.
        seed: of the cases.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    random = torch.Generator().manual_seed(seed)
    least, most = memory

    def between(a: Tensor, b: Tensor) -> Tensor:
        return a + torch.rand(cases, a.numel(), generator=random) * (b - a)

    s = initial_state(_damage(between(low, high), high, 0.2, random))
    require_finite(s, "the memory at a bad measurement is not finite")
    for k in range(30):
        y, given = between(low, high), s
        if k % 5 == 1:
            y = _damage(y, high, 0.3, random)
        if k % 5 == 3:
            given = _damage(s, most, 0.2, random)
        if k == 20:
            given = between(least, most)
        command, s, fault = step(y, given)
        who = f"exported controller, step {k}"
        require_finite(command, f"{who}: a command is not finite")
        require_finite(s, f"{who}: a memory is not finite")
        require(bool((command.abs() <= 1.001 * limit).all()), f"{who}: a command exceeds its limit")
        good = ((y >= low) & (y <= high)).all(dim=-1)
        good &= ((given >= least) & (given <= most)).all(dim=-1)
        require(bool((fault | good).all()), f"{who}: a bad sample raises no flag")
        if k < 20:
            require(not bool((fault & good).any()), f"{who}: a good sample raises a flag")
        kept = ((s >= least) & (s <= most)).all()
        require(bool(kept), f"{who}: leaves a memory that it would not accept")
