"""The disturbances of a simulated trial: forces, current, wind with gusts, waves."""

from __future__ import annotations

from typing import Annotated, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, MetresPerSecond, NewtonMetres, Newtons, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Source
from residnet.physics.environment import WIND_INPUTS, Waves, WavesConfig
from residnet.physics.plant import Plant


class WindField(Config):
    """Mean wind with gusts.

    The gusts along and across the mean wind are independent Ornstein-Uhlenbeck processes, whose
    one-sided spectrum is the first-order form that Dryden gave the longitudinal turbulence:
    S(omega) = (2 sigma^2 T / pi) / (1 + (omega T)^2).

    Attributes:
        speed: mean true wind speed at the height of the vessel's coefficients.
        direction: where the mean wind comes FROM, clockwise from north.
        gust: standard deviation sigma of each component.
        correlation: time T of the gusts, their length over the mean speed.
    """

    speed: MetresPerSecond = Field(ge=0)
    direction: Radians
    gust: MetresPerSecond = Field(default=0.0, ge=0)
    correlation: Seconds = Field(default=10.0, gt=0)


class Disturbance(Config):
    """Random and constant forces, a constant current, wind and waves.

    Attributes:
        force_x: standard deviation of the random surge force, an Ornstein-Uhlenbeck process, in N.
        force_y: the same of the sway force in N.
        force_n: the same of the yaw moment in N m.
        correlation: correlation time of the three processes in s.
        force_north: constant force towards north in N.
        force_east: constant force towards east in N.
        current_north: current towards north in m/s.
        current_east: current towards east in m/s.
        current_speed: speed of the same current in m/s, given with its direction instead.
        current_direction: where it sets to in rad, clockwise from north.
        current_each: slowest and fastest speed in m/s of a further current that each trial has of
            its own, constant in speed and direction.
        wind: mean wind and gusts, for vessels with wind coefficients.
        waves: first-order wave forces.
    """

    force_x: Newtons = Field(default=0.0, ge=0)
    force_y: Newtons = Field(default=0.0, ge=0)
    force_n: NewtonMetres = Field(default=0.0, ge=0)
    correlation: Seconds = Field(default=5.0, gt=0)
    force_north: Newtons = 0.0
    force_east: Newtons = 0.0
    current_north: MetresPerSecond = 0.0
    current_east: MetresPerSecond = 0.0
    current_speed: MetresPerSecond | None = Field(default=None, ge=0)
    current_direction: Radians | None = None
    current_each: (
        tuple[Annotated[MetresPerSecond, Field(ge=0)], Annotated[MetresPerSecond, Field(ge=0)]]
        | None
    ) = None
    wind: WindField | None = None
    waves: WavesConfig | None = None

    @model_validator(mode="after")
    def _one_current(self) -> Disturbance:
        if (self.current_speed is None) != (self.current_direction is None):
            raise ValueError(
                "current_speed and current_direction belong together; give both, or current_north"
                " and current_east"
            )
        if self.current_speed is not None and (self.current_north or self.current_east):
            raise ValueError(
                "the current is given twice; give current_speed and current_direction, or"
                " current_north and current_east"
            )
        if self.current_each is not None and self.current_each[0] > self.current_each[1]:
            raise ValueError(
                f"current_each: the slowest ({self.current_each[0]:g} m/s) is faster than the"
                f" fastest ({self.current_each[1]:g} m/s)"
            )
        return self

    def currents(self, rows: int, seed: int) -> np.ndarray:
        """Return the current of each trial towards north and east in m/s, [B, 2]."""
        out = np.tile(self.current(), (rows, 1))
        if self.current_each is not None:
            random = np.random.default_rng([seed, 7])
            speed, direction = (
                random.uniform(*self.current_each, rows),
                random.uniform(0.0, 2.0 * np.pi, rows),
            )
            out += speed[:, None] * np.stack((np.cos(direction), np.sin(direction)), axis=1)
        return out

    def current(self) -> tuple[float, float]:
        """Return the current of all trials towards north and east in m/s."""
        if self.current_speed is None or self.current_direction is None:
            return self.current_north, self.current_east
        return self.current_speed * float(
            np.cos(self.current_direction)
        ), self.current_speed * float(np.sin(self.current_direction))

    @property
    def logged(self) -> tuple[str, ...]:
        """Inputs of the plant that a vessel measures: the true wind, where there is any."""
        return WIND_INPUTS if self.wind is not None else ()

    def needs(self) -> dict[str, str]:
        """Return the inputs that a plant must have for this disturbance, each with its key."""
        north, east = self.current()
        requested = {
            "force_x": self.force_x != 0, "force_y": self.force_y != 0,
            "force_n": self.force_n != 0,
            "force_north": self.force_north != 0, "force_east": self.force_east != 0,
            "current_north": north != 0 or self.current_each is not None,
            "current_east": east != 0 or self.current_each is not None,
        }  # fmt: skip
        needs = {name: name for name, is_needed in requested.items() if is_needed}
        needs |= dict.fromkeys(WIND_INPUTS, "wind") if self.wind is not None else {}
        return needs | (
            dict.fromkeys(("force_x", "force_y", "force_n"), "waves")
            if self.waves is not None
            else {}
        )

    def check(self, plant: Plant, vessel: str) -> None:
        """Stop where a plant cannot feel this disturbance.

        Raises:
            ConfigError: naming the key and what the vessel lacks.
        """
        for name, key in self.needs().items():
            if name not in plant.inputs:
                hint = "; give its vessel file a section 'wind'" if key == "wind" else ""
                raise ConfigError(
                    f"disturbance.{key}: vessel '{vessel}' has no input '{name}'{hint}; it has"
                    f" {', '.join(plant.inputs)}"
                )
        if self.waves is not None and not {"x", "y", "psi"} <= set(plant.state):
            raise ConfigError(
                f"disturbance.waves: vessel '{vessel}' has no position in its state; waves need x,"
                " y, psi"
            )

    def series(
        self,
        plant: Plant,
        rows: int,
        steps: int,
        step: float,
        seed: int,
        random: np.random.Generator,
    ) -> np.ndarray:
        """Return the inputs of the plant [B, T, m], of all that does not depend on its place.

        The commands are zero.

        The random forces are drawn from `random` (three values per step whatever their sizes, so
        that data of one seed stay the same), the gusts from generators of their own under `seed`.
        """
        forces = ornstein_uhlenbeck(random, (rows, steps, 3), step, self.correlation) * [
            self.force_x,
            self.force_y,
            self.force_n,
        ]
        values: dict[str, np.ndarray | float] = {
            name: forces[:, :, j] for j, name in enumerate(("force_x", "force_y", "force_n"))
        }
        values["current_north"], values["current_east"] = self.currents(rows, seed).T[:, :, None]
        values |= {"force_north": self.force_north, "force_east": self.force_east}
        if self.wind is not None:
            values |= dict(
                zip(
                    WIND_INPUTS,
                    gusty_wind(self.wind, rows, steps, step, np.random.default_rng([seed, 4])),
                    strict=True,
                )
            )
        w = np.zeros((rows, steps, len(plant.inputs)))
        for j, name in enumerate(plant.inputs):
            if name in values:
                w[:, :, j] = values[name]
        return w

    def surround(self, source: Source, plant: Plant, rows: int, step: float, seed: int) -> Source:
        """Return a source with the waves added to its inputs; the same one in calm water."""
        if self.waves is None:
            return source
        return Seaway(source, self.waves.build(rows, np.random.default_rng([seed, 5])), plant, step)


@final
class Seaway(Source):
    """A source that adds the waves' forces to the inputs of another source.

    They are those at the vessel's place at the start of each step, held over it.
    """

    def __init__(self, source: Source, waves: Waves, plant: Plant, step: float) -> None:
        super().__init__()
        self.source = source
        self.waves = waves
        self.step = step
        self.may_stop = source.may_stop
        self.place = [plant.state.index(name) for name in ("x", "y", "psi")]
        axes = ("force_x", "force_y", "force_k", "force_n")
        present = [name for name in axes if name in plant.inputs]
        spread = torch.zeros(len(axes), len(plant.inputs), dtype=torch.float64)
        for name in present:
            spread[axes.index(name), plant.inputs.index(name)] = 1.0
        self.register_buffer("spread", spread, persistent=False)
        self.spread: Tensor

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory of the source inside."""
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the force of the waves at the time of step k."""
        acting, memory = self.source(x, w, k, memory)
        force = self.waves(
            x[:, self.place[0]], x[:, self.place[1]], x[:, self.place[2]], k * self.step
        )
        return acting + (force @ self.spread).to(acting.dtype), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that the source inside stops."""
        return self.source.finished(x, k, memory)


def ornstein_uhlenbeck(
    random: np.random.Generator, shape: tuple[int, int, int], step: float, correlation: float
) -> np.ndarray:
    """Return stationary first-order processes [B, T, k] of unit variance.

    They run along T and are discretised exactly.
    """
    from scipy.signal import lfilter

    keep = np.exp(-step / correlation)
    drive = random.standard_normal(shape) * np.sqrt(1 - keep**2)
    drive[:, 0] /= np.sqrt(1 - keep**2)
    out: np.ndarray = lfilter([1.0], [1.0, -keep], drive, axis=1)
    return out


def gusty_wind(
    wind: WindField, rows: int, steps: int, step: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed [B, T] in m/s and direction [B, T] in rad of the wind with gusts.

    The direction is where it comes from.
    """
    gust = wind.gust * ornstein_uhlenbeck(random, (rows, steps, 2), step, wind.correlation)
    along = wind.speed + gust[:, :, 0]
    return np.hypot(along, gust[:, :, 1]), wind.direction + np.arctan2(gust[:, :, 1], along)
