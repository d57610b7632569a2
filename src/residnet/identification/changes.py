"""What may have changed on a vessel, around it or in its sensors, and a model with such changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor

from residnet.core.columns import turning
from residnet.core.frames import along_axes, to_body
from residnet.core.layout import ATTITUDE, HEADING, MOVING, SIX, SURGE, SWAY, YAW_RATE
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.physics.signals import SignalsConfig
from residnet.physics.symmetry import live_of

_AXES = {"u": "surge", "v": "sway", "r": "yaw", "p": "roll", "w": "heave", "q": "pitch"}
_TAKEN = {"u": 0.1}
"""Share of a velocity whose absence shows what damps it; all of others."""


@dataclass(frozen=True)
class Change:
    """A change of a vessel, of its commands, of its surroundings or of a sensor.

    Attributes:
        name: short, for tables.
        words: what it is, completing "the logs look as if ...".
        unit: of its size.
        size: of the change; a small one, where its effect is to be computed.
        heavier: share of the size that is added to the inertia of all axes.
        damping: velocity whose damping changes by the size, a share of what the model has; empty
            for none.
        by: what damps it: itself where empty, or an angle that holds it back.
        push: shares of the size that push to north and east.
        gain: number of the input whose gain changes by the size; None for none.
        offset: number of the input that the size is added to; None for none.
        sensor: what a sensor adds: `gyro_scale`, `gyro_offset`, `speed_scale`, `lag`, or
            `current_north`, `current_east` for water that moves; empty for none.
    """

    name: str
    words: str
    unit: str
    size: float
    heavier: float = 0.0
    damping: str = ""
    by: str = ""
    push: tuple[float, float] = (0.0, 0.0)
    gain: int | None = None
    offset: int | None = None
    sensor: str = ""


def causes(signals: SignalsConfig) -> list[Change]:
    """Return the changes that a monitor looks for, given the inputs of a model."""

    def share(name: str, words: str, **what: Any) -> Change:
        return Change(name, words, "share", 0.02, **what)

    units, live = signals.units(), signals.live
    out = [share("mass", "the vessel has become heavier", heavier=1.0)]
    for axis in live.velocities:
        words = f"the damping in {_AXES[axis]} has grown"
        out.append(share(f"damping {_AXES[axis]}", words, damping=axis))
    if live.rolls:
        words = "the vessel has become stiffer in roll"
        out.append(share("restoring", words, damping="p", by="phi"))
    if live.spatial:
        words = "the vessel has become stiffer in pitch"
        out.append(share("restoring pitch", words, damping="q", by="theta"))
    for place, name in enumerate(signals.inputs):
        out.append(share(f"gain {name}", f"{name} has grown stronger than it was", gain=place))
        if units.get(name) == "rad":
            words = f"{name} has an offset"
            out.append(Change(f"offset {name}", words, "rad", 0.01, offset=place))
    gyro = [
        share("gyro scale", "the gyro shows too much", sensor="gyro_scale"),
        Change("gyro offset", "the gyro has an offset", "rad/s", 0.001, sensor="gyro_offset"),
    ]
    speed = share("speed scale", "u and v are shown too large", sensor="speed_scale")
    lag = Change("lag", "velocities come late", "s", 0.1, sensor="lag")
    return [*out, *gyro * live.turns, *[speed] * live.moves, lag]


def surroundings() -> list[Change]:
    """Return what wind and current do, which is no change of the vessel."""
    return [
        Change("current north", "", "m/s", 0.05, sensor="current_north"),
        Change("current east", "", "m/s", 0.05, sensor="current_east"),
        Change("push north", "", "m/s^2", 0.005, push=(1.0, 0.0)),
        Change("push east", "", "m/s^2", 0.005, push=(0.0, 1.0)),
    ]


def shown(sensor: str, x: Tensor, rate: Tensor, size: float) -> Tensor:
    """Return what a sensor adds to states [..., 3 + n] where what moves has the rates [..., n]."""
    out = torch.zeros_like(x)
    if sensor == "gyro_scale":
        out[..., YAW_RATE] = size * x[..., YAW_RATE]
    elif sensor == "gyro_offset":
        out[..., YAW_RATE] = size
    elif sensor == "speed_scale":
        out[..., SURGE : SWAY + 1] = size * x[..., SURGE : SWAY + 1]
    elif sensor == "lag":
        out[..., MOVING] = -size * rate
    elif sensor in ("current_north", "current_east"):
        north = x.new_tensor(size if sensor == "current_north" else 0.0)
        out = out + along_body(x, north, size - north)
    return out


def along_body(x: Tensor, north: Tensor, east: Tensor) -> Tensor:
    """Return a horizontal vector as velocities in states x [..., 3 + n], zero elsewhere."""
    out = torch.zeros_like(x)
    if x.shape[-1] == len(SIX.names):
        parts = along_axes(north, east, x[..., list(ATTITUDE)])
        places = [SURGE, SWAY, SIX.names.index("w")]
    else:
        parts, places = [*to_body(north, east, x[..., HEADING])], [SURGE, SWAY]
    for place, part in zip(places, parts, strict=True):
        out[..., place] = part
    return out


@final
class ChangedDynamics(Dynamics):
    """A model with a change of its own for every block of rows.

    Args:
        changes: C of them; rows [C * B] are blocks of B.
        rows: B.
    """

    def __init__(
        self, model: HybridDynamics, changes: Sequence[Change], rows: int, inputs: int
    ) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state, self.dof, self.rolls = model.n_state, model.dof, model.rolls
        moving = live_of(model.signals.names).moving

        def each(values: Sequence[Sequence[float]]) -> Tensor:
            table = torch.tensor(values, dtype=torch.float64)
            return table.repeat_interleave(rows, dim=0)

        def changed(of: Callable[[Change], int | None]) -> Tensor:
            span = range(inputs)
            return each([[one.size * (of(one) == i) for i in span] for one in changes])

        self.inertia = each([[1.0 + one.size * one.heavier] for one in changes])
        self.push = each([[one.size * axis for axis in one.push] for one in changes])
        self.gain = 1.0 + changed(lambda one: one.gain)
        self.offset = changed(lambda one: one.offset)
        damped = [k for k, one in enumerate(changes) if one.damping]
        self.damps = len(damped) > 0
        self.damped_rows = torch.tensor(damped).repeat_interleave(rows) * rows + torch.arange(
            rows
        ).repeat(len(damped))

        def of_damped(values: Sequence[float], dtype: torch.dtype = torch.float64) -> Tensor:
            return torch.tensor(values, dtype=dtype).repeat_interleave(rows)

        by = [changes[k].by or changes[k].damping for k in damped]
        self.damping = of_damped([moving.index(changes[k].damping) for k in damped], torch.long)
        self.by = of_damped([moving.index(name) for name in by], torch.long)
        self.taken = of_damped([_TAKEN.get(name, 1.0) for name in by])
        self.damped = of_damped([changes[k].size for k in damped])

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        w = w * self.gain + self.offset
        after, memory = self.model.step(x, w, s)
        nu = x[:, MOVING]
        gained = after[:, MOVING] - nu
        if self.damps:
            gained = gained - self._slowed(x, w, s, gained)
        push = along_body(x, *self.push.unbind(1))[:, MOVING]
        moved = nu + gained / self.inertia + self.dt * push
        changed = after.clone()
        if self.model.spatial:
            moved = torch.where(self.model.live > 0.0, moved, after[:, MOVING])
            changed[:, MOVING] = moved
            turn = torch.zeros_like(after)
            rates = [SIX.names.index(name) for name in "pqr"]
            turn[:, ATTITUDE] = 0.5 * self.dt * (changed - after)[:, rates]
            return self.model.moved_on(changed, turn), memory
        # angles follow what their rates have gained over the step
        known = (moved - after[:, MOVING]) @ self.model.known_rates
        angles = after[:, MOVING] + 0.5 * self.dt * known
        changed[:, MOVING] = torch.where(self.model.live > 0.0, moved, angles)
        turned = turning(changed[:, MOVING], self.dof) - turning(after[:, MOVING], self.dof)
        changed[:, HEADING] = after[:, HEADING] + 0.5 * self.dt * turned[:, 0]
        return changed, memory

    def _slowed(self, x: Tensor, w: Tensor, s: Tensor, gained: Tensor) -> Tensor:
        """Return what changed damping takes from the velocities gained over a step [B, n].

        What damps a velocity is what the step lacks without it; of surge only a part is taken away,
        for models that hold near a service speed alone.
        """
        rows, axis, taken = self.damped_rows, self.damping, self.taken.to(x.dtype)
        place = torch.arange(len(rows))
        share = torch.ones(len(rows), self.dof, dtype=x.dtype)
        share[place, self.by] = 1.0 - taken
        still = x[rows].clone()
        still[:, MOVING] = still[:, MOVING] * share
        alone = self.model.step(still, w[rows], s[rows])[0][:, MOVING] - still[:, MOVING]
        out = torch.zeros_like(gained)
        out[rows, axis] = self.damped * (alone[place, axis] - gained[rows, axis]) / taken
        return out
