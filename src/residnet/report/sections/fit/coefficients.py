"""Identified coefficients of the baselines with their standard errors and units."""

from __future__ import annotations

import math

from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS
from residnet.physics.terms import parse_term
from residnet.report.blocks import Block, Cell, Section, Table, Text
from residnet.report.format import number
from residnet.report.run_reader import RunFiles

_EXTRA_UNITS = {"wind_u": "m/s", "wind_v": "m/s", "wind_mag": "m/s"}
"""Units of factors of terms that are no channels of a log."""


def section(run: RunFiles) -> Section | None:
    """Return the tables of coefficients, the first baseline's open; None where there are none."""
    blocks: list[Block] = [
        Text(
            "u′, v′, r′ are the accelerations du/dt, dv/dt, dr/dt. Each is the sum of its terms. A"
            " value below twice its standard error (grey) cannot be told from zero.",
            quiet=True,
        )
    ]
    names = [
        run.baseline or "baseline",
        *(model for model, kind in run.kinds.items() if kind == "further"),
    ]
    for model in names:
        table = baseline_parameters(run, model)
        if table is None:
            continue
        refitted = bool(run.fit(model).get("refit"))
        parts = [
            Text(_after_refit(run, model), quiet=True) if refitted else None,
            table,
            *_own(run, model),
        ]
        if len(blocks) == 1:
            blocks += [part for part in parts if part is not None]
        else:
            title = f"Parameters of {model}" + (", refitted through rollouts" if refitted else "")
            blocks.append(Section(title, parts, folded=True))
    return Section("Baseline parameters", blocks) if len(blocks) > 1 else None


def _after_refit(run: RunFiles, model: str) -> str:
    notes = run.fit(model)
    at_rest, left_open = (
        ", ".join(f"{term} in {axis.replace('_dot', '')}′" for axis, term in notes.get(key) or [])
        for key in ("feeding", "open")
    )
    said = f" Left out, for their sign would feed energy: {at_rest}." if at_rest else ""
    if left_open:
        said += f" The data leave open, and they stay near zero: {left_open}."
    return said_of_refit(model) + said


def said_of_refit(model: str) -> str:
    """Return what holds of the table of every refitted baseline."""
    return (
        f"{model}: values and standard errors are those after the refit through rollouts. The"
        " ratios of value to error keep the error of the least-squares fit before it."
    )


def _own(run: RunFiles, model: str) -> list[Block]:
    """Return the part on constant accelerations of single logs, nothing where there are none."""
    table = log_offsets(run, model)
    if table is None:
        return []
    about = (
        f"All logs share the parameters of {model}. Beside them, the refit gave each log constant"
        " accelerations of its own, for trim, rudder zero and the tank; they grow with the square"
        " of the speed and are no part of the model. A log whose values lie far beyond the others'"
        " was run with another vessel or set-up. A value below twice its standard error (grey)"
        " cannot be told from zero."
    )
    return [Section("Accelerations of each training log", [Text(about, quiet=True), table])]


def log_offsets(run: RunFiles, model: str) -> Table | None:
    """Return the constant accelerations that a refit found for each training log.

    None where the refit looked for none.
    """
    entries = run.fit(model).get("offsets") or []
    if not entries:
        return None
    axes = list(dict.fromkeys(entry["axis"] for entry in entries))
    spread = {entry["axis"]: float(entry["spread"]) for entry in entries}
    speed = float(entries[0]["speed"])
    titles = [
        f"{axis.replace('_dot', '')}′ [{term_unit(axis, '1')}], spread {number(spread[axis], 2)},"
        f" at {number(speed, 2)} m/s"
        for axis in axes
    ]
    table = Table(
        ["log", *["value", "standard error"] * len(axes)],
        groups=[(title, 2) for title in titles],
    )
    for log in dict.fromkeys(entry["log"] for entry in entries):
        cells: list[Cell] = []
        for entry in (entry for entry in entries if entry["log"] == log):
            value, error = float(entry["value"]), float(entry["standard_error"])
            cells += [
                Cell(number(value, 2), mark="weak" if abs(value) < 2 * error else ""),
                Cell(number(error, 2)),
            ]
        table.add(log, cells)
    return table


def baseline_parameters(run: RunFiles, model: str) -> Table | None:
    """Return the coefficients of a baseline with standard errors, None where there are none."""
    entries = run.fit(model).get("coefficients") or []
    if not entries:
        return None
    table = Table(["term", "value", "standard error", "value / error", "unit"])
    for entry in entries:
        value, error = float(entry["value"]), float(entry["standard_error"])
        weak = error > 0 and abs(value) < 2 * error
        ratio = number(abs(value) / error, 2) if error > 0 else "–"
        decimals = min(max(1 - math.floor(math.log10(error)), 0), 12) if error > 0 else 4
        shown = f"{value:.{decimals}f}" if decimals <= 6 else number(value, 3)
        unit = Cell(term_unit(entry["axis"], entry["term"]))
        cells = [
            Cell(shown.replace("-", "−")),
            Cell(number(error, 2)),
            Cell(ratio, mark="weak" if weak else ""),
            unit,
        ]
        table.add(f"{entry['axis'].replace('_dot', '')}′: {entry['term']}", cells)
    return table


def term_unit(axis: str, term: str) -> str:
    """Return the unit of a coefficient: that of the acceleration over that of its term.

    It is empty where the unit of a factor is not known.
    """
    units = CHANNEL_UNITS | _EXTRA_UNITS
    try:
        factors = parse_term(term, [name for name in units if name != "t"], functions=False)
    except ConfigError:
        return ""
    powers: dict[str, int] = {}
    _add(powers, units.get(axis, "-"), 1)
    for factor in factors:
        _add(powers, units[factor.name], -factor.power)
    up = "·".join(_power(name, power) for name, power in powers.items() if power > 0)
    down = "·".join(_power(name, -power) for name, power in powers.items() if power < 0)
    if not down:
        return up or "-"
    return f"{up or '1'}/({down})" if "·" in down else f"{up or '1'}/{down}"


def _add(powers: dict[str, int], unit: str, sign: int) -> None:
    over = unit.split("/")
    for place, part in enumerate(over):
        for piece in part.split():
            name, _, exponent = piece.partition("^")
            if name not in ("1", "-"):
                powers[name] = powers.get(name, 0) + (sign if place == 0 else -sign) * int(
                    exponent or 1
                )


def _power(name: str, power: int) -> str:
    return name + {1: "", 2: "²", 3: "³", 4: "⁴"}.get(power, f"^{power}")
