"""A plant whose step is traced once and evaluated as a CasADi function."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, final

import torch
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.structure import hash_structure
from residnet.physics.plant import Plant

_MAX_CACHED_STEPS = 64
"""Largest number of traced steps in the cache."""
# traced steps by plant and time step: tracing takes as long as the simulation of many seconds
_cached_steps: OrderedDict[bytes, Any] = OrderedDict()


@final
class RecordedPlantDynamics(Dynamics):
    """A `PlantDynamics` whose step is traced to a CasADi function at the first call.

    It is for simulation only: it runs without gradients in float64, and the result of a row does
    not depend on the batch size. A plant whose step cannot be traced runs in torch.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt, "rk4")
        # torch sees no operation of CasADi: a trace would contain the results of the examples
        self.export_error = "its step is evaluated by CasADi"
        self.plant = plant
        self.substeps = substeps
        self._torch_plant: PlantDynamics | None = None
        self._row_function: Any = None
        # CasADi buffers and evaluators by number of rows
        self._evaluators: dict[int, tuple[Any, Any]] = {}

    # a free run without gradients is in inference mode, whose operations and tensors are others
    @torch.inference_mode(False)
    def _prepare(self) -> None:
        """Trace the step, or build the plant in torch if that is impossible."""
        try:
            self._row_function = self._find_row_function()
        except ExportError:
            self._torch_plant = PlantDynamics(self.plant, self.dt, self.substeps)

    def _find_row_function(self) -> Any:
        """Return the traced step of one row, from the cache if an equal plant was traced."""
        key = hash_structure((self.plant, self.dt, self.substeps))
        if key is None:
            return self._trace_row()
        if key not in _cached_steps:
            _cached_steps[key] = self._trace_row()
            if len(_cached_steps) > _MAX_CACHED_STEPS:
                _cached_steps.popitem(last=False)
        _cached_steps.move_to_end(key)
        return _cached_steps[key]

    def _trace_row(self) -> Any:
        """Return the step of one row as a CasADi function, which calls one traced sub-step."""
        import casadi as ca

        from residnet.engine.lowering import lower, to_scalar_function

        sizes = [("x", len(self.plant.state_names)), ("w", len(self.plant.input_names))]
        model = PlantDynamics(self.plant, self.dt / self.substeps).eval()
        substep = to_scalar_function(
            lower(lambda x, w: model.step(x, w, x[:, :0])[0], sizes, ["y"], "plant")
        )
        x, w = (ca.SX.sym(name, size) for name, size in sizes)
        next_state = x
        for _ in range(self.substeps):
            next_state = substep(next_state, w)
        return ca.Function("step", [x, w], [next_state])

    @torch.no_grad()
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        if self._row_function is None and self._torch_plant is None:
            self._prepare()
        if self._torch_plant is not None:
            return self._torch_plant.step(x, w, s)
        if len(x) not in self._evaluators:
            self._evaluators[len(x)] = self._row_function.map(len(x), "serial").buffer()
        buffer, evaluate = self._evaluators[len(x)]
        next_state = torch.empty_like(x, dtype=torch.float64, memory_format=torch.contiguous_format)
        # CasADi stores matrices by columns: the rows of a batch are columns there
        arguments: list[Any] = [part.detach().double().contiguous().numpy() for part in (x, w)]
        result: Any = next_state.numpy()
        for i, argument in enumerate(arguments):
            # CasADi reads and writes the memory of the tensors directly, without copies
            buffer.set_arg(i, memoryview(argument))
        buffer.set_res(0, memoryview(result))
        evaluate()
        return next_state, s
