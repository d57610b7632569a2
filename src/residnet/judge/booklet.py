"""The manoeuvring booklet and the table of indices, with intervals and limits of IMO."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.simulated import Craft, Flight
from residnet.dynamics.actuated import InputShare
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.manoeuvres.indices import IN_LENGTHS, UNITS

SCHEMA = "residnet.booklet/1"
# power of the scale by which Froude's law brings a unit from the model to the ship
_POWER = {"m": 1.0, "s": 0.5, "m/s": 0.5, "rad/s": -0.5, "rad": 0.0, "-": 0.0}


class BookletConfig(Config):
    """A manoeuvring booklet by one of the fit's refitted baselines.

    Parameters are drawn from what the refit leaves open; every draw flies every manoeuvre, and the
    intervals are those of the indices. They know the model's form to be right and speak of nothing
    else, so that they are short where the form is wrong.

    Attributes:
        model: name of the baseline.
        length: of the hull, in the scale of the logs.
        scale: of the ship to what was measured (Froude's law); 1 for the ship itself.
        inputs: of the model, by their share in drive and steer, with limits and rates.
        initial: states (by name) that manoeuvres start from.
        manoeuvres: standard manoeuvres.
        duration: of manoeuvres that give none, or the time after which one has failed.
        repeat: splits whose measured zigzags the model repeats in closed loop, with the rudder
            angles and reversals of each.
        draws: of the parameters.
        level: of the intervals.
        seed: of the draws.
    """

    model: str
    length: Metres = Field(gt=0)
    scale: float = Field(default=1.0, gt=0)
    inputs: dict[str, InputShare]
    initial: dict[str, float | str] = Field(default_factory=dict)
    manoeuvres: tuple[ManoeuvreConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=600.0, gt=0, le=86_400)
    repeat: tuple[str, ...] = ("validation", "test")
    draws: int = Field(default=100, ge=20, le=100_000)
    level: float = Field(default=0.95, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)

    @field_validator("initial")
    @classmethod
    def _units(cls, initial: dict[str, float | str]) -> dict[str, float | str]:
        return {
            name: Quantity(CHANNEL_UNITS.get(name, "-")).convert(value)
            for name, value in initial.items()
        }

    def rudder(self) -> str:
        """Return the input that steers.

        Raises:
            ConfigError: where none or several do.
        """
        steering = [name for name, share in self.inputs.items() if share.steer not in (0, 0.0)]
        if len(steering) != 1:
            raise ConfigError(
                f"booklet.inputs: one input must have a share in steer, given {steering or 'none'}"
            )
        return steering[0]


@dataclass(frozen=True)
class Page:
    """A page of the booklet, for one manoeuvre.

    Attributes:
        name: of it.
        manoeuvre: what was flown.
        flights: with the fitted parameters, then with drawn ones.
        indices: of each flight; empty where it had a fault or diverged.
        limits: of IMO, for the ship.
        measured: the log that was repeated; None for a standard manoeuvre.
        split: of that log.
        found: its indices.
    """

    name: str
    manoeuvre: Manoeuvre
    flights: Sequence[Flight]
    indices: Sequence[Mapping[str, Any]]
    limits: Mapping[str, float]
    measured: Log | None
    split: str
    found: Mapping[str, Any]


def contents(
    model: str, length: float, scale: float, draws: int, level: float, pages: Sequence[Page]
) -> dict[str, Any]:
    """Return the contents of booklet.json, SI and rad, in the scale of the logs.

    `ship` beside an index is its value for the ship.

    Args:
        length: of the hull in the scale of the logs, m.
    """
    rows = [_row(page, length, scale, level) for page in pages]
    used = sorted({name for row in rows for name in row["indices"]})
    about = {
        "schema": SCHEMA,
        "model": model,
        "length": length,
        "scale": scale,
        "draws": draws,
        "level": level,
    }
    return about | {"units": {name: UNITS[name] for name in used}, "pages": rows}


def _row(page: Page, length: float, scale: float, level: float) -> dict[str, Any]:
    names = [
        name
        for name, value in page.indices[0].items()
        if name in UNITS and not isinstance(value, list)
    ]
    indices = {name: _index(page, name, length, scale, level) for name in names}
    return {
        "name": page.name,
        "manoeuvre": page.manoeuvre.kind,
        "demand": page.manoeuvre.model_dump(mode="json"),
        "split": page.split,
        "faults": sum(not found for found in page.indices[1:]),
        "indices": indices,
    }


def _index(page: Page, name: str, length: float, scale: float, level: float) -> dict[str, Any]:
    """`value` of the fitted parameters, `interval` over draws, and what there is of `lengths`,
    `measured`, `difference`, `limit`, `kept`.
    """
    value = float(page.indices[0][name])
    others = np.array([float(found[name]) for found in page.indices[1:] if name in found])
    factor = scale ** _POWER[UNITS[name]]
    out: dict[str, Any] = {"value": value, "ship": factor * value, "draws": int(others.size)}
    if others.size:
        out["interval"] = np.quantile(others, (0.5 - level / 2, 0.5 + level / 2)).tolist()
    if name in IN_LENGTHS:
        out["lengths"] = value / length
    if name in page.found:
        out |= {"measured": float(page.found[name]), "difference": value - float(page.found[name])}
    if name in page.limits:
        limit = page.limits[name]
        out |= {
            "limit": limit,
            "kept": factor * value <= limit,
            "kept_share": float(np.mean(factor * others <= limit)) if others.size else None,
        }
    return out


INDICES_SCHEMA = "residnet.indices/1"


def index_rows(
    craft: Craft, flights: Sequence[Flight], length: float | None
) -> list[dict[str, Any]]:
    """Return log, manoeuvre, craft, faults, indices and limits of each flight.

    Indices in SI and rad; each limit with whether it is kept.

    Args:
        length: of the hull in m; None where unknown, then there are neither lengths nor limits.
    """
    out = []
    for flight in flights:
        indices = (
            {}
            if flight.log.meta.get("diverged")
            else flight.manoeuvre.indices(flight.motion, length)
        )
        speed = indices.get("approach_speed", 0.0)
        limits = (
            flight.manoeuvre.limits(craft.helm, length, speed)
            if length is not None and speed > 0
            else {}
        )
        out.append(
            {
                "log": flight.motion.name,
                "manoeuvre": flight.manoeuvre.kind,
                "craft": craft.name,
                "fault": flight.fault,
                "timed_out": bool(flight.log.meta.get("timed_out", False)),
                "indices": indices,
                "limits": {
                    name: {"limit": limit, "kept": indices[name] <= limit}
                    for name, limit in limits.items()
                    if name in indices
                },
            }
        )
    return out


def index_contents(
    run: str, length: float | None, rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the contents of indices.json."""
    used = {name for row in rows for name in row["indices"]}
    units = {name: UNITS.get(name, "-") for name in sorted(used)}
    return {
        "schema": INDICES_SCHEMA,
        "run": run,
        "length": length,
        "units": units,
        "rows": list(rows),
    }
