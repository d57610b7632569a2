"""How a rollout runs where its numbers are wanted quickly: as C, or with a recorded step."""

from __future__ import annotations

import hashlib
import io
import pickle
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from residnet.core.progress import log_message
from residnet.engine.rollout import (
    WORTH_COMPILING,
    FreeRun,
    Rollout,
    runs_in_python,
    trace_rollout,
)

if TYPE_CHECKING:
    from residnet.engine.compiled import CompiledRollout


class _Structure(pickle.Pickler):
    """Writes all of a rollout but the numbers of its parameters and buffers."""

    def __init__(self, out: io.BytesIO, rollout: Rollout) -> None:
        super().__init__(out)
        self.known = {id(number) for number in (*rollout.parameters(), *rollout.buffers())}

    def persistent_id(self, obj: Any) -> Any:
        """Return what a tensor is known by."""
        if not isinstance(obj, Tensor):
            return None
        if obj.is_floating_point() and id(obj) in self.known:
            return str(obj.dtype), tuple(obj.shape), obj.requires_grad and torch.is_grad_enabled()
        return str(obj.dtype), obj.tolist()


_KNOWN: dict[bytes, CompiledRollout | Literal[False]] = {}
"""Rollouts by structure: compiled, or that they cannot be."""


def compiled(rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout as compiled C where that pays and can be done.

    Rollouts that differ in their numbers alone are compiled once. Elsewhere the result is that of
    `trace_rollout`.

    Args:
        rollout: on its device, in its type, in training or in evaluation, as it is run.
        steps: that will be run with it altogether.
    """
    chosen: dict[bool, FreeRun] = {}

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        graded = torch.is_grad_enabled()
        if graded not in chosen:
            chosen[graded] = _chosen(rollout, steps, x0, w, s)
        return chosen[graded](x0, w, s)

    return run


def _chosen(rollout: Rollout, steps: int, x0: Tensor, w: Tensor, s: Tensor) -> FreeRun:
    apart = x0.device.type != "cpu" or rollout.source.counts or not w.numel()
    if steps < WORTH_COMPILING or apart or runs_in_python(rollout):
        return trace_rollout(rollout, steps)
    out = io.BytesIO()
    try:
        _Structure(out, rollout).dump((rollout, x0.dtype, torch.is_grad_enabled()))
    except Exception:
        # parts of somebody else's that cannot be pickled
        return trace_rollout(rollout, steps)
    key = hashlib.sha256(out.getvalue()).digest()
    if key not in _KNOWN:
        from residnet.engine.c_code import CompilerError
        from residnet.engine.compiled import CompiledRollout

        try:
            # the trial of a step that draws numbers (dropout) must not shift those of the training
            with torch.random.fork_rng(devices=[]):
                _KNOWN[key] = CompiledRollout(rollout, x0, w, s)
        except Exception as error:
            # no compiler, or a step that C does not hold
            _KNOWN[key] = False
            if isinstance(error, CompilerError):
                _tell(str(error))
    known = _KNOWN[key]
    return known.of(rollout) if known else trace_rollout(rollout, steps)


@cache
def _tell(reason: str) -> None:
    """Say once why free runs are not compiled."""
    log_message(f"  free runs are not compiled, and take longer: {reason}")
