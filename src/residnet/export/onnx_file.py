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
from residnet.core.files import whole
from residnet.export.base import (
    SINGLE,
    Exported,
    Exporter,
    Loaded,
    Numbers,
    RoundingError,
    in_precision,
    name_of,
)

_TOLERANCE = {torch.float32: SINGLE, torch.float64: 1e-7}
"""Largest share of a range; onnxruntime computes sines of doubles to thirteen digits."""


class _Sized(nn.Module):
    """A step without the arguments and results in which there is nothing, which ONNX refuses."""

    def __init__(self, exported: Exported, dtype: torch.dtype) -> None:
        super().__init__()
        self.inner = exported.graph(dtype)
        self.sizes = [count for _, count in exported.arguments]
        self.kept = [exported.results.index(name) for name in _results(exported)]

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        rest = iter(given)
        empty = given[0][:, :0]
        found = self.inner(*(next(rest) if count else empty for count in self.sizes))
        return tuple(found[i] for i in self.kept)


def _results(exported: Exported) -> list[str]:
    """Return the names of the results in which there is something."""
    empty = any(count == 0 for _, count in exported.arguments)
    return [name for name in exported.results if not (empty and name == "s_after")]


class OnnxModel(Loaded):
    """An ONNX file in onnxruntime."""

    def __init__(self, file: Path, exported: Exported) -> None:
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session: Any = runtime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
        double = self.session.get_inputs()[0].type == "tensor(double)"
        self.dtype: Any = np.float64 if double else np.float32
        self.exported = exported

    def step(self, *given: Numbers) -> tuple[Any, ...]:
        return tuple(part[0] for part in self.rows(*(part[None] for part in given)))

    def rows(self, *given: Numbers) -> tuple[Any, ...]:
        exported = self.exported
        whole_ = zip(exported.arguments, given, strict=True)
        fed = {name: np.asarray(part, self.dtype) for (name, count), part in whole_ if count}
        names = _results(exported)
        found = dict(zip(names, self.session.run(names, fed), strict=True))
        return tuple(found.get(name, given[-1]) for name in exported.results)


@final
class OnnxExporter(Exporter):
    """An ONNX file with the state, the inputs and the memory as its inputs."""

    name: ClassVar[str] = "onnx"
    suffix: ClassVar[str] = ".onnx"
    about: ClassVar[str] = "The model's step as ONNX, memory in and out, any number of rows."

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write the graph, its card under the key `card` of the metadata.

        It is in float64 where float32 does not determine the track.
        """
        for package in ("onnx", "onnxscript", "onnxruntime"):
            require_package(package, "format onnx", "export")
        exported.require_numbers()
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder) / file.name
            said: list[str] = []

            def attempt(dtype: torch.dtype) -> dict[str, Any]:
                try:
                    _write(exported, partial, dtype)
                    loaded = OnnxModel(partial, exported)
                    random = np.random.default_rng(0)
                    given = [
                        random.uniform(0.0, 0.1, (3, count)) for _, count in exported.arguments
                    ]
                    together, alone = loaded.rows(*given), Loaded.rows(loaded, *given)
                    pairs = zip(together, alone, strict=True)
                    if not all(np.allclose(*pair, rtol=1e-5, atol=1e-5) for pair in pairs):
                        raise ExportError(
                            f"{exported.what}: the ONNX file gives other answers for several rows"
                            " at once than for each alone"
                        )
                    return exported.check(loaded, "the ONNX file", dtype, _TOLERANCE[dtype])
                except RoundingError as error:
                    said.append(str(error))
                    raise

            states = importlib.import_module("onnxruntime.capi.onnxruntime_pybind11_state")
            try:
                dtype, parity = in_precision(exported, attempt)
            except (states.NotImplemented, states.InvalidGraph) as error:
                lacks = str(error).strip().splitlines()[0]
                raise ExportError(
                    f"{'; '.join([*said, exported.what])}: onnxruntime says: {lacks}; export it as"
                    " c or casadi"
                ) from None
            card = exported.card() | {
                "format": "onnx",
                "dtype": name_of(dtype),
                "safety": "The file holds numbers and operations; onnxruntime runs no code of it.",
                "parity": parity,
            }
            onnx = importlib.import_module("onnx")
            graph = onnx.load(str(partial))
            onnx.helper.set_model_props(graph, {"card": json.dumps(card)})
            with whole(file) as ready:
                onnx.save(graph, str(ready))
        return card


def _write(exported: Exported, file: Path, dtype: torch.dtype) -> None:
    """Write the graph.

    Raises:
        ExportError: where torch cannot express the step in ONNX.
    """
    given = [(name, count) for name, count in exported.arguments if count]
    rows = {0: torch.export.Dim("rows", min=1)}
    table: dict[Any, Any] = {torch.ops.aten.scalar_tensor.default: _scalar}
    if dtype == torch.float64:
        table |= dict.fromkeys(
            (torch.ops.aten.atan2.default, torch.ops.aten.atan.default), _arctangent
        )
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                _Sized(exported, dtype).eval(),
                tuple(torch.zeros(2, count, dtype=dtype) for _, count in given),
                dynamo=True,
                # torch's own folding changes what a step in six degrees of freedom answers
                optimize=False,
                verbose=False,
                input_names=[name for name, _ in given],
                output_names=_results(exported),
                dynamic_shapes=(tuple(rows for _ in given),),
                custom_translation_table=table,
            )
    except torch.onnx.OnnxExporterError as error:
        first = str(error).strip().splitlines()[0]
        raise ExportError(
            f"{exported.what}: ONNX cannot hold its step ({first}); export it as torchscript"
        ) from None
    assert program is not None
    program.save(str(file))


def _scalar(
    s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False
) -> Any:
    """Return a number of a model as a constant; torch's own translation rounds it to float32."""
    ir = importlib.import_module("onnx_ir")
    kind = ir.DataType(dtype if dtype > 0 else ir.DataType.FLOAT)
    return importlib.import_module("onnxscript").opset18.Constant(value=ir.tensor(s, dtype=kind))


def _arctangent(y: Any, x: Any = None) -> Any:
    """Return the angle of doubles, whose arctangent onnxruntime has in single precision alone.

    What is missing then is the angle between the point and the line along which that one leads,
    about 1e-7: its tangent is it to 1e-21.
    """
    ir, op = importlib.import_module("onnx_ir"), importlib.import_module("onnxscript").opset18
    double = ir.DataType.DOUBLE

    def number(value: float) -> Any:
        return op.Constant(value=ir.tensor(value, dtype=double))

    zero, half = number(0.0), number(math.pi)
    x = number(1.0) if x is None else x
    # nothing points ahead, as in torch
    x = op.Where(op.Equal(op.Add(op.Abs(x), op.Abs(y)), zero), number(1.0), x)
    near = op.Cast(op.Atan(op.Cast(op.Div(y, x), to=ir.DataType.FLOAT)), to=double)
    c, s = op.Cos(near), op.Sin(near)
    off = op.Div(op.Sub(op.Mul(y, c), op.Mul(x, s)), op.Add(op.Mul(x, c), op.Mul(y, s)))
    behind = op.Where(op.Less(y, zero), op.Neg(half), half)
    return op.Add(op.Add(near, off), op.Where(op.Less(x, zero), behind, zero))
