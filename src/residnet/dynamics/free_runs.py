"""How a rollout is run where its numbers are wanted quickly: as compiled C, or by TorchScript."""

from __future__ import annotations

import copy
import hashlib
import io
import pickle
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from residnet.core.progress import say
from residnet.dynamics.rollout import WORTH_SCRIPTING, FreeRun, Rollout, scripted

if TYPE_CHECKING:
    from residnet.dynamics.compiled import CompiledRollout

_WORTH = 500
"""Steps from which on a run is compiled: its own alone, so that numbers do not hang on what ran
before. Writing and compiling a step takes .7 s, once for all models of a structure; a step in torch
takes .15 to 1.3 ms.
"""


class _Structure(pickle.Pickler):
    """Writes all of a rollout but the numbers of its parameters and buffers.

    Attributes:
        apart: whether it holds other numbers, which are not written either.
    """

    def __init__(self, out: io.BytesIO, rollout: Rollout) -> None:
        super().__init__(out)
        self.known = {id(number) for number in _numbers(rollout)}
        self.apart = False

    def persistent_id(self, obj: Any) -> Any:
        """Return what a tensor is known by."""
        if not isinstance(obj, Tensor):
            return None
        if obj.is_floating_point():
            self.apart |= id(obj) not in self.known
            return str(obj.dtype), tuple(obj.shape), obj.requires_grad and torch.is_grad_enabled()
        return str(obj.dtype), obj.tolist()


def _numbers(rollout: Rollout) -> list[Tensor]:
    return [*rollout.parameters(), *rollout.buffers()]


_SCRIPTED: dict[bytes, tuple[Rollout, FreeRun]] = {}
"""Rollouts by structure, with numbers of their own, and as TorchScript."""
_KNOWN: dict[bytes, CompiledRollout | Literal[False]] = {}
"""Rollouts by structure: compiled, or that they cannot be."""


def compiled(rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout as compiled C where that pays and can be done.

    Rollouts that differ in their numbers alone are compiled once. Elsewhere it is as `scripted` has
    it.

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
    if steps < WORTH_SCRIPTING or apart:
        return scripted(rollout, steps)
    out = io.BytesIO()
    structure = _Structure(out, rollout)
    try:
        structure.dump((rollout, x0.dtype, torch.is_grad_enabled()))
    except Exception:
        # parts of somebody else's that cannot be pickled
        return scripted(rollout, steps)
    key = hashlib.sha256(out.getvalue()).digest()
    if steps < _WORTH:
        once = not (torch.is_grad_enabled() or structure.apart)
        return _scripted_once(key, rollout, steps) if once else scripted(rollout, steps)
    if key not in _KNOWN:
        from residnet.dynamics.c_code import CompilerError
        from residnet.dynamics.compiled import CompiledRollout

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
    return known.of(rollout) if known else scripted(rollout, steps)


def _scripted_once(key: bytes, rollout: Rollout, steps: int) -> FreeRun:
    """Return the rollout as TorchScript, made once for all that differ in their numbers alone."""
    if key not in _SCRIPTED:
        own = copy.deepcopy(rollout).requires_grad_(False)
        _SCRIPTED[key] = own, scripted(own, steps)
    own, fly = _SCRIPTED[key]

    def run(x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        for kept, number in zip(_numbers(own), _numbers(rollout), strict=True):
            kept.copy_(number)
        return fly(x0, w, s)

    return run


@cache
def _tell(reason: str) -> None:
    """Say once why free runs are not compiled."""
    say(f"  free runs are not compiled, and take longer: {reason}")
