"""Manoeuvres, one file each: the manoeuvre, its source of inputs, and the family that draws it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from residnet.core.registry import Kinds

if TYPE_CHECKING:
    from residnet.manoeuvres.acceleration_deceleration import AccelerationDecelerationFamily
    from residnet.manoeuvres.base import Manoeuvre
    from residnet.manoeuvres.constant import ConstantFamily
    from residnet.manoeuvres.excitation import MultiSineFamily, RandomStepsFamily
    from residnet.manoeuvres.three_two_one_one import ThreeTwoOneOneFamily
    from residnet.manoeuvres.turning_circle import TurningCircleFamily
    from residnet.manoeuvres.zigzag import ZigzagFamily

    ManoeuvreConfig: TypeAlias = Manoeuvre
    FamilyConfig: TypeAlias = (
        ConstantFamily
        | ZigzagFamily
        | TurningCircleFamily
        | AccelerationDecelerationFamily
        | ThreeTwoOneOneFamily
        | RandomStepsFamily
        | MultiSineFamily
    )
else:
    _LEVELS = "residnet.manoeuvres.acceleration_deceleration"
    ManoeuvreConfig = Annotated[
        Any,
        Kinds(
            "residnet.manoeuvres",
            "residnet.manoeuvres.base:Manoeuvre",
            {
                "constant": "residnet.manoeuvres.constant:ConstantInput",
                "zigzag": "residnet.manoeuvres.zigzag:Zigzag",
                "turning_circle": "residnet.manoeuvres.turning_circle:TurningCircle",
                "acceleration_deceleration": f"{_LEVELS}:AccelerationDeceleration",
                "three_two_one_one": "residnet.manoeuvres.three_two_one_one:ThreeTwoOneOne",
                "random_steps": "residnet.manoeuvres.excitation:RandomSteps",
                "multi_sine": "residnet.manoeuvres.excitation:MultiSine",
                "spiral": "residnet.manoeuvres.spiral:Spiral",
                "stopping": "residnet.manoeuvres.stopping:Stopping",
                "waypoints": "residnet.manoeuvres.waypoints:Waypoints",
                "four_corner": "residnet.manoeuvres.four_corner:FourCorner",
                "replay": "residnet.manoeuvres.replay:Replay",
            },
        ),
    ]
    FamilyConfig = Annotated[
        Any,
        Kinds(
            "residnet.families",
            "residnet.core.config:Config",
            {
                "constant": "residnet.manoeuvres.constant:ConstantFamily",
                "zigzag": "residnet.manoeuvres.zigzag:ZigzagFamily",
                "turning_circle": "residnet.manoeuvres.turning_circle:TurningCircleFamily",
                "acceleration_deceleration": f"{_LEVELS}:AccelerationDecelerationFamily",
                "three_two_one_one": "residnet.manoeuvres.three_two_one_one:ThreeTwoOneOneFamily",
                "random_steps": "residnet.manoeuvres.excitation:RandomStepsFamily",
                "multi_sine": "residnet.manoeuvres.excitation:MultiSineFamily",
            },
        ),
    ]
"""Config of any manoeuvre, those of other packages included; its `kind` says which."""
