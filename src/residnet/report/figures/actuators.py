"""The figure of an actuator identification (document 003, Figs. 4, 6, 7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from residnet.physics.actuators.identify import StepAnswer, ThrottleMap, ThrustFit, follow_command
from residnet.report.figures.files import Drawing
from residnet.report.figures.style import collect, legend_above, new_figure, styled

_MEASURED, _FIT = "measured", "fit"
Step = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Time in s, command and measured revolutions in 1/s of one step response, each [N]."""


@styled
def actuator_tests(
    name: str,
    throttle: tuple[np.ndarray, np.ndarray, ThrottleMap] | None = None,
    steps: tuple[Sequence[Step], StepAnswer] | None = None,
    bollard: tuple[np.ndarray, np.ndarray, tuple[ThrustFit, ThrustFit]] | None = None,
) -> Drawing:
    """Draw measurements as dots or thin lines and the fits over them, a panel for each test.

    Args:
        name: of the run.
        throttle: throttle [N], revolutions [N] in 1/s, and the fitted map.
        steps: measured step responses, and the fitted one.
        bollard: revolutions [N] in 1/s, thrust [N] of one thruster in N, and the fitted curves.
    """
    drawn = [test is not None for test in (throttle, steps, bollard)]
    figure = new_figure(2.9)
    panels = iter(np.atleast_1d(figure.subplots(1, sum(drawn))))
    if throttle is not None:
        _throttle(next(panels), *throttle)
    if steps is not None:
        _steps(next(panels), *steps)
    if bollard is not None:
        _thrust(next(panels), *bollard)
    handles: dict[str, Any] = {}
    for axis in figure.axes:
        collect(handles, axis)
    legend_above(figure, handles)
    caption = f"Actuator tests of {name}: the measurements, and the fits over them."
    return Drawing("actuators", f"Actuators of {name}", caption, figure)


def _throttle(axis: Any, throttle: np.ndarray, n: np.ndarray, fit: ThrottleMap) -> None:
    grid = np.linspace(throttle.min(), throttle.max(), 300)
    axis.plot(100 * throttle, 60 * n, ".", color="0.4", markersize=4, label=_MEASURED)
    axis.plot(100 * grid, 60 * fit(grid), color="#0072B2", label=_FIT)
    axis.set(xlabel="throttle [%]", ylabel="revolutions [rpm]", title="throttle map")


def _steps(axis: Any, runs: Sequence[Step], fit: StepAnswer) -> None:
    for t, command, n in runs:
        axis.plot(t - t[0], 60 * command, color="#009E73", linestyle="--", label="command")
        axis.plot(t - t[0], 60 * n, ".", color="0.4", markersize=4, label=_MEASURED)
        axis.plot(
            t - t[0],
            60
            * follow_command(t, command, fit.rate.value, fit.dead_time.value, float(n[:3].mean())),
            color="#0072B2",
            label=_FIT,
        )
    axis.set(xlabel="time [s]", ylabel="revolutions [rpm]", title="step response")


def _thrust(
    axis: Any, n: np.ndarray, thrust: np.ndarray, fits: tuple[ThrustFit, ThrustFit]
) -> None:
    axis.plot(60 * n, thrust, ".", color="0.4", markersize=4, label=_MEASURED)
    for fit in fits:
        grid = np.linspace(fit.low, fit.high, 200)
        axis.plot(60 * grid, fit(grid), color="#0072B2", label=_FIT)
    axis.set(xlabel="revolutions [rpm]", ylabel="thrust of one [N]", title="bollard pull")
