"""Flights without noise, waves and slow push, in which a loop that swings by itself is seen."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.conditions.config import ConditionsConfig, HeadingChanges
from residnet.control.conditions.flights import ConditionedRun
from residnet.core.config import Config, Radians

_AFTER, _FOR = 10.0 / 7.0, 5.0 / 7.0
"""Multiples of what the cost counts: after that time a flight without noise is looked at for
swinging, for that long (with 14 s from 20 s on, for 10 s).
"""
_NOMINAL = 16


def quiet(conditions: ConditionsConfig) -> ConditionsConfig:
    """Return the conditions without noise, waves and slow push, with time enough to settle."""
    return conditions.model_copy(
        update={
            "noise_psi": 0.0,
            "noise_r": 0.0,
            "push": 0.0,
            "waves": 0.0,
            "hold": 0.0,
            "duration": quiet_after(conditions.duration) + _FOR * conditions.duration,
        }
    )


def quiet_after(duration: float) -> float:
    """Return the time in s after a change from which nothing should swing.

    `duration` is the time in s that the cost counts.
    """
    return _AFTER * duration


class SteadyConfig(Config):
    """What a policy must keep to without noise and slow push, for an epoch of training to be taken.

    The defaults are a fifth below 0.2 deg of heading, 1 deg of rudder, 0.15 deg of overshoot, and
    0.6 deg that one flight in twenty may exceed, since other flights judge the policy than those
    that choose the epoch.

    Attributes:
        heading_swing: largest movement of the heading in rad, peak to peak, once a change is long
            over: from ten sevenths of the conditions' duration on, 20 s with 14 s.
        rudder_swing: largest movement of the rudder command in rad then, peak to peak.
        overshoot: largest overshoot in rad of the nominal vessel without delay and bias, over
            changes of heading of all sizes.
        overshoot_p95: overshoot in rad that one flight in twenty may exceed under the conditions,
            noise and slow push included.
        flights: under the conditions that are looked at for swinging; half of them at corners of
            the spread.
    """

    heading_swing: Radians = Field(default=0.002792526803190927, gt=0)
    rudder_swing: Radians = Field(default=0.013962634015954637, gt=0)
    overshoot: Radians = Field(default=0.0020943951023931953, gt=0)
    overshoot_p95: Radians = Field(default=0.008377580409572781, gt=0)
    flights: int = Field(default=256, ge=2, le=1_000_000)


@final
class SteadyTest:
    """Counts flights without noise that a policy should not make; no training sees them.

    Args:
        limits: of swing and overshoot.
        conditions: with noise, those of the training.
        seed: of the flights.

    Attributes:
        flights: number of all, those of the nominal vessel included.
    """

    def __init__(self, limits: SteadyConfig, conditions: ConditionsConfig, seed: int) -> None:
        self.limits, self.after = limits, quiet_after(conditions.duration)
        self.conditions = quiet(conditions)
        random = torch.Generator().manual_seed(seed)
        drawn = self.conditions.draw(limits.flights + _NOMINAL, conditions.dt, random)
        # a loop swings first where delay, K and T are at their bounds, which few draws come near
        drawn = self.conditions.at_corners(drawn, limits.flights // 2, random)
        heading = drawn.heading.clone()
        sides = torch.tensor([1.0, -1.0]).repeat(_NOMINAL // 2)
        heading[limits.flights :] = sides * torch.linspace(*conditions.heading, _NOMINAL)
        self.changes = nominal(replace(drawn, heading=heading), limits.flights, _NOMINAL)
        self.flights = limits.flights + _NOMINAL

    def refused(self, run: ConditionedRun) -> int:
        """Return how many flights swing, or overshoot on the nominal vessel."""
        flown = run.fly(self.changes)
        heading, rudder = flown.swing(self.after)
        limits, last = self.limits, self.limits.flights
        over = flown.measured(self.conditions)["overshoot"]
        # what is no number is not within its limit
        steady = (heading <= limits.heading_swing) & (rudder <= limits.rudder_swing)
        steady[last:] &= over[last:] <= limits.overshoot
        return int((~steady).sum())


def too_many(overshoot: Tensor, limit: float) -> int:
    """Return how many flights more than one in twenty overshoot by more than a limit.

    Args:
        overshoot: of flights under the conditions in rad, [N]; what is no number is beyond.
        limit: in rad.
    """
    beyond = int((~(overshoot <= limit)).sum())
    return max(beyond - len(overshoot) // 20, 0)


def nominal(changes: HeadingChanges, first: int, rows: int) -> HeadingChanges:
    """Return changes of which some rows fly the nominal vessel in calm water, without delay."""

    def with_rows(values: Tensor, new: Tensor | float) -> Tensor:
        values = values.clone()
        values[first : first + rows] = new
        return values

    return replace(
        changes,
        variation=with_rows(changes.variation, torch.tensor([1.0, 1.0, 0.0])),
        delay=with_rows(changes.delay, 0.0),
        weather={name: with_rows(values, 0.0) for name, values in changes.weather.items()},
    )
