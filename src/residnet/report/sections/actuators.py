"""The report of an actuator identification: parameters, figure, lines for a vessel file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from residnet.core.format import DASH, interval, number
from residnet.physics.actuators.identify import StepAnswer, ThrottleMap, ThrustFit, follow_command
from residnet.report.blocks import Block, Code, Section, Table, Text, table_of
from residnet.report.figure import GREEN, SOLID, Case, Curve, Figure, Look, Panel, joined
from residnet.report.figure_files import read_figures
from residnet.report.run_reader import Content, RunFiles

_TITLES = {
    ("throttle", "slope"): "revolutions at full throttle, slope",
    ("throttle", "offset"): "revolutions at zero throttle",
    ("throttle", "n_max"): "largest revolutions",
    ("step", "rate"): "rate of the revolutions",
    ("step", "dead_time"): "dead time",
}
_PER_MINUTE = {"1/s": ("rpm", 60.0), "1/s^2": ("rpm/s", 60.0)}
"""Units of revolutions as test engineers read them, with the factor from SI."""


Step = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Time in s, command and measured revolutions in 1/s of one step response, each [N]."""


def sections(run: RunFiles) -> list[Section]:
    """Return the identified parameters, the figure, and the lines for a vessel file."""
    found = run.json("actuators.json")
    drawn = read_figures(run.path / "figures")
    blocks: list[Block] = [*(one.part() for one in drawn[:1]), parameter_table(found)]
    throttle = found.get("throttle")
    if throttle and not throttle["saturated"]:
        text = "Nothing saturated in the throttle test. The largest revolutions are measured ones."
        blocks.append(Text(text))
    out = [Section("", blocks), *([Section("Figures", drawn)] if drawn else [])]
    lines = run.path / "actuators.yaml"
    if lines.is_file():
        about = "These lines belong to the section actuators of a vessel file."
        out.append(Section("Lines for a vessel file", [Text(about), Code(lines.read_text())]))
    return out


def parameter_table(found: Mapping[str, Any]) -> Table:
    """Return a row for each parameter of actuators.json with its 95 % interval."""
    rows: list[Content] = []
    for test, parts in found.items():
        estimates = parts.items() if isinstance(parts, Mapping) else ()
        for name, estimate in estimates:
            if isinstance(estimate, Mapping):
                unit, factor = _PER_MINUTE.get(estimate["unit"], (estimate["unit"], 1.0))
                rows.append(
                    {
                        "test": test,
                        "title": _TITLES.get((test, name), f"{test} thrust, {name}"),
                        "value": number(factor * estimate["value"], 4),
                        "interval": interval([estimate["low"], estimate["high"]], factor, 4),
                        "unit": unit,
                    }
                )
    rows += [
        {
            "test": "residual",
            "title": f"{test} thrust, rms residual",
            "value": number(found[test]["rms"]),
            "interval": DASH,
            "unit": "N",
        }
        for test in ("forward", "reverse")
        if test in found
    ]
    return table_of(
        rows,
        [
            ("parameter", "title"),
            ("value", lambda row: f"{row['value']} {row['unit']}", str),
            ("95 % interval", "interval", str),
        ],
        rule=lambda row: row["test"],
    )


def actuator_tests(
    name: str,
    throttle: tuple[np.ndarray, np.ndarray, ThrottleMap] | None = None,
    steps: tuple[Sequence[Step], StepAnswer] | None = None,
    bollard: tuple[np.ndarray, np.ndarray, tuple[ThrustFit, ThrustFit]] | None = None,
) -> Figure:
    """Draw measurements as dots and the fits over them, a panel for each test (Figs. 4, 6, 7).

    Args:
        throttle: throttle [N], revolutions [N] in 1/s, and the fitted map.
        steps: measured step responses, and the fitted one.
        bollard: revolutions [N] in 1/s, thrust [N] of one thruster in N, and the fitted curves.
    """
    drawn: list[tuple[Panel, dict[str, Curve]]] = []
    if throttle is not None:
        share, n, fitted = throttle
        grid = np.linspace(share.min(), share.max(), 300)
        panel = Panel("revolutions [rpm]", "throttle [%]", "throttle map", height=250, group="map")
        curves = {"measured": (100 * share, 60 * n), "fit": (100 * grid, 60 * fitted(grid))}
        drawn.append((panel, curves))
    if steps is not None:
        runs, answer = steps
        rate, dead = answer.rate.value, answer.dead_time.value
        panel = Panel("revolutions [rpm]", "time [s]", "step response", height=250, group="step")
        of_runs = {
            "command": joined((t - t[0], 60 * command) for t, command, _ in runs),
            "measured": joined((t - t[0], 60 * n) for t, _, n in runs),
            "fit": joined(
                (t - t[0], 60 * follow_command(t, command, rate, dead, float(n[:3].mean())))
                for t, command, n in runs
            ),
        }
        drawn.append((panel, of_runs))
    if bollard is not None:
        n, thrust, fits = bollard
        grids = [np.linspace(fit.low, fit.high, 200) for fit in fits]
        panel = Panel(
            "thrust of one [N]", "revolutions [rpm]", "bollard pull", height=250, group="n"
        )
        lines = joined((60 * grid, fit(grid)) for grid, fit in zip(grids, fits, strict=True))
        drawn.append((panel, {"measured": (60 * n, thrust), "fit": lines}))
    return Figure(
        "actuators",
        f"Actuators of {name}",
        f"Actuator tests of {name}: the measurements, and the fits over them.",
        {
            "command": Look("command", GREEN, "dashed"),
            "measured": Look("measured", "#666666", kind="points", size=2.5),
            "fit": replace(SOLID, label="fit"),
        },
        [panel for panel, _ in drawn],
        [Case("", [curves for _, curves in drawn])],
        columns=len(drawn),
    )
