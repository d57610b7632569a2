"""A module's step as a graph of torch's own operations, recorded for one row."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule

from residnet.core.errors import ExportError


def recorded(step: Callable[..., Any], arguments: Sequence[Tensor], what: str) -> GraphModule:
    """Return the operations of `step` at these arguments, decomposed to torch's core operations.

    Args:
        step: returns tensors.
        arguments: of one row each; the sizes of the recording.
        what: is recorded, for messages.

    Raises:
        ExportError: where the step cannot be recorded, because Python decides by values in it.
    """
    from torch._decomp import core_aten_decompositions
    from torch.func import functionalize
    from torch.fx.experimental.proxy_tensor import make_fx

    def call(*given: Tensor) -> Any:
        return step(*given)

    # make_fx counts the parameters of what it records
    wrapped = functionalize(call, remove="mutations")
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            table: Any = core_aten_decompositions()
            return make_fx(wrapped, decomposition_table=table)(*arguments)
    except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
        first = str(error).strip().splitlines()
        raise ExportError(
            f"{what}: its step cannot be recorded as a fixed sequence of operations"
            f" ({first[0] if first else type(error).__name__}); export it as torchscript"
        ) from error
