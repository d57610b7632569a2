"""Measures of heading controllers: steps over many vessels, flights under conditions, courses.

Times of courses are compared with a reference of arcs and straight lines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.courses.config import PlannedCourse
from residnet.control.courses.course_check import passages
from residnet.control.heading.conditions import (
    ConditionedRun,
    ConditionsConfig,
    Flights,
    HeadingChanges,
    SteadinessLimits,
    fly,
)
from residnet.control.heading.vessels import SteeredPlant, SteeredVessel
from residnet.core.columns import velocities_on
from residnet.core.frames import wrap
from residnet.core.layout import HEADING, POSITION, RANGE_VELOCITIES
from residnet.data.simulated import Disturbance
from residnet.physics.environment import WavesConfig
from residnet.physics.plant import Plant

QUANTITIES = {
    "settling": "s",
    "overshoot": "rad",
    "iae": "rad s",
    "travel": "rad",
    "energy": "rad^2 s",
}
"""Of a row, with units: last entry into the band, overshoot, integral of the absolute error, travel
of the rudder command, integral of its square.
"""


def measure(flights: Flights, band: float) -> dict[str, Tensor]:
    """Return each of `QUANTITIES` by flight, [B]."""
    values = (
        flights.settled(band),
        flights.overshoot(),
        flights.absolute_error(),
        flights.travel(),
        flights.effort(),
    )
    return dict(zip(QUANTITIES, values, strict=True))


def distribution(values: Tensor) -> dict[str, float]:
    """Return mean, median, 95th percentile and largest of values [B]."""
    array = values.double().numpy()
    return {
        "mean": float(array.mean()),
        "median": float(np.median(array)),
        "p95": float(np.quantile(array, 0.95)),
        "max": float(array.max()),
    }


def objections(model: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what rows of metrics.json say against using a policy rather than a tuned law."""
    return _cheaper(model, rows, "conditions", "under its conditions")


def not_for(model: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return under which conditions beyond its own a tuned law costs less than a policy."""
    beyond = dict.fromkeys(row["protocol"] for row in rows if row["protocol"].startswith("beyond_"))
    return [
        sentence
        for protocol in beyond
        for sentence in _cheaper(model, rows, protocol, f"under '{protocol[7:]}'")
    ]


def cycling(model: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return in a sentence in how many flights without noise a policy keeps swinging, if any."""
    quiet = {row["model"]: row for row in rows if row["protocol"] == "quiet"}
    if not (own := quiet.get(model)) or not own.get("cycling"):
        return []
    calm = [
        name for name, row in quiet.items() if row["kind"] == "classical" and not row["cycling"]
    ]
    return [
        f"'{model}' keeps swinging in {own['cycling']} of {own['n']} flights without noise, its"
        f" command by up to {math.degrees(own['rudder_swing']['max']):.3g} deg; "
        + (f"not so {', '.join(calm)}." if calm else "each tuned law does so too.")
    ]


def _cheaper(model: str, rows: Sequence[Mapping[str, Any]], protocol: str, what: str) -> list[str]:
    """Return in a sentence what the cheapest tuned law costs, where a policy costs more."""
    judged = {
        row["model"]: (row["kind"], row["cost"]["mean"])
        for row in rows
        if row["protocol"] == protocol and "cost" in row
    }
    laws = {name: cost for name, (kind, cost) in judged.items() if kind == "classical"}
    if model not in judged or not laws:
        return []
    own, best = judged[model][1], min(laws, key=laws.__getitem__)
    # a policy that learned nothing flies as the law that it began with, but for rounding
    if own <= laws[best] or math.isclose(own, laws[best]):
        return []
    return [f"{what} a flight costs {own:.4g} s, with {best} {laws[best]:.4g} s"]


def _row(controller: str, kind: str, protocol: str, found: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return a row of metrics.json with the distributions of what was found, [B] by name."""
    row = {"model": controller, "kind": kind, "split": "simulated", "protocol": protocol}
    return row | {name: distribution(values) for name, values in found.items()}


def step_row(
    controller: str, kind: str, protocol: str, flights: Flights, band: float
) -> dict[str, Any]:
    """Return a row of metrics.json: distributions, flights not settled at the end, flights."""
    finite = torch.isfinite(flights.states).all(dim=2).all(dim=1)
    unsettled = (flights.error[:, -1].abs() > band) | ~finite
    return _row(controller, kind, protocol, measure(flights, band)) | {
        "unsettled": int(unsettled.sum()),
        "n": len(finite),
        "diverged": int((~finite).sum()),
    }


def corners(effect: tuple[float, float], time: tuple[float, float]) -> Tensor:
    """Return effect, time and zero bias [9, 3]: nominal first, then ends and middles."""
    return torch.tensor([(e, t, 0.0) for e in (1.0, *effect) for t in (1.0, *time)]).double()


def random_variations(
    effect: tuple[float, float], time: tuple[float, float], count: int, seed: int
) -> Tensor:
    """Return effect and time drawn evenly from their ranges, no bias: [count, 3]."""
    drawn = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = torch.tensor([effect, time], dtype=torch.float64).T
    return torch.cat((low + (high - low) * drawn, torch.zeros(count, 1).double()), dim=1)


def step_flights(
    vessel: SteeredVessel,
    policy: Policy,
    heading: float,
    dt: float,
    duration: float,
    variations: Tensor,
) -> Flights:
    """Run steps of the reference, to starboard and to port in turn."""
    side = torch.where(torch.arange(len(variations)) % 2 == 0, 1.0, -1.0)
    return fly(vessel, policy, heading * side, variations, dt=dt, duration=duration)


def wind_flights(
    plant: Plant, policy: Policy, speed: float, heading: float, dt: float, duration: float
) -> Flights:
    """Run steps of the reference with the nominal vessel in wind from eight directions."""
    weather: dict[str, float | Tensor] = {
        "wind_speed": speed,
        "wind_dir": torch.arange(8) * (torch.pi / 4.0),
    }
    vessel, headings = SteeredPlant(plant, calm=False), torch.full((8,), heading)
    return fly(vessel, policy, headings, _nominal(8), dt=dt, duration=duration, weather=weather)


def sea_flights(
    plant: Plant,
    policy: Policy,
    waves: WavesConfig,
    heading: float,
    dt: float,
    duration: float,
    seed: int,
) -> Flights:
    """Run steps of the reference with the nominal vessel in eight seaways."""
    disturbance, rows = Disturbance(waves=waves), 8
    return fly(
        SteeredPlant(plant, calm=False),
        policy,
        torch.full((rows,), heading),
        _nominal(rows),
        dt=dt,
        duration=duration,
        surround=lambda source: disturbance.surround(source, plant, rows, dt, seed),
    )


def sea_row(controller: str, kind: str, flights: Flights, start: float) -> dict[str, Any]:
    """Return a row of metrics.json: roots of mean squares from a time [s] on.

    They are of heading error, rudder and, where the vessel rolls, heel.
    """
    kept = {"heading": flights.error, "rudder": flights.command}
    if "phi" in flights.names:
        kept["heel"] = flights.state("phi")
    first = round(start / flights.dt)
    found = {f"{key}_rms": of[:, first:].square().mean(1).sqrt() for key, of in kept.items()}
    return _row(controller, kind, "sea", found) | {"n": len(flights.heading)}


def _nominal(rows: int) -> Tensor:
    return torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(rows, -1)


def series(name: str, flights: Flights, variations: Tensor) -> pd.DataFrame:
    """Return heading, or depth, its rate and rudder every 0.05 s, all turned to starboard."""
    every = max(round(0.05 / flights.dt), 1)
    parts = []
    for i, variation in enumerate(variations):
        side = 1.0 if i % 2 == 0 else -1.0
        parts.append(
            pd.DataFrame(
                {
                    "controller": name,
                    "effect": float(variation[0]),
                    "time": float(variation[1]),
                    "t": torch.arange(0, flights.command.shape[1], every).numpy() * flights.dt,
                    **{
                        state: side * flights.state(state)[i, :-1:every].numpy()
                        for state in (flights.axis.value, flights.axis.rate)
                    },
                    "rudder": side * flights.command[i, ::every].numpy(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


_ALLOWED = 1.25
"""Of the limits that choose an epoch of training, which are a fifth below what a policy may do."""
QUIET_FLIGHTS = 100
"""Flights without noise, waves and push; chosen by hand: fewer tell, and each takes longer."""


def drawn(conditions: ConditionsConfig, flights: int, seed: int) -> HeadingChanges:
    """Return flights that no tuning or training has seen, the same for all controllers."""
    random = torch.Generator().manual_seed(seed + 2_000_003)
    return conditions.draw(flights, conditions.dt, random)


def judged(
    controller: str,
    kind: str,
    protocol: str,
    run: ConditionedRun,
    conditions: ConditionsConfig,
    changes: HeadingChanges,
) -> tuple[dict[str, Any], pd.DataFrame]:
    """Return a row of metrics.json, and a table with a line for each flight, in SI units.

    A flight whose heading is no number counts as diverged, and with a heading error of 180 deg all
    the time in the means.
    """
    flown = run.fly(changes)
    value = flown.state(flown.axis.value)[:, :-1]
    finite = torch.isfinite(value).all(1) & torch.isfinite(flown.command).all(1)
    worst = conditions.duration + 0.5 * 180.0
    found = {
        name: torch.where(finite, values, worst if name == "cost" else torch.nan)
        for name, values in flown.measured(conditions).items()
    }
    kept = {name: values if name == "cost" else values[finite] for name, values in found.items()}
    known = {name: values for name, values in kept.items() if len(values)}
    table = pd.DataFrame(
        {
            "controller": controller,
            "protocol": protocol,
            "flight": range(len(finite)),
            **{name: values.numpy() for name, values in found.items()},
        }
    )
    row = _row(controller, kind, protocol, known)
    return row | {"n": len(finite), "diverged": int((~finite).sum())}, table


def swinging(
    controller: str, kind: str, run: ConditionedRun, changes: HeadingChanges, after: float
) -> dict[str, Any]:
    """Return the row of metrics.json of flights without noise: what still swings at their end.

    `after` is the time in s from the change on from which they are looked at.
    """
    flown = run.fly(changes)
    heading, rudder = flown.swing(after)
    limits = SteadinessLimits()
    most = _ALLOWED * limits.of(flown.axis)[0], _ALLOWED * limits.rudder_swing
    # what is no number is not within its limit
    steady = (heading <= most[0]) & (rudder <= most[1])
    found = {"heading_swing": heading, "rudder_swing": rudder}
    row = _row(controller, kind, "quiet", found)
    return row | {"cycling": int((~steady).sum()), "n": len(heading)}


@dataclass(frozen=True)
class Tracking:
    """The metrics of one run in closed loop; SI, angles in rad.

    Attributes:
        position_mae, position_mse: of the distance to the desired position in m, m^2 (4.6).
        heading_mae, heading_mse: of the wrapped heading error in rad, rad^2 (4.7).
        tau: mean |tau| commanded in surge, sway, yaw.
        feedback: mean |tau_FB| in surge, sway, yaw.
        motion_mse: of the velocities and accelerations against the desired ones in (m/s)^2,
            (m/s)^2, (rad/s)^2 and per second squared (Table 4.8).
        energy: integral of |tau' nu| in J, surge and sway, then yaw.
        power: the same per second in W (Table 4.13).
        iaew: integral of |e| times integral of power (3.18), position [m s J] and heading [rad s
            J].
    """

    position_mae: float
    position_mse: float
    heading_mae: float
    heading_mse: float
    tau: tuple[float, float, float]
    feedback: tuple[float, float, float]
    motion_mse: tuple[float, ...]
    energy: tuple[float, float]
    power: tuple[float, float]
    iaew: tuple[float, float]

    def row(self) -> dict[str, float | list[float]]:
        """Return the metrics for JSON."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }


def tracking(
    pose: Tensor, motion: Tensor, desired: Tensor, command: Tensor, feedback: Tensor, dt: float
) -> Tracking:
    """Return the metrics of a run in closed loop.

    Args:
        pose: x, y, psi [T, 3].
        motion: nu, nu_dot [T, 6].
        desired: eta_d, nu_d, nu_dot_d [T, 9].
        command: tau_c [T, 3].
        feedback: its part tau_FB [T, 3].
        dt: step in s.
    """
    position = (desired[:, POSITION] - pose[:, POSITION]).norm(dim=-1)
    heading = wrap(desired[:, HEADING] - pose[:, HEADING]).abs()
    work = command * motion[:, RANGE_VELOCITIES]
    # the power of keeping the position and of keeping the heading are told apart (Table 4.13)
    energy = [float(work[:, :2].sum(-1).abs().sum() * dt), float(work[:, 2].abs().sum() * dt)]
    errors = [float(position.sum() * dt), float(heading.sum() * dt)]
    seconds, missed = dt * len(pose), (velocities_on(desired) - motion).square().mean(0).tolist()
    tau, fed = command.abs().mean(0).tolist(), feedback.abs().mean(0).tolist()
    return Tracking(
        float(position.mean()),
        float(position.square().mean()),
        float(heading.mean()),
        float(heading.square().mean()),
        (tau[0], tau[1], tau[2]),
        (fed[0], fed[1], fed[2]),
        tuple(missed),
        (energy[0], energy[1]),
        (energy[0] / seconds, energy[1] / seconds),
        (errors[0] * energy[0], errors[1] * energy[1]),
    )


def mse(residual: Tensor) -> list[float]:
    """Return the mean square of a residual [N, 3] by axis."""
    return [float(value) for value in torch.mean(residual.square(), dim=0)]


Array = NDArray[np.float64]


@dataclass(frozen=True)
class CourseFlight:
    """A flight of one vessel along one course, until it ended.

    Attributes:
        track: north, east [N, 2] in m.
        heading: [N] in rad.
        rudder: command [N] in rad.
        speed: [N] in m/s.
        cross_track: [N] in m, positive to starboard of the plan.
        dt: step in s.
        finished: whether the end was reached in the time given.
    """

    track: Array
    heading: Array
    rudder: Array
    speed: Array
    cross_track: Array
    dt: float
    finished: bool


def row(
    model: str,
    kind: str,
    guidance: str,
    planned: PlannedCourse,
    flight: CourseFlight,
    acceptance: float,
    speed: float,
) -> dict[str, Any]:
    """Return a row of metrics.json.

    `ratio` is course time over the reference's length at the service speed; `ratio_turning` takes
    the speed that the vessel keeps in its smallest turn, for vessels that slow down. `margin` is
    how far inside the circle that was entered least, or outside the one that was passed most
    closely.
    """
    enters = planned.protocol == "enter"
    buoys = [
        buoy.model_copy(update={"radius": acceptance}) if enters else buoy for buoy in planned.buoys
    ]
    seen = passages(flight.track, buoys)
    time = (len(flight.track) - 1) * flight.dt
    rate = np.abs(np.diff(flight.heading)) / flight.dt
    out: dict[str, Any] = {
        "model": model,
        "kind": kind,
        "guidance": guidance,
        "split": "simulated",
        "protocol": planned.protocol,
        "finished": flight.finished,
        "course_time": time,
        "reference_time": planned.reference / speed,
        "ratio": time * speed / planned.reference,
        "ratio_turning": time * planned.steady.speed / planned.reference,
        "cross_track_rms": float(np.sqrt(np.mean(flight.cross_track**2))),
        "cross_track_max": float(np.abs(flight.cross_track).max()),
        "travel": float(abs(flight.rudder[0]) + np.abs(np.diff(flight.rudder)).sum()),
        "tightest_turn": float((flight.speed[:-1] / np.maximum(rate, 1e-9)).min()),
        "distances": [passage.least for passage in seen],
    }
    outside = [passage.least - buoy.radius for passage, buoy in zip(seen, buoys, strict=True)]
    margins = [-distance for distance in outside] if enters else outside
    kept, right = sum(margin >= 0 for margin in margins), len(seen)
    if enters:
        out |= {"entered": kept}
    else:
        right = sum(one.side == buoy.leave_to for one, buoy in zip(seen, buoys, strict=True))
        out |= {"right_side": right, "clear": kept, "clearance": min(margins)}
    return out | {"passed": right == kept == len(seen), "margin": min(margins), "n": len(seen)}


def spread_row(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row of metrics.json for many flights of one controller, from their own rows.

    `passed` and `finished` are shares of the flights; flights that were given up count with the
    time until then.
    """
    ratio, margin = (np.array([row[name] for row in rows]) for name in ("ratio", "margin"))
    out = {
        name: rows[0][name] for name in ("model", "kind", "guidance", "protocol", "reference_time")
    }
    return out | {
        "split": "spread",
        "n": len(rows),
        "passed": float(np.mean([row["passed"] for row in rows])),
        "finished": float(np.mean([row["finished"] for row in rows])),
        "ratio": float(np.median(ratio)),
        "ratio_worst": float(ratio.max()),
        "margin": float(np.median(margin)),
        "margin_worst": float(margin.min()),
        "cross_track_rms": float(np.median([row["cross_track_rms"] for row in rows])),
    }
