"""Where sanity is checked: operating points in straight running, and mirrored pairs of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from residnet.core.layout import PLANAR, RANGE_INPUTS, RANGE_VELOCITIES, SURGE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.physics.environment.wind import WIND_INPUTS

_SETTLE = 10.0
_FRACTIONS = (0.0, 0.25, 0.5, 0.67, 1.0, 1.5)
_CRUISE = 0.67


@dataclass(frozen=True)
class OperatingPoint:
    """A point of straight running at a speed: state x [6], inputs w [m].

    `inside` says whether both lie within the training ranges.
    """

    label: str
    speed: float
    x: Tensor
    w: Tensor
    inside: bool

    @property
    def text(self) -> str:
        """The point as words of a sentence: drive, surge velocity and whether it was trained on."""
        name = f"{self.label}, " if self.label else ""
        return f"{name}u = {self.speed:.3g} m/s" + (
            "" if self.inside else " (outside the training data)"
        )


def settled_memory(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return the memory [B, n_state] after ten seconds in the same state and inputs.

    States x [B, 6], inputs w [B, m].
    """
    steps = max(round(_SETTLE / model.dt), 1) if model.n_state else 0
    return model.warmup(x[:, None].expand(-1, steps, -1), w[:, None].expand(-1, steps, -1))


def acceleration(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return nu_dot [B, 3] of baseline and head together, the head's memory settled.

    States x [B, 6], inputs w [B, m].
    """
    z = model.channels(x, w)
    rho, _ = model.head(z, settled_memory(model, x, w))
    out: Tensor = model.head.accelerations(model.baseline(z), rho)
    return out


def steering(columns: Sequence[str]) -> tuple[list[int], list[tuple[int, int]]]:
    """Return columns of rudders, and pairs (port, starboard) of columns.

    In a mirror the former change sign and the latter change places.
    """
    names = list(columns)
    rudders = [i for i, name in enumerate(names) if name == "delta"]
    pairs = [
        (i, names.index(name[:-5] + "_stbd"))
        for i, name in enumerate(names)
        if name.endswith("_port") and name[:-5] + "_stbd" in names
    ]
    return rudders, pairs


def operating_points(spec: ModelSpec, model: HybridDynamics) -> list[OperatingPoint]:
    """Return points of straight running from rest to beyond the training data's speeds.

    The fastest is half as fast again; each is under the drive that nearly holds the speed.

    Drives are all inputs that do not steer, moved together from the low to the high end of their
    ranges; rudders are amidships and the air is calm, as far as the ranges allow.
    """
    top = max(spec.high[0], 1e-6)
    drives = _drives(spec)
    out = []
    for fraction in _FRACTIONS:
        speed = fraction * top
        x = torch.zeros(len(drives), len(PLANAR.names), dtype=torch.float64)
        x[:, SURGE] = speed
        with torch.no_grad():
            surge = acceleration(model, x, drives)[:, 0]
        best = int(surge.abs().argmin())
        label = {0.0: "rest", _CRUISE: "cruise"}.get(fraction, "")
        out.append(
            OperatingPoint(
                label, speed, x[best], drives[best], spec.low[0] <= speed <= spec.high[0]
            )
        )
    return out


def _drives(spec: ModelSpec, count: int = 41) -> Tensor:
    """Inputs [count, m] of straight running, from the least to the most drive."""
    columns = spec.signals.columns
    low, high = (
        torch.tensor(spec.low[RANGE_INPUTS], dtype=torch.float64),
        torch.tensor(spec.high[RANGE_INPUTS], dtype=torch.float64),
    )
    rudders, pairs = steering(columns)
    for port, stbd in pairs:
        # both sides alike, over the range that they share
        low[[port, stbd]] = torch.maximum(low[port], low[stbd])
        high[[port, stbd]] = torch.minimum(high[port], high[stbd])
    still = [*rudders, *(i for i, name in enumerate(columns) if name in WIND_INPUTS)]
    amount = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None]
    w = low + amount * (high - low)
    w[:, still] = torch.zeros(len(still), dtype=torch.float64).clamp(low[still], high[still])
    return w


@dataclass(frozen=True)
class Mirror:
    """A reflection in the vessel's plane of symmetry.

    Rudders change sign, port and starboard change places, wind comes from the other side.
    """

    columns: tuple[str, ...]
    rudders: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, columns: Sequence[str]) -> Mirror | None:
        """Return the reflection of inputs `columns`; None where it is not known.

        That is where none of them is known to steer, or a lone port or starboard input has no
        partner.
        """
        rudders, pairs = steering(columns)
        paired = {i for pair in pairs for i in pair}
        lone = [
            name
            for i, name in enumerate(columns)
            if name.endswith(("_port", "_stbd")) and i not in paired
        ]
        if lone or not (rudders or pairs):
            return None
        return cls(tuple(columns), tuple(rudders), tuple(pairs))

    def state(self, x: Tensor) -> Tensor:
        """Return mirrored states [B, 6]."""
        return x * torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0, -1.0], dtype=x.dtype)

    def inputs(self, w: Tensor) -> Tensor:
        """Return mirrored inputs [B, m]."""
        out = w.clone()
        for i in self.rudders:
            out[:, i] = -w[:, i]
        for port, stbd in self.pairs:
            out[:, port], out[:, stbd] = w[:, stbd], w[:, port]
        if "wind_dir" in self.columns:
            i = self.columns.index("wind_dir")
            out[:, i] = -w[:, i]
        return out

    def draw(self, spec: ModelSpec, count: int) -> tuple[Tensor, Tensor]:
        """Draw states [count, 6] and inputs [count, m] whose mirror images are in the ranges too.

        They are uniform over that part of the training ranges.
        """
        low, high = list(spec.low), list(spec.high)
        for i in (1, 2, *(PLANAR.dof + k for k in self.rudders)):
            high[i] = max(min(-low[i], high[i]), 0.0)
            low[i] = -high[i]
        for port, stbd in self.pairs:
            port, stbd = PLANAR.dof + port, PLANAR.dof + stbd
            ends = max(low[port], low[stbd]), min(high[port], high[stbd])
            for i in (port, stbd):
                low[i], high[i] = ends
        low_t, high_t = (
            torch.tensor(low, dtype=torch.float64),
            torch.tensor(high, dtype=torch.float64),
        )
        share = torch.rand(
            count, len(low), generator=torch.Generator().manual_seed(0), dtype=torch.float64
        )
        values = low_t + share * (high_t - low_t)
        x = torch.cat(
            (
                torch.zeros(count, len(PLANAR.pose), dtype=torch.float64),
                values[:, RANGE_VELOCITIES],
            ),
            dim=1,
        )
        return x, values[:, RANGE_INPUTS]
