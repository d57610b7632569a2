"""A plant whose step is recorded once and evaluated as a CasADi function."""

from __future__ import annotations

from typing import Any, final

import torch
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.plant import Plant


@final
class RecordedPlantDynamics(Dynamics):
    """A `PlantDynamics` whose step is recorded as a CasADi function when it is first taken.

    The numbers are the same. For simulation only: it runs without gradients, in float64, at any
    batch size. A plant whose step cannot be recorded is stepped as it is.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt, "rk4")
        self.plant, self.substeps = plant, substeps
        self._plain: PlantDynamics | None = None
        self._one: Any = None
        self._rows: dict[int, tuple[Any, Any]] = {}

    def _recorded(self) -> Any:
        """Return the step of one row; its sub-steps are one function, called again and again."""
        import casadi as ca

        from residnet.engine.trace import in_numbers, lowered

        sizes = [("x", len(self.plant.state_names)), ("w", len(self.plant.input_names))]
        model = PlantDynamics(self.plant, self.dt / self.substeps).eval()
        part = in_numbers(
            lowered(lambda x, w: model.step(x, w, x[:, :0])[0], sizes, ["y"], "plant")
        )
        x, w = (ca.SX.sym(name, size) for name, size in sizes)
        after = x
        for _ in range(self.substeps):
            after = part(after, w)
        return ca.Function("step", [x, w], [after])

    @torch.no_grad()
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        if self._one is None and self._plain is None:
            try:
                self._one = self._recorded()
            except ExportError:
                self._plain = PlantDynamics(self.plant, self.dt, self.substeps)
        if self._plain is not None:
            return self._plain.step(x, w, s)
        if len(x) not in self._rows:
            self._rows[len(x)] = self._one.map(len(x), "serial").buffer()
        buffer, evaluate = self._rows[len(x)]
        after = torch.empty_like(x, dtype=torch.float64, memory_format=torch.contiguous_format)
        # a function of CasADi holds numbers column by column: the rows of a batch are its columns
        given: list[Any] = [part.detach().double().contiguous().numpy() for part in (x, w)]
        taken: Any = after.numpy()
        for place, part in enumerate(given):
            buffer.set_arg(place, memoryview(part))
        buffer.set_res(0, memoryview(taken))
        evaluate()
        return after, s
