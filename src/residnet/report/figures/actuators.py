"""The figure of an actuator identification: throttle map, step responses, bollard pull (document
003, Figs. 4, 6, 7).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from residnet.physics.actuators.identify import StepAnswer, ThrottleMap, ThrustFit, follow_command
from residnet.report.figures.style import RC, new_figure, save


def draw_actuators(
    path: Path,
    config: Any,
    logs: Any,
    throttle: ThrottleMap | None,
    step: StepAnswer | None,
    thrust: tuple[ThrustFit, ThrustFit] | None,
) -> None:
    """Measurements as dots or thin lines, fits over them; one panel for each test."""
    import matplotlib

    panels = [
        kind
        for kind, fit in (("throttle", throttle), ("step", step), ("thrust", thrust))
        if fit is not None
    ]
    with matplotlib.rc_context(RC):
        figure = new_figure(2.6)
        axes = dict(zip(panels, np.atleast_1d(figure.subplots(1, len(panels))), strict=True))
        if throttle is not None:
            _throttle(axes["throttle"], logs.throttle[0], logs.throttle[1], throttle)
        if step is not None:
            _steps(axes["step"], logs.steps, step)
        if thrust is not None:
            n, pull = logs.bollard
            _thrust(axes["thrust"], n, pull / config.bollard.thrusters, thrust)
        caption = f"Actuator tests of {config.name}: measured (dots, grey lines) and fitted."
        save(figure, path, f"Actuators of {config.name}", caption)


def _throttle(axis: Any, throttle: np.ndarray, n: np.ndarray, fit: ThrottleMap) -> None:
    grid = np.linspace(throttle.min(), throttle.max(), 300)
    axis.plot(100 * throttle, 60 * n, ".", color="0.4", markersize=4)
    axis.plot(100 * grid, 60 * fit(grid), color="#0072B2")
    axis.set(xlabel="throttle [%]", ylabel="revolutions [rpm]", title="throttle map")


def _steps(
    axis: Any, runs: list[tuple[np.ndarray, np.ndarray, np.ndarray]], fit: StepAnswer
) -> None:
    for t, command, n in runs:
        axis.plot(t - t[0], 60 * command, color="#009E73", linestyle=(0, (4, 2)), linewidth=0.8)
        axis.plot(t - t[0], 60 * n, color="0.5", linewidth=0.8)
        axis.plot(
            t - t[0],
            60
            * follow_command(t, command, fit.rate.value, fit.dead_time.value, float(n[:3].mean())),
            color="#D55E00",
        )
    axis.set(xlabel="time [s]", ylabel="revolutions [rpm]", title="step response")


def _thrust(
    axis: Any, n: np.ndarray, thrust: np.ndarray, fits: tuple[ThrustFit, ThrustFit]
) -> None:
    axis.plot(60 * n, thrust, ".", color="0.4", markersize=4)
    for fit in fits:
        grid = np.linspace(fit.low, fit.high, 200)
        axis.plot(60 * grid, fit(grid), color="#0072B2")
    axis.set(xlabel="revolutions [rpm]", ylabel="thrust of one [N]", title="bollard pull")
