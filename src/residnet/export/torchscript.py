"""The format `torchscript`: one file that a controller loads with torch alone.

The module is frozen; its metadata (model card, card.json) is stored as an extra file in the
archive. TorchScript is code: load only files that you trust. The format `aoti` compiles the
function of one time step ahead of time, for this type of machine.
"""

from __future__ import annotations

import io
import json
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch
from torch import Tensor
from torch.jit._fuser import optimized_execution
from torch.jit._trace import TracerWarning

from residnet.core.errors import ExportError
from residnet.core.files import atomic_write
from residnet.export.base import (
    Exportable,
    Exporter,
    LoadedExport,
    NumberArray,
    get_dtype_name,
    run_in_sufficient_precision,
    write_card,
)

_EXECUTOR_SETTINGS = {
    "format": "torchscript",
    "safety": (
        "TorchScript is code that runs when loaded: load only files that you trust. The files under"
        " models/ hold numbers only."
    ),
    "executor": {
        "threads": 1,
        "profiling_mode": False,
        "optimize": False,
        "why": (
            "torch's profiling executor compiles during the first calls, which then take hundreds"
            " of steps; so set, the first call is as quick as the others"
        ),
        "python": (
            "torch.set_num_threads(1); torch._C._jit_set_profiling_executor(False);"
            " torch._C._set_graph_executor_optimize(False)"
        ),
        "c++": (
            "at::set_num_threads(1); torch::jit::getProfilingMode() = false;"
            " torch::jit::setGraphExecutorOptimize(false)"
        ),
    },
}
"""Additional entries of the model card: executor settings for a fast first call."""


def get_size(tensor: Tensor, n_dimensions: int, axis: int) -> int:
    """Return the size along an axis, or 1 if the tensor has another number of dimensions.

    TorchScript compiles this function. The following check of the shape then fails with its own
    message instead of an index error.
    """
    return tensor.shape[axis] if tensor.dim() == n_dimensions else 1


def require_shape(name: str, tensor: Tensor, shape: list[int]) -> None:
    """Check the shape of a tensor, because a wrong shape might be broadcast without an error.

    TorchScript compiles this function: Python raises `torch.jit.Error`, C++ an exception, with this
    message.

    Raises:
        ValueError: if the shape differs; names the argument and both shapes.
    """
    if list(tensor.shape) != shape:
        raise ValueError(f"{name} has the shape {tensor.shape}, expected {shape}")


def trace_function(function: Callable[..., Any], examples: tuple[Tensor, ...], what: str) -> Any:
    """Trace a function of batches as a TorchScript function.

    Values that are not arguments become constants.

    Args:
        function: function of the tensors `examples`, without branches that depend on values.
        examples: batches [B, size] of at least two rows.
        what: name of the exported part, for messages.

    Raises:
        ExportError: if a branch depends on values, or results differ for another number of rows.
    """
    other_batches = [
        tuple(part[:1] for part in examples),
        tuple(torch.cat((part, part[:1])) for part in examples),
    ]
    # imported here because it imports CasADi, which only exports need
    from residnet.engine.trace import record_graph

    # finds branches that depend on values; a trace would always take the branch of the examples
    record_graph(function, examples, what)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        # the warning is about sizes that become constants, which the other batches below reveal
        warnings.filterwarnings("ignore", category=TracerWarning)
        try:
            # a lambda, since torch does not trace methods of modules as functions
            graph: Any = torch.jit.trace(lambda *x: function(*x), examples, check_trace=False)
            for batch in other_batches:
                torch.testing.assert_close(graph(*batch), function(*batch), equal_nan=True)
        except Exception as error:  # torch documents no exception classes for tracing
            line = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise ExportError(
                f"{what}: its step cannot be traced for any number of rows ({line}); take sizes"
                " from `x.shape`, and write it with operations on tensors alone"
            ) from None
    return graph


class ScriptedModel(LoadedExport):
    """Loaded TorchScript module, evaluated with a batch size of one."""

    # the module runs the operations of the model in torch, in the same order
    reorders_sums = False

    def __init__(self, module: Any, dtype: torch.dtype) -> None:
        self.module = module
        self.dtype = dtype

    def _to_tensors(self, arrays: tuple[NumberArray, ...]) -> list[Tensor]:
        return [torch.as_tensor(array).to(self.dtype).unsqueeze(0) for array in arrays]

    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        with torch.no_grad():
            return tuple(
                output[0].numpy() for output in self.module(*self._to_tensors(step_arguments))
            )

    def initial_memory(self, *warmup_arguments: NumberArray) -> NumberArray | None:
        """Return the memory after a measured past.

        Args:
            warmup_arguments: for a vessel the measured states [T, nx] and inputs [T, m], for a
                controller the first measurement alone.
        """
        make_memory = self.module.warmup if len(warmup_arguments) > 1 else self.module.initial_state
        with torch.no_grad():
            initial_memory: NumberArray = make_memory(*self._to_tensors(warmup_arguments))[
                0
            ].numpy()
        return initial_memory

    def rollout(self, *rollout_arguments: NumberArray) -> NumberArray | None:
        with torch.no_grad():
            states: NumberArray = self.module.rollout(*self._to_tensors(rollout_arguments))[0][
                0
            ].numpy()
        return states


@final
class TorchScriptExporter(Exporter):
    """One file that a controller loads with torch alone."""

    name: ClassVar[str] = "torchscript"
    suffix: ClassVar[str] = ".pt"
    about: ClassVar[str] = "The model as TorchScript, which Python and C++ run with torch alone."

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        exported.require_finite_numbers()
        dtype = exported.precisions[0]
        module = exported.build_module(dtype)
        # with the optimisation of the executor switched off, freezing would lose the methods
        with warnings.catch_warnings(), optimized_execution(True):
            # TorchScript works in torch 2.13 but is deprecated; only this module depends on it
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", message=".*torch.jit.*")
            scripted = torch.jit.freeze(
                torch.jit.script(module), preserved_attrs=list(exported.methods)
            )
            for method in exported.methods:
                # with the settings for a fast first call the executor does not optimise graphs at
                # run time; optimise them here instead
                graph = scripted._c._get_method(method).graph
                passes = torch._C
                passes._jit_pass_inline(graph)
                # each round enables further simplifications in the next one
                for _ in range(3):
                    passes._jit_pass_constant_propagation(graph)
                    passes._jit_pass_peephole(graph)
                    passes._jit_pass_cse(graph)
                    passes._jit_pass_dce(graph)
            # the parity check uses a saved and reloaded module; the file also has a model card
            reloaded = ScriptedModel(torch.jit.load(io.BytesIO(_serialise(scripted))), dtype)
            with optimized_execution(False):
                parity_entry = {
                    "parity": exported.check_parity(reloaded, "the exported module", dtype)
                }
            card = (
                exported.build_card()
                | _EXECUTOR_SETTINGS
                | {"dtype": get_dtype_name(dtype)}
                | parity_entry
            )
            with atomic_write(file) as temporary_path:
                temporary_path.write_bytes(_serialise(scripted, card))
                torch.jit.load(str(temporary_path))
        return card


def _serialise(scripted: Any, card: Mapping[str, Any] | None = None) -> bytes:
    """Return the bytes of the file of a module.

    They are built in memory, so that a full disk raises an OSError and not an error of PyTorch.
    """
    buffer = io.BytesIO()
    extra_files = {} if card is None else {"card.json": json.dumps(card, indent=1)}
    torch.jit.save(scripted, buffer, _extra_files=extra_files)
    return buffer.getvalue()


class AotiModel(LoadedExport):
    """A compiled package that was written to a file and loaded again."""

    def __init__(self, file: Path, dtype: torch.dtype = torch.float32) -> None:
        self.package: Any = torch._inductor.aoti_load_package(str(file))
        self.dtype = dtype

    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        # the package ignores strides, so that arrays must be contiguous
        tensors = [
            torch.from_numpy(np.ascontiguousarray(array)).to(self.dtype)[None]
            for array in step_arguments
        ]
        return tuple(array[0].numpy() for array in self.package(*tensors))


@final
class AotiExporter(Exporter):
    """An AOTInductor package, which C++ and Python load with libtorch."""

    name: ClassVar[str] = "aoti"
    suffix: ClassVar[str] = ".pt2"
    about: ClassVar[str] = "The model's step compiled for this machine (AOTInductor), one row."

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Compile the function of one time step; write the package and its model card.

        Float64 is used if the simulated trajectory is too sensitive to rounding in float32.
        """
        exported.require_finite_numbers()
        with tempfile.TemporaryDirectory() as folder:
            temporary_path = Path(folder) / "model.pt2"

            def compile_and_check(dtype: torch.dtype) -> dict[str, Any]:
                examples = tuple(
                    torch.zeros(1, n_entries, dtype=dtype) for _, n_entries in exported.arguments
                )
                try:
                    with warnings.catch_warnings(), torch.no_grad():
                        warnings.simplefilter("ignore")
                        program = torch.export.export(exported.build_step_module(dtype), examples)
                        torch._inductor.aoti_compile_and_package(
                            program, package_path=str(temporary_path)
                        )
                except (RuntimeError, OSError) as error:
                    # torch has no exception class for failed compilations
                    error_lines = str(error).strip().splitlines() or [type(error).__name__]
                    raise ExportError(
                        f"{exported.label}: cannot be compiled ahead of time ({error_lines[0]});"
                        f" export it"
                        " as c or torchscript"
                    ) from None
                return exported.check_parity(
                    AotiModel(temporary_path, dtype), "the compiled package", dtype
                )

            dtype, parity = run_in_sufficient_precision(exported, compile_and_check)
            card = exported.build_card() | {
                "format": "aoti",
                "dtype": get_dtype_name(dtype),
                "layout": "Give contiguous tensors: the package does not look at strides.",
                "safety": "The package holds machine code that runs when loaded: load only what"
                " you trust. It is for the kind of machine that it was made on.",
                "needs": "In Python: torch and setuptools, which torch imports to load a package."
                " In C++: libtorch.",
                "parity": parity,
            }
            write_card(file, card)
            file.write_bytes(temporary_path.read_bytes())
        return card
