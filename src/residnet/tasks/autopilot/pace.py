"""How slowly a vessel turns, and a run whose times are as long as the vessel needs."""

from __future__ import annotations

import math

from residnet.control.conditions.config import ConditionsConfig
from residnet.control.heading.steering import SteeredPlant
from residnet.control.heading.turning import Turning
from residnet.core.progress import say
from residnet.physics.vessel import load_vessel
from residnet.tasks.autopilot.config import AutopilotSettings, RecurrentConfig

_STEP = math.radians(30.0)
_REFERENCE = Turning(3.47, 3.94, 3.2), math.radians(5.0)
"""K, T and rudder of the vessel of document 004, whose times configs state at a pace of one."""


def least_time(turning: Turning, limit: float, rate: float | None, change: float = _STEP) -> float:
    """Return the least time in s of a change of heading [rad] by T r_dot + r = K delta.

    Full rudder is held until full counter-rudder stops the yaw rate on the new heading; each way of
    the rudder to one side takes its time beside that.
    """
    steady, time = abs(turning.gain) * limit, turning.time

    def turned(first: float) -> tuple[float, float]:
        fast = steady * (1.0 - math.exp(-first / time))
        second = time * math.log1p(fast / steady)
        angle = steady * first - time * fast + time * fast - steady * second
        return angle, first + second

    low, high = 0.0, time
    while turned(high)[0] < change:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if turned(middle)[0] > change else (middle, high)
    return turned(high)[1] + (0.0 if rate is None else 2.0 * limit / rate)


def paced(config: AutopilotSettings) -> AutopilotSettings:
    """Return the config with its times multiplied by its pace, the pace itself being one.

    Delays, which are those of the electronics, stay as they are. What a degree costs grows as the
    time does.

    Raises:
        FitError: where the vessel does not turn steadily.
    """
    pace = config.pace
    if pace == "vessel":
        vessel = SteeredPlant(load_vessel(config.vessel).build())
        turning = vessel.turning(config.rudder, config.turning_time)
        slow = least_time(turning, config.rudder, vessel.rate)
        # two digits are enough, and steps stay numbers that can be read
        pace = float(f"{slow / least_time(*_REFERENCE, None):.2g}")
        say(f"  pace {pace:g}: a change of 30 deg takes {slow:.3g} s at least")
    if pace == 1.0 or config.conditions is None:
        return config
    test, stated = config.test, config.conditions
    changed = {
        "pace": 1.0,
        "test": test.model_copy(
            update={
                "dt": pace * test.dt,
                "duration": pace * test.duration,
                "bias_time": pace * test.bias_time,
            }
        ),
        "conditions": stated.model_copy(
            update={
                "stated": _longer(stated.stated, pace),
                "beyond": {name: _longer(one, pace) for name, one in stated.beyond.items()},
            }
        ),
        "recurrent": {name: _trained(one, pace) for name, one in config.recurrent.items()},
    }
    return config.model_copy(update=changed)


def _longer(conditions: ConditionsConfig, pace: float) -> ConditionsConfig:
    times = ("hold", "duration", "push_time", "dt", "overshoot_weight", "travel_weight")
    return conditions.model_copy(update={name: pace * getattr(conditions, name) for name in times})


def _trained(wanted: RecurrentConfig, pace: float) -> RecurrentConfig:
    training = wanted.training
    duration = None if training.duration is None else pace * training.duration
    update = {"dt": pace * training.dt, "hold": pace * training.hold, "duration": duration}
    return wanted.model_copy(update={"training": training.model_copy(update=update)})
