"""The report of an actuator identification: parameters, figure, lines for a vessel file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from residnet.report.blocks import Block, Code, Section, Table, Text
from residnet.report.figures.files import figures_section
from residnet.report.format import DASH, interval, number
from residnet.report.run_reader import RunFiles

_TITLES = {
    ("throttle", "slope"): "revolutions at full throttle, slope",
    ("throttle", "offset"): "revolutions at zero throttle",
    ("throttle", "n_max"): "largest revolutions",
    ("step", "rate"): "rate of the revolutions",
    ("step", "dead_time"): "dead time",
}
_PER_MINUTE = {"1/s": ("rpm", 60.0), "1/s^2": ("rpm/s", 60.0)}
"""Units of revolutions as test engineers read them, with the factor from SI."""


def sections(run: RunFiles) -> list[Section]:
    """Return the identified parameters, the figure, and the lines for a vessel file."""
    found = run.json("actuators.json")
    blocks: list[Block] = [parameter_table(found)]
    throttle = found.get("throttle")
    if throttle and not throttle["saturated"]:
        blocks.append(
            Text(
                "Nothing saturated in the throttle test. The largest revolutions are measured ones."
            )
        )
    out = [Section("Identified parameters", blocks)]
    figures = figures_section(run.path / "figures")
    if figures:
        out.append(figures)
    lines = run.path / "actuators.yaml"
    if lines.is_file():
        about = "These lines belong to the section actuators of a vessel file."
        out.append(Section("Lines for a vessel file", [Text(about), Code(lines.read_text())]))
    return out


def parameter_table(found: Mapping[str, Any]) -> Table:
    """Return a row for each parameter with its 95 % interval.

    Args:
        found: the contents of actuators.json.
    """
    table = Table(["parameter", "value", "95 % interval", "unit"])
    last = ""
    for test, name, estimate in _estimates(found):
        unit, factor = _PER_MINUTE.get(estimate["unit"], (estimate["unit"], 1.0))
        bounds = [estimate["low"], estimate["high"]]
        title = _TITLES.get((test, name), f"{test} thrust, {name}")
        cells = [number(factor * estimate["value"], 4), interval(bounds, factor, 4), unit]
        table.add(title, cells, rule=test != last)
        last = test
    for test in ("forward", "reverse"):
        if test in found:
            table.add(f"{test} thrust, rms residual", [number(found[test]["rms"]), DASH, "N"])
    return table


def _estimates(found: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    for test, parts in found.items():
        if isinstance(parts, Mapping):
            for name, estimate in parts.items():
                if isinstance(estimate, Mapping):
                    yield test, name, estimate
