"""Plants as `Dynamics`, the truth of simulated trials; a current."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant

MOST_STEPS = 2_000_000
"""Steps of the longest simulation: more than two days at ten steps a second."""


def check_steps(duration: float, step: float, what: str = "duration") -> None:
    """Refuse a simulation of so many steps that it can only be a slip.

    Args:
        duration: of the simulation in s.
        step: of the simulation in s.
        what: name of the duration in the message.

    Raises:
        ValueError: where there are more steps than `MOST_STEPS`.
    """
    count = duration / step
    if count > MOST_STEPS:
        raise ValueError(
            f"{what} of {duration:g} s has {count:.3g} steps of {step:g} s; at most {MOST_STEPS:,}"
            " are simulated: shorten it or take a larger step"
        )


@final
class PlantDynamics(Dynamics):
    """A plant stepped by RK4 with held actuators, which move afterwards.

    This is the order of the golden runs.

    A step of the log may hold several sub-steps of the plant: inputs are held over all of them.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt / substeps, "rk4")
        self.turn_about(plant.attitude_columns, len(plant.state_names))
        self.plant = plant
        self.substeps = substeps

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant; a plant has no residual.

        A step holds p = prepare(x, w).
        """
        return self.plant.derivative_prepared(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        for _ in range(self.substeps):
            x = self.plant.finish_step(self.integrate(x, self.plant.prepare(x, w), s), w, self.dt)
        return x, s


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

        from residnet.dynamics.lowering import in_numbers, lowered

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


@final
class InAmbientCurrent(Dynamics):
    """A model in an ambient current that is steady and each row's own.

    u and v are velocities through the water, x and y the place over ground.

    In a current that is the same everywhere and always, a vessel moves through the water as it does
    in water at rest (T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control,
    section 8.3, irrotational ocean currents); only its position is carried away. Memory s [B, 2 +
    k]: current to the north and to the east in m/s, then the model's.

    Args:
        model: whose steps do not depend on the position.
        state: names of its state.
    """

    def __init__(self, model: Dynamics, state: Sequence[str]) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state = 2 + model.n_state
        places = torch.zeros(2, len(state), dtype=torch.float64)
        places[0, state.index("x")] = places[1, state.index("y")] = 1.0
        self.places = nn.Buffer(places, persistent=False)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        moved, memory = self.model.step(x, w, s[:, 2:])
        return moved + self.dt * s[:, :2] @ self.places.to(x.dtype), torch.cat(
            (s[:, :2], memory), dim=-1
        )
