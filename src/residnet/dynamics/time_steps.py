"""Integration schemes and the number of steps of a simulation."""

from __future__ import annotations

from typing import Literal

Integrator = Literal["rk4", "heun", "euler", "semi_implicit_euler"]
MAX_STEPS = 2_000_000
"""Steps of the longest simulation: more than two days at ten steps a second."""


def check_steps(duration: float, step: float, what: str = "duration") -> None:
    """Refuse a simulation of more than `MAX_STEPS` steps.

    Args:
        duration: duration of the simulation in s.
        step: step of the simulation in s.
        what: name of the duration in the message.

    Raises:
        ValueError: if the number of steps exceeds `MAX_STEPS`.
    """
    n_steps = duration / step
    if n_steps > MAX_STEPS:
        raise ValueError(
            f"{what} of {duration:g} s has {n_steps:.3g} steps of {step:g} s; at most {MAX_STEPS:,}"
            " are simulated: shorten it or increase the step"
        )
