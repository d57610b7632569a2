"""The report of simulated manoeuvres: indices of every flight, tracks and time histories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.figures.files import figures_section
from residnet.report.format import DASH, fixed, number, shown_unit
from residnet.report.interactive.flights import flight_explorer
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.indices import index_title

_EACH = 12
"""Most flights that have a table each; more stand together by kind of manoeuvre."""


def sections(run: RunFiles) -> list[Section]:
    """Return the manoeuvring indices and the figures that stand in the folder."""
    content = run.json("indices.json")
    out = [_indices(content)] if content.get("rows") else []
    flown = {"flown": run.path / "logs"}
    if (run.path / "model_logs").is_dir():
        flown = {"vessel": run.path / "logs", "model": run.path / "model_logs"}
    explorer = flight_explorer(flown)
    if explorer is not None:
        out.append(Section("Runs to look into", [explorer]))
    figures = figures_section(run.path / "figures", "tracks.*|history_.*")
    return [*out, figures] if figures else out


def _indices(content: Content) -> Section:
    blocks: list[Block] = []
    faulty = [row for row in content["rows"] if row["fault"]]
    if faulty:
        faults = [f"{row['craft']}, {row['log']}: {row['fault']}" for row in faulty]
        blocks.append(Bullets(faults, warning=True))
    blocks.append(Text(_about(content), quiet=True))
    blocks += [Section(title, [table]) for title, table in index_tables(content)]
    return Section("Manoeuvring indices", blocks)


def _about(content: Content) -> str:
    length = content.get("length")
    if length is None:
        text = "The length of the hull is not known, so there are no values in hull lengths."
    else:
        text = (
            f"L: hull lengths of {number(length)} m. The limits are those of IMO resolution"
            " MSC.137(76), where they apply to a manoeuvre."
        )
    without = dict.fromkeys(
        str(row["manoeuvre"]).replace("_", " ") for row in content["rows"] if not row["indices"]
    )
    if without:
        text += f" Flights without indices: {', '.join(without)}."
    return text


def indices_text(content: Content) -> str:
    """Return the indices for the terminal.

    Args:
        content: of indices.json.
    """
    return "\n\n".join(f"{title}\n{table.text()}" for title, table in index_tables(content))


def index_tables(content: Content) -> list[tuple[str, Table]]:
    """Return titles and tables of manoeuvring indices.

    Few flights have a table each, with a row for each index; more stand in one table for each kind
    of manoeuvre, with a row for each flight.

    Args:
        content: of indices.json.
    """
    by_log: dict[str, list[Content]] = {}
    for row in content["rows"]:
        by_log.setdefault(str(row["log"]), []).append(row)
    if len(by_log) <= _EACH:
        tables = [(log.replace("_", " "), _of_log(content, rows)) for log, rows in by_log.items()]
    else:
        kinds = dict.fromkeys(str(row["manoeuvre"]) for row in content["rows"])
        tables = [(kind.replace("_", " "), _of_kind(content, kind)) for kind in kinds]
    return [(title, table) for title, table in tables if table.rows and len(table.columns) > 1]


def _of_log(content: Content, rows: Sequence[Content]) -> Table:
    """Return a row for each index of one log; of two crafts the second is compared to the first."""
    crafts = [str(row["craft"]) for row in rows]
    names = _single_values(rows)
    lengths = any(f"{name}_lengths" in row["indices"] for row in rows for name in names)
    limited = any(row["limits"] for row in rows)
    table = Table(
        [
            "index",
            "unit",
            *crafts,
            *(["difference"] if len(rows) == 2 else []),
            *([f"{craft} [L]" for craft in crafts] if lengths else []),
            *(["IMO limit"] if limited else []),
        ]
    )
    for name in names:
        unit, factor = shown_unit(str(content["units"].get(name, "-")))
        values = [row["indices"].get(name) for row in rows]
        cells = [Cell(unit), *(_value(value, factor) for value in values)]
        if len(rows) == 2:
            apart = None if None in values else factor * (values[1] - values[0])
            cells.append(Cell(number(apart)))
        if lengths:
            cells += [_in_lengths(row["indices"].get(f"{name}_lengths")) for row in rows]
        if limited:
            cells.append(_limit(rows, name, factor))
        table.add(index_title(name), cells)
    return table


def _of_kind(content: Content, kind: str) -> Table:
    """Return a row for each flight of one kind of manoeuvre."""
    rows = [row for row in content["rows"] if row["manoeuvre"] == kind]
    names = _single_values(rows)
    units = {name: shown_unit(str(content["units"].get(name, "-"))) for name in names}
    several = len({row["craft"] for row in rows}) > 1
    table = Table(["log", *(f"{index_title(name)} [{units[name][0]}]" for name in names)])
    for row in rows:
        label = f"{row['log']} ({row['craft']})" if several else str(row["log"])
        cells = [_value(row["indices"].get(name), units[name][1]) for name in names]
        for place, name in enumerate(names):
            limit = row["limits"].get(name)
            if limit and not limit["kept"]:
                cells[place] = Cell(cells[place].text, "beyond the IMO limit", "bad")
        table.add(label, cells)
    return table


def _single_values(rows: Sequence[Content]) -> list[str]:
    """Return the names of indices that are one number each; lengths are shown beside them."""
    names = dict.fromkeys(name for row in rows for name in row["indices"])
    return [
        name
        for name in names
        if not name.endswith("_lengths")
        and not any(isinstance(row["indices"].get(name), list) for row in rows)
    ]


def _value(value: float | None, factor: float) -> Cell:
    return Cell(DASH) if value is None else Cell(number(factor * value, 4))


def _in_lengths(value: float | None) -> Cell:
    return Cell("") if value is None else Cell(fixed(value, 2))


def _limit(rows: Sequence[Mapping[str, Any]], name: str, factor: float) -> Cell:
    limits = [row["limits"][name] for row in rows if name in row["limits"]]
    if not limits:
        return Cell("")
    kept = all(limit["kept"] for limit in limits)
    text = number(factor * limits[0]["limit"], 4)
    return Cell(text, "kept" if kept else "exceeded", "" if kept else "bad")
