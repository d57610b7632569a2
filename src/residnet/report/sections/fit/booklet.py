"""The manoeuvring booklet: standard manoeuvres with intervals and limits, and repeated zigzags."""

from __future__ import annotations

import math

from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.figures.booklet import page_title
from residnet.report.format import DASH, interval, number, plural, shown_unit
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.indices import index_title

_COMPARED = (
    "first_overshoot",
    "second_overshoot",
    "initial_turning_time",
    "reach",
    "period",
    "largest_yaw_rate",
)


def section(run: RunFiles) -> Section | None:
    """Return a table for each standard manoeuvre and one that compares measured zigzags.

    None where the run has no booklet.json.
    """
    booklet = run.json("booklet.json")
    if not booklet:
        return None
    blocks: list[Block] = [Text(_about(booklet))]
    for page in booklet["pages"]:
        if not page["split"]:
            parts: list[Block] = [_table(booklet, page)]
            if page["faults"]:
                draws = plural(page["faults"], "draw")
                text = f"The intervals leave out {draws} that did not end the manoeuvre."
                parts.append(Bullets([text], warning=True))
            blocks.append(Section(page_title(page), parts))
    repeated = [page for page in booklet["pages"] if page["split"]]
    if repeated:
        about = (
            "The model steers the rudder angle of each trial and reverses it at the trial's"
            f" headings, from the state that the trial began with. {_worst(repeated)}"
        )
        title = "Measured zigzags, repeated in closed loop"
        blocks.append(Section(title, [Text(about), _repeated(booklet, repeated)]))
    return Section("Manoeuvring booklet", blocks)


def _about(booklet: Content) -> str:
    scale, length = float(booklet["scale"]), float(booklet["length"])
    hull = f"a hull of {number(length)} m"
    if scale != 1:
        hull += f", a model at 1:{number(scale)}"
    ship = " The column ship scales the values by Froude's law." if scale != 1 else ""
    return (
        f"Model {booklet['model']} ran these manoeuvres for {hull}.{ship} The intervals"
        f" ({100 * booklet['level']:.0f} %) come from {booklet['draws']} draws of the parameters"
        " from their uncertainty after the trials. They assume that the model's form is right."
    )


def _table(booklet: Content, page: Content) -> Table:
    ship = float(booklet["scale"]) != 1
    columns = [
        "index",
        "value",
        f"{100 * booklet['level']:.0f} % interval",
        "unit",
        "lengths",
        *(["ship"] if ship else []),
        "IMO limit",
        "kept by",
    ]
    table = Table(columns)
    for name, found in page["indices"].items():
        unit, factor = shown_unit(booklet["units"][name])
        cells = [
            Cell(number(factor * found["value"])),
            Cell(interval(found.get("interval"), factor)),
            Cell(unit),
            Cell(number(found["lengths"]) if "lengths" in found else ""),
        ]
        cells += [Cell(number(factor * found["ship"]))] if ship else []
        share = found.get("kept_share")
        kept = "" if share is None else f"{100 * share:.0f} % of draws"
        cells += [
            Cell(number(factor * found["limit"]) if "limit" in found else ""),
            Cell(kept, mark="" if found.get("kept", True) else "bad"),
        ]
        table.add(index_title(name), cells)
    return table


def _repeated(booklet: Content, pages: list[Content]) -> Table:
    """Return measured and predicted indices of the repeated zigzags, a row for each."""
    used = [
        name
        for name in _COMPARED
        if any("measured" in page["indices"].get(name, {}) for page in pages)
    ]
    groups = [
        (f"{index_title(name)} [{shown_unit(booklet['units'][name])[0]}]", 3) for name in used
    ]
    table = Table(["log", *["measured", "model", "difference"] * len(used)], groups=groups)
    for page in pages:
        cells: list[Cell] = []
        for name in used:
            found = page["indices"].get(name, {})
            factor = shown_unit(booklet["units"][name])[1]
            if "measured" not in found:
                cells += [Cell(DASH), Cell(DASH), Cell(DASH)]
                continue
            cells += [
                Cell(number(factor * found["measured"])),
                Cell(number(factor * found["value"]), note=interval(found.get("interval"), factor)),
                Cell(number(factor * found["difference"], 2)),
            ]
        table.add(page_title(page), cells)
    return table


def _worst(pages: list[Content]) -> str:
    """Return the largest difference of the first overshoot as a sentence."""
    apart = [
        abs(page["indices"]["first_overshoot"]["difference"])
        for page in pages
        if "difference" in page["indices"].get("first_overshoot", {})
    ]
    return (
        f"First overshoots differ by at most {number(math.degrees(max(apart)), 2)} deg."
        if apart
        else ""
    )
