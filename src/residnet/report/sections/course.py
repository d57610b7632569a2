"""The report of a course run: how each controller passes the buoys, and how long it takes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from residnet.report.blocks import Block, Cell, Figure, Section, Table, Text
from residnet.report.figures.courses import histories, spread, tracks
from residnet.report.figures.files import Drawing, figures_section, write_drawings
from residnet.report.format import DEG, fixed, number
from residnet.report.interactive.courses import course_explorer
from residnet.report.run_reader import Content, RunFiles

TRACKS = "tracks.parquet"
"""Flights of the nominal vessel."""
COURSES = "courses.parquet"
"""The plans."""
SPREAD = "spread.parquet"
"""One line for each flight of the spread, where there is one."""
RULES = {
    "enter": "Every buoy's circle of acceptance is to be entered.",
    "sides": "Every buoy is to be passed on its side, outside its circle.",
}
"""What each protocol demands."""


def draw(run: RunFiles) -> list[Figure]:
    """Write the figures of a course run from its folder alone; returns them."""
    return write_drawings(run.path / "figures", _drawings(run))


def _drawings(run: RunFiles) -> Iterator[Drawing]:
    course = run.resolved["course"]
    flown, plans, every = run.frame(TRACKS), run.frame(COURSES), run.frame(SPREAD)
    for protocol, radii in _radii(run).items():
        rule = RULES[protocol]
        flights = flown[flown["protocol"] == protocol]
        plan = plans[plans["protocol"] == protocol]
        name = f"{protocol}_tracks"
        yield tracks(name, flights, plan, course["buoys"], radii, course["start"], rule)
        yield histories(f"{protocol}_time", flights, run.metrics["rudder"], rule)
        if every is not None:
            yield spread(f"{protocol}_spread", every[every["protocol"] == protocol], rule)


def _radii(run: RunFiles) -> dict[str, list[float]]:
    """Return the radii in m of the buoys' circles by protocol."""
    course, smallest = run.resolved["course"], run.metrics["smallest"]["radius"]
    return {
        protocol: [
            course["acceptance"] if protocol == "enter" else max(buoy["radius"], smallest)
            for buoy in course["buoys"]
        ]
        for protocol in run.resolved["protocols"]
    }


def sections(run: RunFiles) -> list[Section]:
    """Return times and margins by protocol, what the numbers mean, and the figures.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    out = [_protocol(run, protocol) for protocol in run.resolved["protocols"]]
    flown, plans = run.frame(TRACKS), run.frame(COURSES)
    if flown is not None and plans is not None:
        buoys = run.resolved["course"]["buoys"]
        explorer = course_explorer(flown, plans, _radii(run), buoys, RULES)
        out.append(Section("Flights to look into", [explorer]))
    out.append(Section("What the numbers mean", [Text(_definition(run))]))
    figures = figures_section(run.path / "figures", ".*_(tracks|time)")
    return [*out, figures] if figures else out


def _protocol(run: RunFiles, protocol: str) -> Section:
    rows = [row for row in run.rows if row["protocol"] == protocol]
    nominal = [row for row in rows if row["split"] == "simulated"]
    shortest = f"The reference takes {nominal[0]['reference_time']:.2f} s."
    blocks: list[Block] = [Text(f"{RULES[protocol]} {shortest}"), nominal_table(nominal)]
    drawn = [row for row in rows if row["split"] == "spread"]
    if drawn:
        blocks.append(Section("Spread of vessels and currents", [spread_table(drawn)]))
    return Section(f"Protocol {protocol}", blocks)


def text_of(rows: Sequence[Content]) -> str:
    """Return the tables of a course run for the terminal.

    Args:
        rows: of metrics.json.
    """
    parts = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        found = [row for row in rows if row["protocol"] == protocol]
        nominal = [row for row in found if row["split"] == "simulated"]
        drawn = [row for row in found if row["split"] == "spread"]
        shortest = f"Reference: {nominal[0]['reference_time']:.2f} s."
        parts += [f"{RULES[protocol]} {shortest}", nominal_table(nominal).text()]
        parts += [spread_table(drawn).text()] if drawn else []
    return "\n".join(parts)


def nominal_table(rows: Sequence[Content]) -> Table:
    """Return time, margin and cross-track error of the nominal flights of one protocol."""
    enters = rows[0]["protocol"] == "enter"
    table = Table(
        [
            "controller",
            "guidance",
            "time [s]",
            "ratio",
            "ratio, turning",
            *(["entered"] if enters else ["on its side", "clear"]),
            "margin [m]",
            "tightest turn [m]",
            "cross-track, rms [m]",
            "cross-track, largest [m]",
            "rudder travel [deg]",
            "finished",
        ]
    )
    for row in rows:
        passed = [row["entered"]] if enters else [row["right_side"], row["clear"]]
        table.add(
            row["model"],
            [
                Cell(row["guidance"], mark="text"),
                fixed(row["course_time"], 2),
                fixed(row["ratio"], 4),
                fixed(row["ratio_turning"], 4),
                *(Cell(f"{n} of {row['n']}", mark="" if n == row["n"] else "bad") for n in passed),
                fixed(row["margin"], 3),
                fixed(row["tightest_turn"], 2),
                fixed(row["cross_track_rms"], 3),
                fixed(row["cross_track_max"], 3),
                fixed(DEG * row["travel"], 1),
                Cell("yes") if row["finished"] else Cell("no", mark="bad"),
            ],
            selected=row["kind"] == "policy" and row["guidance"] == "course",
        )
    return table


def spread_table(rows: Sequence[Content]) -> Table:
    """Return shares and medians over the flights of the spread of one protocol."""
    table = Table(
        [
            "controller",
            "guidance",
            "passed [%]",
            "finished [%]",
            "ratio, median",
            "ratio, worst",
            "margin, median [m]",
            "margin, worst [m]",
            "cross-track, rms [m]",
        ],
        caption=f"{rows[0]['n']} vessels and currents for each controller and guidance.",
    )
    for row in rows:
        table.add(
            row["model"],
            [
                Cell(row["guidance"], mark="text"),
                fixed(100 * row["passed"], 1),
                fixed(100 * row["finished"], 1),
                fixed(row["ratio"], 4),
                fixed(row["ratio_worst"], 4),
                fixed(row["margin"], 3),
                fixed(row["margin_worst"], 3),
                fixed(row["cross_track_rms"], 3),
            ],
            selected=row["kind"] == "policy" and row["guidance"] == "course",
        )
    return table


def _definition(run: RunFiles) -> list[str]:
    metrics, steady = run.metrics, run.metrics["smallest"]
    too_tight = [
        f"buoy {entry['buoy']} ({number(entry['radius'], 4)} m)"
        for entry in metrics["feasibility"]
        if not entry["possible"]
    ]
    followed = (
        f"The circles of {', '.join(too_tight)} are tighter than that; they are widened to it."
        if too_tight
        else "Every circle can be followed."
    )
    texts = [
        f"At {math.degrees(metrics['rudder']):.3g} deg of rudder the vessel turns with a radius of"
        f" {steady['radius']:.2f} m at {steady['speed']:.3g} m/s. {followed}",
        "The reference is a course of straight lines and arcs of this radius, for a vessel that"
        " yaws at once: the shortest that was found where buoys are entered, and the taut one round"
        " every buoy where they are passed on their sides. It is no lower bound: a buoy may also be"
        " passed without being rounded. Ratio:"
        f" course time over its length at the service speed of {metrics['speed']:.3g} m/s. Ratio,"
        " turning: the same at the speed that the vessel keeps in its smallest turn.",
        "On its side and clear: number of buoys left on their side, and outside their circles."
        " Margin: how far inside the circle that is entered least, or outside the one that is"
        " passed most closely. Tightest turn: smallest radius of a flight. The cross-track error is"
        " that from the plan, which a flight by line of sight does not follow.",
    ]
    return [*texts, _spread_definition(run)]


def _spread_definition(run: RunFiles) -> str:
    found = run.resolved.get("spread")
    if found is None:
        return ""
    (low, high), (quick, slow) = found["effect"], found["time"]
    bias = (
        f", a rudder bias of at most {math.degrees(found['bias']):.3g} deg"
        if found["bias"] > 0
        else ""
    )
    return (
        f"Spread: {found['flights']} vessels with {low:g} to {high:g} times the rudder's effect,"
        f" {quick:g} to {slow:g} times the time constants{bias}, in currents of"
        f" {found['current']:g} m/s from all directions. Ratios of course times do not allow for"
        " the current. Passed: share of the flights that passed all buoys as demanded."
    )
