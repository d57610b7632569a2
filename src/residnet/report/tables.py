"""Tables of the report: numbers of a run folder as text, rounded, in the units of their headers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS
from residnet.physics.terms import parse_term
from residnet.report.figures.style import label
from residnet.report.run_reader import Row, RunFiles

DEG = 180.0 / math.pi
_SHOWN_UNITS = {"rad": ("deg", DEG), "rad/s": ("deg/s", DEG)}
_TITLES = {"u": "surge u", "v": "sway v", "r": "yaw rate r", "p": "roll rate p"}
_EXTRA_UNITS = {"wind_u": "m/s", "wind_v": "m/s", "wind_mag": "m/s"}


@dataclass(frozen=True)
class Cell:
    """A number as text, with a note under it, and whether it stands out."""

    text: str
    note: str = ""
    mark: str = ""


@dataclass
class Table:
    """A table: `groups` are headers that span several columns (text, span), `heads` the columns,
    rows begin with their label.
    """

    heads: list[str]
    rows: list[tuple[str, list[Cell]]] = field(default_factory=list)
    groups: list[tuple[str, int]] = field(default_factory=list)
    corner: str = "model"


def unit_of(run: RunFiles, channel: str) -> tuple[str, float]:
    """Unit in which a channel is shown, and the factor to it from SI."""
    unit = (run.metrics.get("channels") or {}).get(channel) or CHANNEL_UNITS.get(channel, "-")
    return _SHOWN_UNITS.get(unit, (unit, 1.0))


def title_of(channel: str) -> str:
    """Channel in words."""
    return _TITLES.get(channel, channel)


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits, without an exponent where it is of common size; a
    dash for none.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not -4 <= size < 6:
        return f"{value:.{digits - 1}e}".replace("-", "−")
    return f"{value:.{max(digits - 1 - size, 0)}f}".replace("-", "−")


def percent(value: float) -> str:
    """Change in percent with its sign."""
    return f"{value:+.0f} %".replace("-", "−") if abs(value) >= 0.5 else "0 %"


def change(value: float, reference: float) -> str:
    """Change of an error against a reference, in percent; empty where there is no reference."""
    return percent(100 * (value / reference - 1)) if reference > 0 else ""


def free_runs(run: RunFiles, protocol: str) -> Table | None:
    """One line for each model; train and test (or whatever splits the run has) side by side for
    every quantity.
    """
    sides = [
        split for split in run.sides if any(run.row(model, split, protocol) for model in run.kinds)
    ]
    if not sides:
        return None
    quantities = [*run.channels, "nrmse", "position", "heading", "diverged"]
    titles = {
        channel: f"{title_of(channel)} [{unit_of(run, channel)[0]}]" for channel in run.channels
    }
    titles |= {
        "nrmse": "NRMSE, mean [-]",
        "position": "position, end [m]",
        "heading": "heading, end [deg]",
        "diverged": "diverged",
    }
    table = Table(
        heads=[split for _ in quantities for split in sides],
        groups=[(titles[key], len(sides)) for key in quantities],
    )
    for model in run.kinds:
        found = [run.row(model, split, protocol) for split in sides]
        reference = [
            (
                run.row(run.baseline, split, protocol)
                if run.kinds[model] not in ("zero", "baseline")
                else None
            )
            for split in sides
        ]
        cells = [
            _quantity(run, key, row, base)
            for key in quantities
            for row, base in zip(found, reference, strict=True)
        ]
        table.rows.append((label(run, model), cells))
    return table


def by_manoeuvre(run: RunFiles, protocol: str, split: str) -> Table | None:
    """The focus split taken apart by kind and named group of manoeuvre; None where there is only
    one.
    """
    kinds = distinct(run, run.manoeuvres(split, protocol), split, protocol)
    if len(kinds) < 2:
        return None
    quantities = [*run.channels, "nrmse", "position", "heading", "diverged"]
    heads = [f"{title_of(channel)} [{unit_of(run, channel)[0]}]" for channel in run.channels]
    table = Table(
        heads=["runs", *heads, "NRMSE [-]", "position, end [m]", "heading, end [deg]", "diverged"],
        corner="manoeuvre, model",
    )
    for kind in kinds:
        for place, model in enumerate(model for model, role in run.kinds.items() if role != "zero"):
            row = run.row(model, split, protocol, kind)
            if row is None:
                continue
            base = (
                run.row(run.baseline, split, protocol, kind)
                if run.kinds[model] != "baseline"
                else None
            )
            cells = [
                Cell(str(row["windows"])),
                *(_quantity(run, key, row, base) for key in quantities),
            ]
            name = (
                f"{kind.replace('_', ' ')}: {label(run, model)}"
                if place == 0
                else label(run, model)
            )
            if place == 0:
                cells = [
                    Cell(cell.text, cell.note, (cell.mark + " first").strip()) for cell in cells
                ]
            table.rows.append((name, cells))
    return table


def distinct(run: RunFiles, kinds: Sequence[str], split: str, protocol: str) -> list[str]:
    """Kinds and groups without those that hold the same runs as one before (a group of a single
    kind).
    """
    seen: list[Any] = []
    out: list[str] = []
    for kind in kinds:
        errors = [
            (row["windows"], row["rmse"])
            for model in run.kinds
            if (row := run.row(model, split, protocol, kind)) is not None
        ]
        if errors not in seen:
            seen.append(errors)
            out.append(kind)
    return out


def _quantity(run: RunFiles, key: str, row: Row | None, base: Row | None) -> Cell:
    if row is None:
        return Cell("–")
    if key == "diverged":
        return Cell(f"{row['diverged']}/{row['windows']}", mark="bad" if row["diverged"] else "")
    if key == "position":
        return Cell(number(row.get("position_error_end"), 2))
    if key == "heading":
        return Cell(
            number(DEG * row["heading_error_end"], 2) if "heading_error_end" in row else "–"
        )
    if key == "nrmse":
        interval = row.get("nrmse_mean_ci95")
        note = f"{number(interval[0])}–{number(interval[1])}" if interval else ""
        return Cell(number(row["nrmse"]["mean"]), note)
    value = row["rmse"].get(key)
    if value is None:
        return Cell("–")
    worse = base is not None and value > 1.005 * base["rmse"][key]
    return Cell(
        number(unit_of(run, key)[1] * value),
        change(value, base["rmse"][key]) if base is not None else "",
        "bad" if worse else "",
    )


def baseline_parameters(run: RunFiles, model: str) -> Table | None:
    """Identified coefficients of a baseline with standard errors; None where the folder does not
    hold them.
    """
    entries = run.fit(model).get("coefficients") or []
    if not entries:
        return None
    table = Table(heads=["value", "standard error", "value / error", "unit"], corner="term")
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
        table.rows.append((f"{entry['axis'].replace('_dot', '')}′: {entry['term']}", cells))
    return table


def term_unit(axis: str, term: str) -> str:
    """Unit of a coefficient: that of the acceleration over that of its term; empty where a factor's
    unit is not known.
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


def heads(run: RunFiles) -> Table | None:
    """What was learned: kind, what chose its complexity, parameters, time, the error that the
    selection compares.
    """
    if not any(run.fit(model) for model in run.heads):
        return None
    protocol = run.protocols[0]
    table = Table(
        heads=[
            "kind",
            "complexity",
            "parameters",
            "sees; stands on",
            "fit [s]",
            "epochs",
            "validation NRMSE [-]",
        ],
        corner="head",
    )
    for model in run.heads:
        notes, card = run.fit(model), run.card(model)
        head = card.get("head") or {}
        row = run.row(model, "validation", protocol)
        error = row["nrmse"]["mean"] if row else notes.get("validation")
        count = notes.get("parameters") or (
            3 * (int(notes["terms"]) + 1) if "terms" in notes else None
        )
        cells = [
            Cell(str(head.get("kind") or card.get("role", "–"))),
            Cell(_complexity(notes, head), mark="text"),
            Cell(f"{count:,}".replace(",", "\u2009") if count else "–"),
            Cell(_foundation(notes, head), mark="text"),
            Cell(number(notes.get("seconds"), 2)),
            Cell(str(notes.get("epochs", "–"))),
            Cell(number(error), mark="best" if model == run.selected else ""),
        ]
        table.rows.append((label(run, model), cells))
    return table


def _foundation(notes: Row, head: Row) -> str:
    """What a head sees and the baseline below it, or the members of an ensemble."""
    if notes.get("members"):
        return "mean of " + ", ".join(notes["members"])
    if not head:
        return "refitted through rollouts" if notes.get("refit") else "least squares"
    sees = ", ".join(head.get("features") or []) or "all channels"
    return (
        f"{sees}; {notes['baseline']}" if notes.get("baseline", "baseline") != "baseline" else sees
    )


def _complexity(notes: Row, head: Row) -> str:
    parts = []
    if "terms" in notes:
        parts.append(f"{notes['terms']} basis functions")
    if "order" in notes:
        parts.append(f"order {notes['order']} (latent variables)")
    if "penalty" in notes:
        penalties = notes["penalty"] if isinstance(notes["penalty"], list) else [notes["penalty"]]
        parts.append("penalty " + ", ".join(f"{value:g}" for value in penalties))
    if "hidden" in head:
        parts.append("layers of " + ", ".join(str(units) for units in head["hidden"]))
    if "hidden_size" in head:
        parts.append(
            f"{head['hidden_size']} hidden units"
            + (" for each axis" if head.get("per_axis") else "")
        )
    return "; ".join(parts) or "–"


def quality(run: RunFiles) -> tuple[Table, Table] | None:
    """What the logs hold: by split and kind of manoeuvre, and log by log."""
    if not run.quality:
        return None
    columns = ["logs", "seconds", "samples", "scored [%]", "learned from [%]", "masked"]
    columns += ["largest |u| [m/s]", "largest |v| [m/s]", "largest |r| [deg/s]"]
    short, full = (
        Table(heads=columns, corner="split, manoeuvre"),
        Table(heads=columns[1:], corner="log"),
    )
    groups: dict[tuple[str, str], list[Row]] = {}
    for entry in run.quality:
        groups.setdefault((entry["split"], entry.get("manoeuvre") or "–"), []).append(entry)
        full.rows.append((entry["log"], _log_cells([entry])))
    last = None
    for (split, manoeuvre), members in groups.items():
        cells = [Cell(str(len(members))), *_log_cells(members)]
        if split != last:
            cells = [Cell(cell.text, cell.note, (cell.mark + " first").strip()) for cell in cells]
        short.rows.append((f"{split}: {manoeuvre.replace('_', ' ')}", cells))
        last = split
    return short, full


def _log_cells(entries: Sequence[Row]) -> list[Cell]:
    samples = sum(entry["samples"] for entry in entries)
    masked: dict[str, float] = {}
    for entry in entries:
        for reason, share in (entry.get("masked") or {}).items():
            masked[reason] = masked.get(reason, 0.0) + share * entry["samples"] / samples

    def mean(key: str) -> Cell:
        return Cell(number(100 * sum(entry[key] * entry["samples"] for entry in entries) / samples))

    def largest(channel: str, factor: float) -> Cell:
        return Cell(
            number(
                factor
                * max((entry.get("largest") or {}).get(channel, math.nan) for entry in entries)
            )
        )

    reasons = (
        ", ".join(f"{reason} {100 * share:.2g} %" for reason, share in masked.items()) or "nothing"
    )
    seconds = sum(entry["seconds"] for entry in entries)
    reach = [largest("u", 1), largest("v", 1), largest("r", DEG)]
    return [
        Cell(f"{seconds:.0f}"),
        Cell(str(samples)),
        mean("usable"),
        mean("learned_from"),
        Cell(reasons, mark="text"),
        *reach,
    ]


def provenance(run: RunFiles) -> list[tuple[str, Any]]:
    """Facts about how the run came to be."""
    record = run.provenance
    out: list[tuple[str, Any]] = []
    named = {"git": "git revision", "python": "Python", "started": "started (UTC)"}
    for key in ("residnet", "git", "seed", "python", "machine", "started"):
        if record.get(key) is not None:
            out.append((named.get(key, key), record[key]))
    if record.get("seconds") is not None:
        out.append(("duration", f"{record['seconds']:.0f} s"))
    if record.get("packages"):
        out.append(
            (
                "packages",
                ", ".join(
                    f"{name} {version}" for name, version in record["packages"].items() if version
                ),
            )
        )
    if record.get("config"):
        out.append(("configuration", record["config"]))
    if record.get("overrides"):
        out.append(("overrides", " ".join(record["overrides"])))
    return out
