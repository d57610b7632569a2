"""TorchScript files, written one way: scripted, frozen, and checked against the eager module.

They are checked again as they lie on disk.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.jit._fuser import optimized_execution

from residnet.core.files import whole

Parity = TypeVar("Parity")


def size(tensor: Tensor, dimensions: int, dimension: int) -> int:
    """Return the size of one dimension of a tensor, 1 where the tensor has not so many.

    TorchScript compiles it.
    """
    return tensor.shape[dimension] if tensor.dim() == dimensions else 1


def within(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return which rows of values [B, n] lie between low and high [n] in all entries, [B, 1].

    What is no number does not. TorchScript compiles it.
    """
    return ((values >= low) & (values <= high)).all(dim=-1, keepdim=True)


def require_shape(name: str, tensor: Tensor, shape: list[int]) -> None:
    """Refuse a tensor of another shape, which arithmetic might broadcast.

    TorchScript compiles it: Python sees `torch.jit.Error`, C++ an exception, with this text.

    Raises:
        ValueError: that names the argument and both shapes.
    """
    if list(tensor.shape) != shape:
        raise ValueError(f"{name} has the shape {tensor.shape}, expected {shape}")


def write_scripted(
    file: Path,
    module: nn.Module,
    methods: Sequence[str],
    check: Callable[[Any], Parity],
    card: Callable[[Parity], dict[str, Any]],
) -> dict[str, Any]:
    """Write a module as TorchScript with `card.json` as an extra file.

    The file appears once everything has been checked.

    Args:
        file: where to write.
        module: in evaluation mode.
        methods: that freezing must keep, beside `forward`.
        check: compares the scripted module with the eager one and raises ExportError where they
            differ.
        card: from what `check` returned.

    Returns:
        The card.

    Raises:
        ExportError: from `check`.
    """
    # freezing loses the methods where a program has switched the executor's optimisation off
    with warnings.catch_warnings(), optimized_execution(True):
        # TorchScript still works in torch 2.13 but announces its end; every export depends on it
        # here alone
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=FutureWarning)
        warnings.filterwarnings("ignore", message=".*torch.jit.*")
        scripted = torch.jit.freeze(torch.jit.script(module), preserved_attrs=list(methods))
        for name in methods:
            _compute_once(scripted, name)
        contents = card(check(scripted))
        # through memory: a disk that is full is then the system's error, not one of PyTorch
        written = io.BytesIO()
        torch.jit.save(
            scripted, written, _extra_files={"card.json": json.dumps(contents, indent=1)}
        )
        with whole(file) as partial:
            partial.write_bytes(written.getvalue())
            check(torch.jit.load(str(partial)))
    return contents


def _compute_once(scripted: Any, method: str) -> None:
    """Let a method compute alike expressions once, in the graph that is saved.

    The executor would do so while it runs, but its settings that make the first call quick leave
    graphs as they are.
    """
    graph = scripted._c._get_method(method).graph
    passes = torch._C
    passes._jit_pass_inline(graph)
    # what one round has joined lets the next one join more
    for _ in range(3):
        passes._jit_pass_constant_propagation(graph)
        passes._jit_pass_peephole(graph)
        passes._jit_pass_cse(graph)
        passes._jit_pass_dce(graph)
