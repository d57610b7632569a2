"""Contract checks of export formats: parity, bad inputs and rollouts of exported models."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from residnet.core.errors import UsageError
from residnet.core.layout import PLANAR_LAYOUT
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.guard import GuardedDynamics
from residnet.export.vessel import ExportedVessel
from residnet.testing.checks import assert_close, assert_finite, assert_true, make_example_models


def check_exporter(exporter: Exporter) -> None:
    """Check the contracts of an export format.

    The exporter creates the file and its folder, returns a model card, does not change the model,
    and rejects unsupported models with a one-line error.

    Args:
        exporter: the export format.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"export format {exporter.name}"
    assert_true(
        bool(exporter.about) and "\n" not in exporter.about, f"{subject}: `about` is not one line"
    )
    assert_true(
        exporter.suffix.count(".") >= 1, f"{subject}: the suffix {exporter.suffix!r} has no ending"
    )
    for spec, model in make_example_models():
        # clones: `state_dict` returns references, which would change with the model
        state_before = {name: value.clone() for name, value in model.state_dict().items()}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "exports" / f"{spec.name}{exporter.suffix}"
            try:
                card = exporter.export(ExportedVessel(spec, model), file)
            except UsageError as error:
                assert_true(
                    "\n" not in str(error), f"{subject}: rejects a model with more than one line"
                )
                assert_true(
                    not file.exists(), f"{subject}: writes a file of a model that it rejects"
                )
                continue
            assert_true(file.exists(), f"{subject}: writes no {file.name}")
            assert_true(isinstance(card, Mapping) and bool(card), f"{subject}: returns no card")
            partial_files = [
                path.name for path in file.parent.iterdir() if path.name.endswith(".partial")
            ]
            assert_true(not partial_files, f"{subject}: leaves {', '.join(partial_files)} behind")
        for name, value in model.state_dict().items():
            expected = state_before[name].to(torch.float64)
            message = f"{subject}: changes '{name}' of the model"
            assert_close(value.to(torch.float64), expected, 1e-6, message)


_PAST_STEPS = 6
"""Number of measured steps before a free run of the checks of exported models."""
_FREE_STEPS = 8
"""Number of steps of that free run."""
_BAD_STEP_INDEX = 3
"""Index of the step with bad values; all other steps have valid values."""
_FAR_VALUES = (1e38, -1e38, 1e20, -1e20, 1e9, -1e9, 1e5)
"""Finite values far outside any range, up to the largest ones of single precision."""
_BAD_VALUES = (float("nan"), float("inf"), float("-inf"), *_FAR_VALUES)
"""Bad values of an entry, in addition to random multiples of the limits of its range."""


def check_bad_inputs(
    exported: Any, spec: ModelSpec, model: HybridDynamics, *, cases: int = 200, seed: int = 0
) -> None:
    """Check that an exported model flags bad inputs and always returns finite values.

    Each case is a short free run. At one step, elements of the state, the inputs or the memory are
    NaN, infinite or far outside the training range. All results must be finite. The flag must be
    set for values outside the range and its margin or outside the operating domain, and for no
    others. Unflagged results must equal the results of the model, and results after the bad step
    must not depend on it.

    Args:
        exported: an object with the methods `initial_state`, `warmup`, `step` and `rollout` of
            `residnet.export.base`.
        spec: specification of the model.
        model: the model; it is converted to float32.
        cases: number of free runs.
        seed: random seed of the cases.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"exported {spec.name}"
    guard = GuardedDynamics(model.float().eval(), spec)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        n_pose = PLANAR_LAYOUT.pose_columns.stop
        n_dynamic = guard.dof
        lower = guard.ranges.lower[n_pose:]
        upper = guard.ranges.upper[n_pose:]
        # not at the edges of the range, where rounding to float32 could decide about the flag
        range_share = 0.05 + 0.9 * torch.rand(
            cases, _PAST_STEPS + _FREE_STEPS, lower.numel(), generator=generator
        )
        channels = lower + range_share * (upper - lower)
        pose = 40.0 * torch.rand(cases, _PAST_STEPS + _FREE_STEPS, 3, generator=generator) - 20.0
        y = torch.cat((pose, channels[..., :n_dynamic]), dim=-1)
        w = channels[..., n_dynamic:]
        past_states = y[:, :_PAST_STEPS]
        past_inputs = w[:, :_PAST_STEPS]
        x = y[:, _PAST_STEPS]
        w = w[:, _PAST_STEPS:]
        s = exported.warmup(past_states, past_inputs)
        assert_close(
            s,
            model.warmup(past_states, past_inputs),
            1e-4,
            f"{subject}: the memory after the warm-up differs from that of the model",
        )
        _check_steps(exported, guard, x, w, s, generator, subject)
        _check_rollout(exported, x, w, s, generator, subject)
        _check_histories(exported, past_states, past_inputs, generator, subject)


def replace_entries(
    values: Tensor, upper_edge: Tensor, damaged_share: float, generator: torch.Generator
) -> Tensor:
    """Replace a share of the values [B, k] by bad values, some just above the limits [k]."""
    bad_values = torch.tensor(_BAD_VALUES)[
        torch.randint(len(_BAD_VALUES), values.shape, generator=generator)
    ]
    # from 1 % to 10,000 times beyond the limit: values just outside are the difficult ones
    edge_factor = 10.0 ** (6.0 * torch.rand(values.shape, generator=generator) - 2.0)
    beyond_edge = (upper_edge + upper_edge.abs().clamp(min=1e-3) * edge_factor).expand_as(values)
    random_kind = torch.rand(values.shape, generator=generator)
    is_damaged = torch.rand(values.shape, generator=generator) < damaged_share
    return torch.where(is_damaged, torch.where(random_kind < 0.7, bad_values, beyond_edge), values)


def _check_steps(
    exported: Any,
    guard: GuardedDynamics,
    x: Tensor,
    w: Tensor,
    s: Tensor,
    generator: torch.Generator,
    subject: str,
) -> None:
    """Check the steps of a free run with one bad step."""
    columns = x.shape[1]
    for k in range(w.shape[1]):
        state = x
        inputs = w[:, k]
        memory = s
        if k == _BAD_STEP_INDEX:
            # state, inputs and memory are damaged independently, so that all combinations occur
            is_damaged = torch.rand(3, len(x), 1, generator=generator) < 0.5
            state = torch.where(
                is_damaged[0], replace_entries(x, guard.ranges.upper[:columns], 0.4, generator), x
            )
            upper_edge = guard.ranges.upper[columns:]
            inputs = torch.where(
                is_damaged[1], replace_entries(inputs, upper_edge, 0.5, generator), inputs
            )
            upper_edge = guard.memory_upper
            memory = torch.where(
                is_damaged[2], replace_entries(s, upper_edge, 1.0 / (1 + s.shape[1]), generator), s
            )
        x, s, outside = exported.step(state, inputs, memory)
        _check_answer(guard, (state, inputs, memory), (x, s, outside), f"{subject}, step {k}")
        if k == _BAD_STEP_INDEX:
            # the next measurement is valid again, with the returned or a new memory
            midpoints = 0.5 * (guard.ranges.lower + guard.ranges.upper).expand(len(x), -1)
            measured_state = midpoints[:, :columns]
            inputs = midpoints[:, columns:]
            for start_memory in (s, exported.initial_state(len(x))):
                answer = exported.step(measured_state, inputs, start_memory)
                _check_answer(
                    guard,
                    (measured_state, inputs, start_memory),
                    answer,
                    f"{subject}, after a bad sample",
                )


def _check_answer(
    guard: GuardedDynamics,
    step_inputs: tuple[Tensor, Tensor, Tensor],
    answer: tuple[Tensor, Tensor, Tensor],
    subject: str,
) -> None:
    """Check that the result of a step is finite, correctly flagged and equal to the model's."""
    x, w, s = step_inputs
    next_state, memory, outside = answer
    assert_true(outside.dtype == torch.bool, f"{subject}: the flag is {outside.dtype}, not bool")
    assert_true(
        outside.shape == (len(x),), f"{subject}: the flag has the shape {outside.shape}, not [B]"
    )
    assert_finite(next_state, f"{subject}: a state is not finite")
    assert_finite(memory, f"{subject}: a memory is not finite")
    channels = torch.cat((x, w), dim=-1)
    is_inside = guard.ranges.is_in_training_range(channels) & guard.is_valid_memory(s)
    if guard.domain_check is not None:
        is_inside &= guard.domain_check(x, w)
    is_unflagged = ~is_inside & ~outside
    assert_true(
        not bool(is_unflagged.any()),
        f"{subject}: {int(is_unflagged.sum())} bad samples are not flagged",
    )
    model_state, model_memory = guard.model.step(x, w, s)
    is_sound = (
        is_inside
        & (model_state >= guard.ranges.accepted_lower[:6]).all(dim=-1)
        & (model_state <= guard.ranges.accepted_upper[:6]).all(dim=-1)
    )
    is_false_alarm = is_sound & outside
    assert_true(
        not bool(is_false_alarm.any()),
        f"{subject}: {int(is_false_alarm.sum())} good samples are flagged",
    )
    assert_close(
        next_state[is_sound],
        model_state[is_sound],
        1e-4,
        f"{subject}: the state of a valid sample differs from that of the model",
    )
    assert_close(
        memory[is_sound],
        model_memory[is_sound],
        1e-4,
        f"{subject}: the memory of a valid sample differs from that of the model",
    )
    expected, guarded_memory, _ = guard.flagged_step(x, w, s)
    assert_close(
        next_state,
        expected,
        1e-4,
        f"{subject}: the state of a bad sample differs from the specification",
    )
    assert_close(
        memory,
        guarded_memory,
        1e-4,
        f"{subject}: the memory of a bad sample differs from the specification",
    )


def _check_rollout(
    exported: Any, x: Tensor, w: Tensor, s: Tensor, generator: torch.Generator, subject: str
) -> None:
    """Check that a rollout with bad values equals its steps."""
    w = w.clone()
    w[:, _BAD_STEP_INDEX] = replace_entries(w[:, _BAD_STEP_INDEX], w.amax((0, 1)), 0.5, generator)
    first_state = replace_entries(x, x.amax(0), 0.1, generator)
    states, last_memory, flags = exported.rollout(first_state, w, s)
    assert_true(
        states.shape == (len(x), w.shape[1] + 1, x.shape[1]) and flags.shape == w.shape[:2],
        f"{subject}: a rollout gives the shapes {tuple(states.shape)} and {tuple(flags.shape)}",
    )
    assert_finite(states, f"{subject}: a rollout gives a state that is not finite")
    next_state = first_state
    memory = s
    step_flags = []
    for k in range(w.shape[1]):
        next_state, memory, outside = exported.step(next_state, w[:, k], memory)
        step_flags.append(outside)
        message = f"{subject}: a rollout differs from its steps at step {k}"
        assert_close(states[:, k + 1], next_state, 1e-5, message)
    assert_true(
        torch.equal(flags, torch.stack(step_flags, dim=1)),
        f"{subject}: a rollout raises other flags than its steps",
    )
    assert_close(
        last_memory, memory, 1e-5, f"{subject}: a rollout ends with another memory than its steps"
    )


def _check_histories(
    exported: Any,
    past_states: Tensor,
    past_inputs: Tensor,
    generator: torch.Generator,
    subject: str,
) -> None:
    """Check that bad samples of a history are ignored."""
    y = past_states.clone()
    w = past_inputs.clone()
    is_bad = torch.rand(y.shape[:2], generator=generator) < 0.4
    y[is_bad] = torch.nan
    w[is_bad.roll(1, dims=0)] = torch.inf
    assert_finite(
        exported.warmup(y, w), f"{subject}: the memory after a history with gaps is not finite"
    )
    initial_memory = exported.initial_state(len(y))
    warmed_without_data = exported.warmup(torch.full_like(y, torch.nan), w)
    assert_close(
        warmed_without_data,
        initial_memory,
        0.0,
        f"{subject}: a history of NaN changes the memory",
    )
    # a missing sample must act as a repetition of the previous one
    repeated = past_states.clone()
    repeated[:, 2] = repeated[:, 1]
    w = past_inputs.clone()
    w[:, 2] = w[:, 1]
    missing_sample = past_states.clone()
    missing_sample[:, 2, 4] = torch.nan
    assert_close(
        exported.warmup(missing_sample, past_inputs),
        exported.warmup(repeated, w),
        1e-5,
        f"{subject}: a bad sample of a history is not replaced by the last valid sample",
    )
