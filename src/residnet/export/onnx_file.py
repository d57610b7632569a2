"""The format `onnx`: a step as an ONNX graph, memory in and out, any number of rows."""

from __future__ import annotations

import importlib
import json
import logging
import math
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError, require_package
from residnet.core.files import atomic_write
from residnet.export.base import (
    SINGLE_TOLERANCE,
    Exportable,
    Exporter,
    LoadedExport,
    NumberArray,
    RoundingError,
    get_dtype_name,
    run_in_sufficient_precision,
)

_TOLERANCES = {torch.float32: SINGLE_TOLERANCE, torch.float64: 1e-7}
"""Largest difference relative to the range of a channel in each precision; onnxruntime computes
sines of doubles to thirteen digits only.
"""


class _NonEmptyStep(nn.Module):
    """A step without its empty arguments and results, which ONNX does not support."""

    def __init__(self, exported: Exportable, dtype: torch.dtype) -> None:
        super().__init__()
        self.step_module = exported.build_step_module(dtype)
        self.argument_sizes = [n_entries for _, n_entries in exported.arguments]
        self.result_indices = [
            exported.results.index(name) for name in _non_empty_results(exported)
        ]

    def forward(self, *step_arguments: Tensor) -> tuple[Tensor, ...]:
        remaining = iter(step_arguments)
        empty_argument = step_arguments[0][:, :0]
        results = self.step_module(
            *(next(remaining) if n_entries else empty_argument for n_entries in self.argument_sizes)
        )
        return tuple(results[i] for i in self.result_indices)


def _non_empty_results(exported: Exportable) -> list[str]:
    """Return the results of the ONNX graph: without the memory of a model that has none."""
    has_empty_argument = any(n_entries == 0 for _, n_entries in exported.arguments)
    return [name for name in exported.results if not (has_empty_argument and name == "s_after")]


class OnnxModel(LoadedExport):
    """An ONNX file in onnxruntime."""

    def __init__(self, file: Path, exported: Exportable) -> None:
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session: Any = runtime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
        is_double = self.session.get_inputs()[0].type == "tensor(double)"
        self.dtype: Any = np.float64 if is_double else np.float32
        self.exported = exported

    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        return tuple(part[0] for part in self.step_rows(*(part[None] for part in step_arguments)))

    def step_rows(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        exported = self.exported
        named_arguments = zip(exported.arguments, step_arguments, strict=True)
        inputs = {
            name: np.asarray(array, self.dtype)
            for (name, n_entries), array in named_arguments
            if n_entries
        }
        names = _non_empty_results(exported)
        results_by_name = dict(zip(names, self.session.run(names, inputs), strict=True))
        return tuple(results_by_name.get(name, step_arguments[-1]) for name in exported.results)


@final
class OnnxExporter(Exporter):
    """An ONNX file with the state, the inputs and the memory as its inputs."""

    name: ClassVar[str] = "onnx"
    suffix: ClassVar[str] = ".onnx"
    about: ClassVar[str] = "The model's step as ONNX, memory in and out, any number of rows."

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the graph, its model card under the key `card` of the metadata.

        It is in float64 if rounding in float32 changes the track.
        """
        for package in ("onnx", "onnxscript", "onnxruntime"):
            require_package(package, "format onnx", "export")
        exported.require_finite_numbers()
        with tempfile.TemporaryDirectory() as folder:
            temporary_path = Path(folder) / file.name
            messages: list[str] = []

            def write_and_check(dtype: torch.dtype) -> dict[str, Any]:
                try:
                    _write_graph(exported, temporary_path, dtype)
                    loaded = OnnxModel(temporary_path, exported)
                    generator = np.random.default_rng(0)
                    example_arguments = [
                        generator.uniform(0.0, 0.1, (3, n_entries))
                        for _, n_entries in exported.arguments
                    ]
                    batch_results = loaded.step_rows(*example_arguments)
                    row_results = LoadedExport.step_rows(loaded, *example_arguments)
                    pairs = zip(batch_results, row_results, strict=True)
                    if not all(np.allclose(*pair, rtol=1e-5, atol=1e-5) for pair in pairs):
                        raise ExportError(
                            f"{exported.label}: the ONNX file has other results for several rows"
                            " than for single rows"
                        )
                    return exported.check_parity(loaded, "the ONNX file", dtype, _TOLERANCES[dtype])
                except RoundingError as error:
                    messages.append(str(error))
                    raise

            runtime_errors = importlib.import_module("onnxruntime.capi.onnxruntime_pybind11_state")
            try:
                dtype, parity = run_in_sufficient_precision(exported, write_and_check)
            except (runtime_errors.NotImplemented, runtime_errors.InvalidGraph) as error:
                error_line = str(error).strip().splitlines()[0]
                raise ExportError(
                    f"{'; '.join([*messages, exported.label])}: onnxruntime says: {error_line};"
                    f" export it as"
                    " c or casadi"
                ) from None
            card = exported.build_card() | {
                "format": "onnx",
                "dtype": get_dtype_name(dtype),
                "safety": "The file holds numbers and operations; onnxruntime runs no code of it.",
                "parity": parity,
            }
            onnx = importlib.import_module("onnx")
            graph = onnx.load(str(temporary_path))
            onnx.helper.set_model_props(graph, {"card": json.dumps(card)})
            with atomic_write(file) as final_path:
                onnx.save(graph, str(final_path))
        return card


def _write_graph(exported: Exportable, file: Path, dtype: torch.dtype) -> None:
    """Write the graph.

    Raises:
        ExportError: if torch cannot express the step in ONNX.
    """
    inputs = [(name, n_entries) for name, n_entries in exported.arguments if n_entries]
    dynamic_rows = {0: torch.export.Dim("rows", min=1)}
    translation_table: dict[Any, Any] = {torch.ops.aten.scalar_tensor.default: _translate_scalar}
    if dtype == torch.float64:
        translation_table |= dict.fromkeys(
            (torch.ops.aten.atan2.default, torch.ops.aten.atan.default), _translate_arctangent
        )
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                _NonEmptyStep(exported, dtype).eval(),
                tuple(torch.zeros(2, n_entries, dtype=dtype) for _, n_entries in inputs),
                dynamo=True,
                # constant folding by torch changes the results of steps in six degrees of freedom
                optimize=False,
                verbose=False,
                input_names=[name for name, _ in inputs],
                output_names=_non_empty_results(exported),
                dynamic_shapes=(tuple(dynamic_rows for _ in inputs),),
                custom_translation_table=translation_table,
            )
    except torch.onnx.OnnxExporterError as error:
        first_line = str(error).strip().splitlines()[0]
        raise ExportError(
            f"{exported.label}: ONNX cannot hold its step ({first_line}); export it as torchscript"
        ) from None
    assert program is not None
    program.save(str(file))


def _translate_scalar(
    s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False
) -> Any:
    """Return a number of a model as a constant; torch's own translation rounds it to float32."""
    ir = importlib.import_module("onnx_ir")
    data_type = ir.DataType(dtype if dtype > 0 else ir.DataType.FLOAT)
    return importlib.import_module("onnxscript").opset18.Constant(
        value=ir.tensor(s, dtype=data_type)
    )


def _translate_arctangent(y: Any, x: Any = None) -> Any:
    """Return atan2 in double precision; onnxruntime implements atan in single precision only.

    The single-precision angle is refined by the angle between the point and the direction of that
    angle. The correction is about 1e-7 and equals its tangent to within 1e-21.
    """
    ir, op = importlib.import_module("onnx_ir"), importlib.import_module("onnxscript").opset18
    double_type = ir.DataType.DOUBLE

    def make_constant(value: float) -> Any:
        return op.Constant(value=ir.tensor(value, dtype=double_type))

    zero = make_constant(0.0)
    pi = make_constant(math.pi)
    x = make_constant(1.0) if x is None else x
    # the angle of the zero vector is zero, as in torch
    x = op.Where(op.Equal(op.Add(op.Abs(x), op.Abs(y)), zero), make_constant(1.0), x)
    single_precision_angle = op.Cast(
        op.Atan(op.Cast(op.Div(y, x), to=ir.DataType.FLOAT)), to=double_type
    )
    cos_angle = op.Cos(single_precision_angle)
    sin_angle = op.Sin(single_precision_angle)
    correction = op.Div(
        op.Sub(op.Mul(y, cos_angle), op.Mul(x, sin_angle)),
        op.Add(op.Mul(x, cos_angle), op.Mul(y, sin_angle)),
    )
    half_turn = op.Where(op.Less(y, zero), op.Neg(pi), pi)
    return op.Add(
        op.Add(single_precision_angle, correction), op.Where(op.Less(x, zero), half_turn, zero)
    )
