"""The format `onnx`: the model's step as an ONNX graph, memory in and out, any number of rows."""

from __future__ import annotations

import copy
import importlib
import json
import logging
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export import contract
from residnet.export.base import Exporter
from residnet.export.card import make_card
from residnet.export.contract import (
    Apart,
    Numbers,
    accepted,
    checked,
    require_numbers,
    require_tracks,
    warmed,
)
from residnet.export.packages import require_package
from residnet.export.stepping import Step, StepWithoutMemory

_INPUTS, _OUTPUTS = ("x", "w", "s"), ("x_after", "s_after", "outside")
# onnxruntime computes sines of doubles to thirteen digits
_DOUBLE = 1e-7


class OnnxModel:
    """An ONNX file in onnxruntime, for one vessel."""

    def __init__(self, file: Path, spec: ModelSpec, model: HybridDynamics) -> None:
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session: Any = runtime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
        double = self.session.get_inputs()[0].type == "tensor(double)"
        self.dtype: Any = np.float64 if double else np.float32
        self.memory = model.n_state
        self.measured = accepted(spec, model)

    def step(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, bool]:
        """Return state, memory and flag one step later."""
        after, memory, outside = self.rows(x[None], w[None], s[None])
        return after[0], memory[0], bool(outside[0])

    def rows(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Return states [B, 6], memories [B, n_state] and flags [B] one step later."""
        given = {"x": np.asarray(x, self.dtype), "w": np.asarray(w, self.dtype)}
        if self.memory == 0:
            after, outside = self.session.run(["x_after", "outside"], given)
            return after, np.asarray(s, self.dtype), outside
        after, memory, outside = self.session.run(
            list(_OUTPUTS), given | {"s": np.asarray(s, self.dtype)}
        )
        return after, memory, outside

    def warmup(self, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory that a measured past leaves."""
        return warmed(self.measured, self.step, y, w, np.zeros(self.memory, self.dtype))


@final
class OnnxExporter(Exporter):
    """An ONNX file with the state, the inputs and the memory as its inputs."""

    name: ClassVar[str] = "onnx"
    suffix: ClassVar[str] = ".onnx"
    about: ClassVar[str] = "The model's step as ONNX, memory in and out, any number of rows."

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the model, its card under the key `card` of the metadata.

        It is in float64 where float32 does not determine the track.
        """
        for package in ("onnx", "onnxscript", "onnxruntime"):
            require_package(package, "format onnx")
        require_numbers(spec, model)
        model = copy.deepcopy(model).eval().requires_grad_(False)
        card = make_card(spec, model, rows, {}) | {
            "format": "onnx",
            "safety": "The file holds numbers and operations; onnxruntime runs no code of it.",
        }
        with tempfile.TemporaryDirectory() as name:
            partial = Path(name) / file.name
            try:
                parity = _checked(spec, copy.deepcopy(model).float(), partial, torch.float32)
            except Apart as error:
                parity = _in_double(spec, model, partial, error)
                card |= {"dtype": "float64"}
            card |= {"parity": parity}
            onnx = importlib.import_module("onnx")
            graph = onnx.load(str(partial))
            onnx.helper.set_model_props(graph, {"card": json.dumps(card)})
            file.parent.mkdir(parents=True, exist_ok=True)
            ready = file.with_name(file.name + ".partial")
            onnx.save(graph, str(ready))
            ready.replace(file)
        return card


def _checked(
    spec: ModelSpec, model: HybridDynamics, file: Path, dtype: torch.dtype
) -> dict[str, Any]:
    """Write the graph in a precision and return what a card says of its parity.

    Raises:
        Apart: where the precision does not determine the track.
        ExportError: where the graph is wrong otherwise.
    """
    _write(spec, model, file, dtype)
    stepped = OnnxModel(file, spec, model)
    tolerance = _DOUBLE if dtype == torch.float64 else contract.SINGLE
    found = checked(spec, model, stepped, "the ONNX file", dtype, tolerance)
    _require_rows(stepped, spec, model)
    # onnxruntime adds up in another order than torch, which shows in double precision too
    require_tracks(spec, model, stepped.rows, "the ONNX file", dtype, tolerance)
    return found


def _in_double(spec: ModelSpec, model: HybridDynamics, file: Path, single: Apart) -> dict[str, Any]:
    """Write the graph in float64.

    Raises:
        ExportError: where onnxruntime lacks an operation in this precision: then the message is
            that of single precision.
    """
    states = importlib.import_module("onnxruntime.capi.onnxruntime_pybind11_state")
    try:
        return _checked(spec, model.double(), file, torch.float64)
    except (states.NotImplemented, states.InvalidGraph) as error:
        lacks = str(error).strip().splitlines()[0]
        raise ExportError(f"{single}; in double precision onnxruntime says: {lacks}") from None


def _write(spec: ModelSpec, model: HybridDynamics, file: Path, dtype: torch.dtype) -> None:
    """Write the graph; a model without a memory has neither `s` nor `s_after`.

    Raises:
        ExportError: where torch cannot express the model in ONNX.
    """
    kept = slice(None) if model.n_state else slice(0, 2)
    sizes = [len(STATE), len(spec.signals.columns), model.n_state][kept]
    step = Step(model, spec) if model.n_state else StepWithoutMemory(model, spec)
    step = step.to(dtype)
    results = [name for name in _OUTPUTS if model.n_state or name != "s_after"]
    rows = {0: torch.export.Dim("rows", min=1)}
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                step.eval(),
                tuple(torch.zeros(2, size, dtype=dtype) for size in sizes),
                dynamo=True,
                verbose=False,
                input_names=list(_INPUTS[kept]),
                output_names=results,
                dynamic_shapes=tuple(rows for _ in sizes),
                custom_translation_table={torch.ops.aten.scalar_tensor.default: _scalar},
            )
    except torch.onnx.OnnxExporterError as error:
        first = str(error).strip().splitlines()[0]
        raise ExportError(
            f"model {spec.name}: ONNX cannot hold its step ({first}); export it as torchscript"
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


def _require_rows(stepped: OnnxModel, spec: ModelSpec, model: HybridDynamics) -> None:
    """Refuse a graph whose rows disturb each other.

    Raises:
        ExportError: where three rows together differ from each alone.
    """
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    seen = low + torch.rand(3, low.numel(), generator=generator) * (high - low)
    x = torch.cat((torch.zeros(3, 3), seen[:, :3]), dim=1).numpy()
    w, s = seen[:, 3:].numpy(), np.zeros((3, model.n_state))
    together = stepped.rows(x, w, s)[0]
    alone = np.stack([stepped.step(*row)[0] for row in zip(x, w, s, strict=True)])
    if not np.allclose(together, alone, rtol=1e-5, atol=1e-5):
        raise ExportError(
            f"model {spec.name}: the ONNX file gives other states for several rows at once than"
            " for each alone"
        )
