"""Accelerations that every log has for itself, beside parameters that all logs share.

A model test is never quite the same vessel twice: trim, rudder zero, carriage and tank leave a
small yaw moment and sway force that differ from log to log. Taken for nothing, they are taken for
properties of the hull. Here each log has its own, growing with the square of the speed as hull
forces do and believed to be normally distributed about zero; Gauss-Newton's matrix is then an arrow
(a block for what is shared, one for each log, nothing between logs), so that logs are eliminated
one by one. Offsets end with the fit: the model is that of a run without, and small manoeuvres of a
run that has one are predicted the worse for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Quantity
from residnet.core.names import ACCELERATION, VELOCITY

# of one estimate of the spread, from one linearisation
_ROUNDS = 200
_SMALLEST = 1e-4

Estimated = Literal["estimated"]


class OffsetsConfig(Config):
    """Settings of offsets: standard deviations of an acceleration from log to log, by axis.

    They hold at the root mean square speed of the free runs; there is no offset where null.

    `estimated` takes the standard deviation under which the training logs are most likely,
    parameters and offsets integrated out (type-II maximum likelihood); it needs about five logs or
    more.

    Attributes:
        u: in surge.
        v: in sway.
        r: in yaw.
    """

    u: Estimated | Annotated[float, Quantity("m/s^2"), Field(gt=0)] | None = None
    v: Estimated | Annotated[float, Quantity("m/s^2"), Field(gt=0)] | None = None
    r: Estimated | Annotated[float, Quantity("rad/s^2"), Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _any(self) -> OffsetsConfig:
        if not self.axes:
            raise ValueError(
                "give a standard deviation, or `estimated`, for at least one of u, v, r; or leave"
                " `offsets` out"
            )
        return self

    @property
    def axes(self) -> tuple[int, ...]:
        """Numbers of the axes that have an offset: surge 0, sway 1, yaw 2."""
        return tuple(axis for axis, name in enumerate(VELOCITY) if getattr(self, name) is not None)

    def given(self) -> tuple[float | None, ...]:
        """Return the standard deviation by axis that has an offset; None where it is estimated."""
        found = [getattr(self, VELOCITY[axis]) for axis in self.axes]
        return tuple(None if value == "estimated" else float(value) for value in found)


@dataclass(frozen=True)
class Offsets:
    """The offsets of L logs in `axes` (a of surge 0, sway 1, yaw 2).

    Attributes:
        axes: that have one.
        value: by log at `speed`, [L, a].
        spread: standard deviation from log to log, [a].
        estimated: which spreads come from the logs, [a].
        error: standard errors [L, a].
        speed: in m/s.
    """

    axes: tuple[int, ...]
    value: Tensor
    spread: Tensor
    estimated: Tensor
    error: Tensor
    speed: float

    @classmethod
    def begin(cls, config: OffsetsConfig | None, logs: int, usual: Tensor, speed: float) -> Offsets:
        """Return offsets that are all zero.

        `usual` [3] is where spreads that are to be estimated start from, `speed` that at which
        offsets are what they are said to be.
        """
        axes, given = (config.axes, config.given()) if config is not None else ((), ())
        spread = torch.tensor(
            [usual[axis] if sd is None else sd for axis, sd in zip(axes, given, strict=True)],
            dtype=torch.float64,
        )
        zero = torch.zeros(logs, len(axes), dtype=torch.float64)
        return cls(
            axes,
            zero,
            spread,
            torch.tensor([sd is None for sd in given], dtype=torch.bool),
            zero,
            speed,
        )

    def moved(self, step: Tensor) -> Offsets:
        """Return the offsets with a step [L, a] subtracted."""
        return replace(self, value=self.value - step)

    def accelerations(self) -> Tensor:
        """Return the accelerations by log, [L, 3]."""
        out = torch.zeros(len(self.value), 3, dtype=torch.float64)
        out[:, list(self.axes)] = self.value
        return out

    def unlikely(self) -> Tensor:
        """Return twice minus the logarithm of their probability density, without its constant."""
        return (self.value / self.spread).square().sum()

    def table(self, logs: Sequence[str]) -> list[dict[str, Any]]:
        """Return a row for each log and axis.

        Columns log, axis, value, standard_error, spread, speed.
        """
        spread = self.spread.tolist()
        return [
            {
                "log": log,
                "axis": ACCELERATION[axis],
                "value": v[i],
                "standard_error": e[i],
                "spread": spread[i],
                "speed": self.speed,
            }
            for log, v, e in zip(logs, self.value.tolist(), self.error.tolist(), strict=True)
            for i, axis in enumerate(self.axes)
        ]


@dataclass(frozen=True)
class Arrow:
    """The normal equations of P shared parameters and of a offsets for each of L logs.

    Attributes:
        shared: [P, P].
        mixed: [L, P, a].
        blocks: of the offsets of each log, [L, a, a].
        gradient: half the cost's, of the shared, [P].
        slope: the same of the offsets, [L, a].
    """

    shared: Tensor
    mixed: Tensor
    blocks: Tensor
    gradient: Tensor
    slope: Tensor

    def believing(self, offsets: Offsets, share: Tensor) -> Arrow:
        """Return the equations with what is believed of the offsets.

        `share` is what one unit of minus the logarithm of a probability costs, halved.
        """
        precision = share / offsets.spread.square()
        return replace(
            self,
            blocks=self.blocks + torch.diag(precision),
            slope=self.slope + precision * offsets.value,
        )

    def damped(self, damping: float) -> Arrow:
        """Return the equations with a share of the diagonal added (Levenberg and Marquardt)."""
        blocks = self.blocks + damping * torch.diag_embed(self.blocks.diagonal(dim1=1, dim2=2))
        return replace(
            self, shared=self.shared + damping * torch.diag(self.shared.diagonal()), blocks=blocks
        )

    def solve(self) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton step of the shared parameters [P] and of the offsets [L, a]."""
        matrix, gradient = self.reduced()
        step = torch.linalg.solve(matrix, gradient)
        return step, torch.linalg.solve(
            self.blocks, (self.slope - step @ self.mixed).unsqueeze(-1)
        ).squeeze(-1)

    def reduced(self) -> tuple[Tensor, Tensor]:
        """Return matrix [P, P] and right side [P] of the shared parameters alone.

        Every log is eliminated (Schur complement).
        """
        taken = torch.linalg.solve(
            self.blocks, torch.cat((self.mixed.transpose(1, 2), self.slope.unsqueeze(-1)), dim=2)
        )
        less = (self.mixed @ taken).sum(0)
        return self.shared - less[:, :-1], self.gradient - less[:, -1]

    def variances(self, shared: Tensor) -> Tensor:
        """Return the diagonal [L, a] of the offsets' blocks of the inverse.

        From that of the shared block [P, P].
        """
        taken = torch.linalg.solve(self.blocks, self.mixed.transpose(1, 2))
        inverse = torch.linalg.inv(self.blocks) + taken @ shared @ taken.transpose(1, 2)
        diagonal: Tensor = inverse.diagonal(dim1=1, dim2=2)
        return diagonal


def with_spread(offsets: Offsets, arrow: Arrow, share: Tensor) -> Offsets:
    """Return offsets with those spreads at their most likely that are to be estimated.

    The free runs are taken for linear around where they are.

    Expectation maximisation: a spread's square is the mean over the logs of the squares of the
    offsets and of their standard errors.

    Args:
        offsets: as they are.
        arrow: normal equations there, without beliefs about the offsets.
        share: what one unit of minus the logarithm of a probability costs, halved.
    """
    if not bool(offsets.estimated.any()):
        return offsets
    least = _SMALLEST * offsets.spread
    for _ in range(_ROUNDS):
        believing = arrow.believing(offsets, share)
        _, step = believing.solve()
        variances = share * believing.variances(
            torch.linalg.pinv(believing.reduced()[0], hermitian=True)
        )
        found = ((offsets.value - step).square() + variances).mean(0).sqrt()
        spread = torch.where(offsets.estimated, torch.maximum(found, least), offsets.spread)
        change = float((spread / offsets.spread - 1.0).abs().max())
        offsets = replace(offsets, spread=spread)
        if change < 1e-3:
            break
    return offsets
