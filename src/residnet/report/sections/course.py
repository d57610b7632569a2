"""The report of a course run: how each controller passes the buoys, and how long it takes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from residnet.core.format import DEG, number
from residnet.report.blocks import Block, Cell, Column, Section, Table, Text, bad_where, table_of
from residnet.report.figure import COLORS, ZERO, Case, Curve, Figure, Look, Panel, joined, names_of
from residnet.report.figure_files import figures_section, read_figures, write_figures
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
_DASHES = {"course": "solid", "lookahead": "long", "enclosure": "short", "integral": "dense"}
_WORDS = {
    "course": "",
    "lookahead": ", look-ahead",
    "enclosure": ", enclosure",
    "integral": ", integral",
}
_PANELS = (
    ("psi", "heading\n[deg]", DEG),
    ("rudder", "rudder\n[deg]", DEG),
    ("cross_track", "cross-track\nerror [m]", 1.0),
    ("speed", "speed\n[m/s]", 1.0),
)


def _figures(run: RunFiles) -> Iterator[Figure]:
    flown, plans, every = run.frame(TRACKS), run.frame(COURSES), run.frame(SPREAD)
    looks = _looks(flown, "controller")
    yield Figure(
        "courses",
        "Flights past the buoys",
        f"{' '.join(RULES[name] for name in run.resolved['protocols'])} North is up, and scales of"
        " the track are equal. S and P name the side on which a buoy is left, dotted circles are"
        " those of the buoys, and the triangle is the start; dotted lines are the limits of the"
        " rudder. A track that leaves the picture has lost the course. A controller that leaves the"
        " plan early has to steer more later; look for rudder angles at the limit and for errors"
        " that grow from buoy to buoy.",
        {
            **looks,
            "plan": Look("plan", "#BFBFBF", width=5.0, order=1),
            "limits": replace(ZERO, label="limits of the rudder", dash="dotted"),
            "circles": Look("circles of the buoys", "#737373", "dotted", 0.9, order=1),
            "buoys": Look("buoys", kind="points", size=3.5, order=4),
            "start": Look("start", kind="points", marker="^", size=6, order=4),
        },
        [
            Panel("north [m]", "east [m]", kind="map", height=420),
            *(Panel(title, height=145) for _, title, _ in _PANELS[:-1]),
            Panel(_PANELS[-1][1], "time [s]", height=145),
        ],
        [
            _case(run, protocol, radii, *(t[t["protocol"] == protocol] for t in (flown, plans)))
            for protocol, radii in _radii(run).items()
        ],
        "Protocol",
    )
    if every is not None:
        yield _spread(every)


def _looks(flights: Any, column: str) -> dict[str, Look]:
    """Return how the flights of each controller and guidance look."""
    controllers = flights[column].drop_duplicates().tolist()
    pairs = flights[[column, "guidance"]].drop_duplicates()
    return {
        f"{name}{_WORDS[guidance]}": Look(
            f"{name}{_WORDS[guidance]}",
            COLORS[controllers.index(name) % len(COLORS)],
            _DASHES[guidance],
            # flights that coincide show beside each other
            max(2.6 - 0.7 * controllers.index(name), 1.0),
        )
        for name, guidance in pairs.itertuples(index=False, name=None)
    }


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


def _case(run: RunFiles, protocol: str, radii: Sequence[float], flown: Any, plan: Any) -> Case:
    course = run.resolved["course"]
    east, north = (np.array([buoy[name] for buoy in course["buoys"]]) for name in ("east", "north"))
    angle = np.linspace(0.0, 2.0 * np.pi, 37)
    circles = [
        (x + r * np.sin(angle), y + r * np.cos(angle))
        for x, y, r in zip(east, north, radii, strict=True)
    ]
    limit = DEG * np.array([-1.0, 1.0]) * run.metrics["rudder"]
    track: dict[str, Curve] = {
        "plan": (plan["east"].to_numpy(float), plan["north"].to_numpy(float)),
        "circles": joined(circles),
        "buoys": (east, north),
        "start": (np.array([course["start"][1]]), np.array([course["start"][0]])),
    }
    panels: list[dict[str, Curve]] = [track, *({} for _ in _PANELS)]
    panels[2]["limits"] = (np.zeros(2), limit)
    # what leaves the picture has lost the course
    seen = [np.concatenate((plan[name], at)) for name, at in (("east", east), ("north", north))]
    edge = 0.3 * max(map(np.ptp, seen)) + max(radii)
    for (controller, guidance), flight in flown.groupby(["controller", "guidance"], sort=False):
        name = f"{controller}{_WORDS[guidance]}"
        values = {key: flight[key].to_numpy(float) for key in ("east", "north", "t")}
        lost = np.zeros(len(flight), dtype=bool)
        for key, known in zip(("east", "north"), seen, strict=True):
            lost |= (values[key] < known.min() - edge) | (values[key] > known.max() + edge)
        east_of, north_of = (np.where(lost, np.nan, values[key]) for key in ("east", "north"))
        track[name] = (east_of, north_of)
        for panel, (quantity, _, factor) in zip(panels[1:], _PANELS, strict=True):
            panel[name] = (values["t"], factor * flight[quantity].to_numpy(float))
    sides = [
        (0, float(x), float(y), f"{number}{buoy['leave_to'][0].upper()}")
        for number, (x, y, buoy) in enumerate(zip(east, north, course["buoys"], strict=True), 1)
    ]
    return Case(protocol, panels, RULES[protocol], texts=sides)


def _spread(every: Any) -> Figure:
    """Draw the course time of every flight of the spread over that of the reference."""
    looks = _looks(every, "model")
    cases = []
    for protocol, flights in every.groupby("protocol", sort=False):
        panel: dict[str, Curve] = {}
        medians = []
        kinds = {f"{m}{_WORDS[g]}": rows for (m, g), rows in flights.groupby(["model", "guidance"])}
        for line, name in enumerate(looks):
            done = kinds[name][kinds[name]["finished"]] if name in kinds else flights[:0]
            beside = line + 0.5 * (np.arange(len(done)) / max(len(done) - 1, 1) - 0.5)
            for passed, ending in ((True, ""), (False, ", missed")):
                rows = (done["passed"] == passed).to_numpy(bool)
                panel[name + ending] = (done["ratio"].to_numpy(float)[rows], beside[rows])
            if len(done):
                medians.append(([done["ratio"].median()] * 2, [line - 0.38, line + 0.38]))
        panel["median"] = joined(medians)
        lost = len(flights) - int(flights["finished"].sum())
        note = f"{lost} of {len(flights)} flights did not finish and are left out." if lost else ""
        cases.append(Case(str(protocol), [panel], f"{RULES[str(protocol)]} {note}".strip()))
    marks = {}
    for name, look in looks.items():
        marks[name] = replace(look, kind="points", size=4)
        marks[f"{name}, missed"] = replace(marks[name], hollow=True, label="")
    return Figure(
        "spread",
        "Spread of vessels and currents",
        "Each point is one vessel in one current. It is filled where all buoys were passed as"
        " demanded, and a ring elsewhere; the bar is the median. Flights that did not finish are"
        " left out.",
        marks | {"median": Look("median", width=1.2, order=4)},
        [
            Panel(
                "",
                "course time over that of the reference, in water at rest",
                height=75 + 36 * len(looks),
                y_names=names_of(looks),
                y_limits=(len(looks) - 0.5, -0.5),
            )
        ],
        cases,
        "Protocol",
    )


def sections(run: RunFiles) -> list[Section]:
    """Return times and margins by protocol, what the numbers mean, and the figures.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    write_figures(run.path / "figures", _figures(run))
    out: list[Section] = []
    for protocol, (nominal, drawn) in _by_protocol(run.rows).items():
        flown = nominal_table(nominal)
        blocks: list[Block] = [Text(_rule(nominal)), flown]
        if not out:
            drawing = [one.part() for one in read_figures(run.path / "figures", "courses")]
            out.append(Section("", [*drawing, flown.part(0, 4)]))
        if drawn:
            blocks.append(Section("Spread of vessels and currents", [spread_table(drawn)]))
        out.append(Section(f"Protocol {protocol}", blocks))
    out.append(Section("What the numbers mean", [Text(_definition(run))]))
    return [*out, *figures_section(run.path / "figures")]


def _by_protocol(rows: Sequence[Content]) -> dict[str, tuple[list[Content], list[Content]]]:
    """Return the rows of the nominal flights and of the spread by protocol."""
    out: dict[str, tuple[list[Content], list[Content]]] = {}
    for row in rows:
        nominal, spread = out.setdefault(row["protocol"], ([], []))
        (spread if row["split"] == "spread" else nominal).append(row)
    return out


def _rule(nominal: Sequence[Content]) -> str:
    shortest = f"The reference takes {nominal[0]['reference_time']:.2f} s."
    return f"{RULES[nominal[0]['protocol']]} {shortest}"


def text_of(rows: Sequence[Content]) -> str:
    """Return the tables of a course run, of the rows of metrics.json, for the terminal."""
    parts = []
    for nominal, drawn in _by_protocol(rows).values():
        parts += [_rule(nominal), nominal_table(nominal).text()]
        parts += [spread_table(drawn).text()] if drawn else []
    return "\n".join(parts)


def nominal_table(rows: Sequence[Content]) -> Table:
    """Return time, margin and cross-track error of the nominal flights of one protocol."""

    def of_all(key: str) -> Any:
        return lambda row: bad_where(f"{row[key]} of {row['n']}", row[key] != row["n"])

    passed: list[Column] = [("on its side", of_all("right_side")), ("clear", of_all("clear"))]
    if rows[0]["protocol"] == "enter":
        passed = [("entered", of_all("entered"))]
    return table_of(
        rows,
        [
            ("controller", "model"),
            ("guidance", "guidance"),
            ("time [s]", "course_time", 2),
            *passed,
            ("ratio", "ratio", 4),
            ("ratio, turning", "ratio_turning", 4),
            ("margin [m]", "margin", 3),
            ("tightest turn [m]", "tightest_turn", 2),
            ("cross-track, rms [m]", "cross_track_rms", 3),
            ("cross-track, largest [m]", "cross_track_max", 3),
            ("rudder travel [deg]", "travel", 1, DEG),
            ("finished", lambda row: Cell("yes") if row["finished"] else bad_where("no", True)),
        ],
        selected=_chosen,
    )


def spread_table(rows: Sequence[Content]) -> Table:
    """Return shares and medians over the flights of the spread of one protocol."""
    return table_of(
        rows,
        [
            ("controller", "model"),
            ("guidance", "guidance"),
            ("passed [%]", "passed", 1, 100),
            ("finished [%]", "finished", 1, 100),
            ("ratio, median", "ratio", 4),
            ("ratio, worst", "ratio_worst", 4),
            ("margin, median [m]", "margin", 3),
            ("margin, worst [m]", "margin_worst", 3),
            ("cross-track, rms [m]", "cross_track_rms", 3),
        ],
        selected=_chosen,
        caption=f"{rows[0]['n']} vessels and currents for each controller and guidance.",
    )


def _chosen(row: Content) -> bool:
    return bool(row["kind"] == "policy" and row["guidance"] == "course")


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
        "The reference is the shortest course that was found of straight lines and arcs of this"
        " radius, for a vessel that yaws at once and keeps no margin. Ratio:"
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
