"""Manoeuvres, one file each: the manoeuvre, its source of inputs, and the family that draws it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.core.registry import Kinds
from residnet.manoeuvres.acceleration_deceleration import (
    AccelerationDeceleration,
    AccelerationDecelerationFamily,
)
from residnet.manoeuvres.base import Helm, Manoeuvre, Scheduled, StackedSource, Watched
from residnet.manoeuvres.constant import ConstantFamily, ConstantInput
from residnet.manoeuvres.excitation import (
    MultiSine,
    MultiSineFamily,
    RandomSteps,
    RandomStepsFamily,
)
from residnet.manoeuvres.four_corner import FourCorner
from residnet.manoeuvres.replay import Replay
from residnet.manoeuvres.spiral import Spiral
from residnet.manoeuvres.stopping import Stopping
from residnet.manoeuvres.three_two_one_one import ThreeTwoOneOne, ThreeTwoOneOneFamily
from residnet.manoeuvres.turning_circle import TurningCircle, TurningCircleFamily
from residnet.manoeuvres.waypoints import Waypoints
from residnet.manoeuvres.zigzag import Zigzag, ZigzagFamily

AnyManoeuvre = (
    ConstantInput
    | Zigzag
    | TurningCircle
    | AccelerationDeceleration
    | ThreeTwoOneOne
    | RandomSteps
    | MultiSine
    | Spiral
    | Stopping
    | Waypoints
    | FourCorner
    | Replay
)
ManoeuvreConfig = Annotated[AnyManoeuvre, Kinds("residnet.manoeuvres", Manoeuvre)]
"""Config of any manoeuvre, those of other packages included; its `kind` says which."""

FamilyConfig = Annotated[
    ConstantFamily
    | ZigzagFamily
    | TurningCircleFamily
    | AccelerationDecelerationFamily
    | ThreeTwoOneOneFamily
    | RandomStepsFamily
    | MultiSineFamily,
    Field(discriminator="kind"),
]

__all__ = [
    "AccelerationDeceleration",
    "ConstantInput",
    "FamilyConfig",
    "FourCorner",
    "Helm",
    "Manoeuvre",
    "ManoeuvreConfig",
    "MultiSine",
    "RandomSteps",
    "Replay",
    "Scheduled",
    "Spiral",
    "StackedSource",
    "Stopping",
    "ThreeTwoOneOne",
    "TurningCircle",
    "Watched",
    "Waypoints",
    "Zigzag",
]
