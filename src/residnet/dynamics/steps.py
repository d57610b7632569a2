"""How many steps a simulation may have."""

from __future__ import annotations

MOST_STEPS = 2_000_000
"""Steps of the longest simulation: more than two days at ten steps a second."""


def check_steps(duration: float, step: float, what: str = "duration") -> None:
    """Refuse a simulation of so many steps that it can only be a slip.

    Args:
        duration: of the simulation in s.
        step: of the simulation in s.
        what: name of the duration in the message.

    Raises:
        ValueError: where there are more steps than `MOST_STEPS`.
    """
    count = duration / step
    if count > MOST_STEPS:
        raise ValueError(
            f"{what} of {duration:g} s has {count:.3g} steps of {step:g} s; at most {MOST_STEPS:,}"
            " are simulated: shorten it or take a larger step"
        )
