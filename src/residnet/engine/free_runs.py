"""Choice of the fastest rollout: compiled C, a traced step, or the step in Python."""

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
    MIN_STEPS_TO_COMPILE,
    FreeRun,
    Rollout,
    has_untraceable_part,
    trace_rollout,
)

if TYPE_CHECKING:
    from residnet.engine.compiled import CompiledRollout


class _StructurePickler(pickle.Pickler):
    """Pickles a rollout without the values of its parameters and buffers."""

    def __init__(self, file: io.BytesIO, rollout: Rollout) -> None:
        super().__init__(file)
        self.tensor_ids = {id(tensor) for tensor in (*rollout.parameters(), *rollout.buffers())}

    def persistent_id(self, obj: Any) -> Any:
        """Return the identity of a tensor: type and shape, or type and values of a constant."""
        if not isinstance(obj, Tensor):
            return None
        if obj.is_floating_point() and id(obj) in self.tensor_ids:
            return str(obj.dtype), tuple(obj.shape), obj.requires_grad and torch.is_grad_enabled()
        return str(obj.dtype), obj.tolist()


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
    is_compilable = (
        steps >= MIN_STEPS_TO_COMPILE
        and x0.device.type == "cpu"
        and w.numel() > 0
        and not rollout.source.depends_on_step
        and not has_untraceable_part(rollout)
    )
    if not is_compilable:
        return trace_rollout(rollout, steps)
    file = io.BytesIO()
    try:
        _StructurePickler(file, rollout).dump((rollout, x0.dtype, torch.is_grad_enabled()))
    except Exception:
        # parts of other packages that cannot be pickled
        return trace_rollout(rollout, steps)
    key = hashlib.sha256(file.getvalue()).digest()
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
    compiled = _COMPILED[key]
    return compiled.with_rollout(rollout) if compiled else trace_rollout(rollout, steps)


@cache
def _report_missing_compiler(reason: str) -> None:
    """Log once per process why free runs are slow."""
    log_message(f"  free runs are not compiled and take longer: {reason}")
