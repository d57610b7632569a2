"""Open-loop and closed-loop manoeuvres, families that draw random ones, and their indices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.manoeuvres.base import Manoeuvre
    from residnet.manoeuvres.closed_loop import (
        DepthStepFamily,
        HelixFamily,
        TurningCircleFamily,
        VerticalZigzagFamily,
        ZigzagFamily,
    )
    from residnet.manoeuvres.open_loop import (
        AccelerationDecelerationFamily,
        ConstantFamily,
        MultiSineFamily,
        RandomStepsFamily,
        ThreeTwoOneOneFamily,
    )

    ManoeuvreConfig: TypeAlias = Manoeuvre
    FamilyConfig: TypeAlias = (
        ConstantFamily
        | ZigzagFamily
        | TurningCircleFamily
        | AccelerationDecelerationFamily
        | ThreeTwoOneOneFamily
        | RandomStepsFamily
        | MultiSineFamily
        | HelixFamily
        | VerticalZigzagFamily
        | DepthStepFamily
    )
else:
    _OPEN = "residnet.manoeuvres.open_loop"
    _CLOSED = "residnet.manoeuvres.closed_loop"
    ManoeuvreConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.manoeuvres",
            "residnet.manoeuvres.base:Manoeuvre",
            {
                "constant": f"{_OPEN}:ConstantInput",
                "zigzag": f"{_CLOSED}:Zigzag",
                "turning_circle": f"{_CLOSED}:TurningCircle",
                "acceleration_deceleration": f"{_OPEN}:AccelerationDeceleration",
                "three_two_one_one": f"{_OPEN}:ThreeTwoOneOne",
                "random_steps": f"{_OPEN}:RandomSteps",
                "multi_sine": f"{_OPEN}:MultiSine",
                "helix": f"{_CLOSED}:Helix",
                "vertical_zigzag": f"{_CLOSED}:VerticalZigzag",
                "depth_step": f"{_CLOSED}:DepthStep",
                "spiral": f"{_CLOSED}:Spiral",
                "stopping": f"{_CLOSED}:Stopping",
                "replay": f"{_OPEN}:Replay",
            },
        ),
    ]
    FamilyConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.families",
            "residnet.core.config:Config",
            {
                "constant": f"{_OPEN}:ConstantFamily",
                "zigzag": f"{_CLOSED}:ZigzagFamily",
                "turning_circle": f"{_CLOSED}:TurningCircleFamily",
                "acceleration_deceleration": f"{_OPEN}:AccelerationDecelerationFamily",
                "three_two_one_one": f"{_OPEN}:ThreeTwoOneOneFamily",
                "random_steps": f"{_OPEN}:RandomStepsFamily",
                "multi_sine": f"{_OPEN}:MultiSineFamily",
                "helix": f"{_CLOSED}:HelixFamily",
                "vertical_zigzag": f"{_CLOSED}:VerticalZigzagFamily",
                "depth_step": f"{_CLOSED}:DepthStepFamily",
            },
        ),
    ]
"""Configuration of any family of manoeuvres, including those of other packages, by its `kind`."""
