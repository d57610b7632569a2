"""Choice of the fastest rollout: compiled C, a traced step, or the step in Python."""

from __future__ import annotations

import copy
from functools import cache
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from residnet.core.progress import log_message
from residnet.dynamics.hybrid import HybridDynamics, MeasuredPast
from residnet.engine.rollout import (
    MIN_STEPS_TO_COMPILE,
    FreeRun,
    Rollout,
    has_untraceable_part,
    trace_rollout,
)
from residnet.engine.structure import hash_structure
from residnet.heads.recurrent import GRUEnsembleHead

if TYPE_CHECKING:
    from residnet.engine.compiled import CompiledRollout


# compiled rollouts by structure; False where compilation failed
_COMPILED: dict[bytes, CompiledRollout | Literal[False]] = {}


def compile_rollout(rollout: Rollout, steps: int) -> FreeRun:
    """Compile a rollout to C, or trace its step if C is impossible or compilation takes longer.

    Rollouts that differ only in parameters and buffers are compiled once.

    Args:
        rollout: the rollout on its device, in its type and mode (training or evaluation).
        steps: total number of steps that it will run.
    """
    # one for runs with gradients, one for runs without
    runs: dict[bool, FreeRun] = {}

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        has_gradient = torch.is_grad_enabled()
        if has_gradient not in runs:
            runs[has_gradient] = _select_run(rollout, steps, x0, w, s)
        return runs[has_gradient](x0, w, s)

    return run


def _select_run(rollout: Rollout, steps: int, x0: Tensor, w: Tensor, s: Tensor) -> FreeRun:
    """Return the fastest way to run a rollout with arguments like these."""
    if not _is_compilable(rollout, steps, x0, w):
        return trace_rollout(rollout, steps)
    head = _find_ensemble_head(rollout)
    if head is None:
        compiled = _compile(rollout, x0, w, s)
        return trace_rollout(rollout, steps) if compiled is None else compiled.with_rollout(rollout)
    # one compiled program runs the rows of each member with the parameters of this member. With the
    # traced step of all members, a training took three times as long (71 instead of 24 s)
    n_members = head.batch_ensemble_size
    n_rows = len(x0) // n_members
    member_rollout = copy.deepcopy(rollout)
    member_head = _find_ensemble_head(member_rollout)
    assert member_head is not None, "a copy has the same head"
    member_head.keep_first_member()
    member_program = _compile(member_rollout, x0[:n_rows], w[:n_rows], s[:n_rows])
    if member_program is None:
        return trace_rollout(rollout, steps)
    return _run_by_member(rollout, head, member_program.with_rollout(member_rollout))


def _run_by_member(
    rollout: Rollout, head: GRUEnsembleHead, member_program: CompiledRollout
) -> FreeRun:
    """Return a free run of an ensemble by a compiled program of one member.

    Args:
        rollout: rollout of the ensemble.
        head: its head.
        member_program: compiled rollout of the same model with one member.
    """
    from residnet.engine.compiled import named_tensors

    parameter_ids = {id(parameter) for parameter in head.parameters()}

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        tensors = named_tensors(rollout)
        n_rows = len(x0) // head.batch_ensemble_size
        results = []
        for k in range(head.batch_ensemble_size):
            member_tensors = {
                name: tensor[k : k + 1] if id(tensor) in parameter_ids else tensor
                for name, tensor in tensors.items()
            }
            rows = slice(k * n_rows, (k + 1) * n_rows)
            results.append(
                member_program.run_with_tensors(member_tensors, x0[rows], w[rows], s[rows])
            )
        states, applied_inputs, memory = (torch.cat(parts) for parts in zip(*results, strict=True))
        return states, applied_inputs, memory

    return run


def _find_ensemble_head(rollout: Rollout) -> GRUEnsembleHead | None:
    """Return the head of a model whose rows are blocks, one per network; None for other models."""
    model = rollout.model
    head = model.head if isinstance(model, HybridDynamics | MeasuredPast) else None
    if not isinstance(head, GRUEnsembleHead):
        return None
    return head if head.batch_ensemble_size > 1 else None


def _is_compilable(rollout: Rollout, steps: int, x0: Tensor, w: Tensor) -> bool:
    """Return whether a rollout is long enough and free of parts that cannot be compiled."""
    return (
        steps >= MIN_STEPS_TO_COMPILE
        and x0.device.type == "cpu"
        and w.numel() > 0
        and not rollout.source.depends_on_step
        and not has_untraceable_part(rollout)
    )


def _compile(rollout: Rollout, x0: Tensor, w: Tensor, s: Tensor) -> CompiledRollout | None:
    """Return the compiled rollout of this structure; None if it cannot be compiled."""
    key = hash_structure(
        (rollout, x0.dtype, torch.is_grad_enabled()), (*rollout.parameters(), *rollout.buffers())
    )
    if key is None:
        return None
    if key not in _COMPILED:
        from residnet.engine.c_code import CompilerError
        from residnet.engine.compiled import CompiledRollout

        try:
            # tracing a step with dropout must not change the random numbers of the training
            with torch.random.fork_rng(devices=[]):
                _COMPILED[key] = CompiledRollout(rollout, x0, w, s)
        except Exception as error:
            # no compiler, or a step that cannot be written in C
            _COMPILED[key] = False
            if isinstance(error, CompilerError):
                _report_missing_compiler(str(error))
    return _COMPILED[key] or None


@cache
def _report_missing_compiler(reason: str) -> None:
    """Log once per process why free runs are slow."""
    log_message(f"  free runs are not compiled and take longer: {reason}")
