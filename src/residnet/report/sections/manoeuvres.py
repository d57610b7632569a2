"""Manoeuvres of a vessel or a model: flights, their indices, and the manoeuvring booklet."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from residnet.core.format import DASH, DEG, fixed, interval, number, plural, shown_unit
from residnet.core.log import Log
from residnet.data.simulated import Flight
from residnet.manoeuvres.closed_loop import Spiral, Zigzag
from residnet.manoeuvres.courses import Waypoints
from residnet.manoeuvres.open_loop import Replay
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Section,
    Table,
    Text,
    bad_where,
    table_of,
)
from residnet.report.figure import (
    DASHED,
    GREY,
    MEASURED,
    SOLID,
    START,
    ZERO,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    band,
    joined,
    steps,
)
from residnet.report.figure_files import figures_section, read_figures
from residnet.report.run_reader import Content, RunFiles

_EACH = 12
"""Most flights that have a table and a picture each; of more, the first of each kind has."""
_MOST_CASES, _MOST_PANELS, _MOST_ZIGZAGS = 30, 12, 6
"""Flights and panels of the figure that is looked into, and zigzags of a picture.

Chosen by hand: the page stays a few megabytes, and a picture a page.
"""
_TITLES = {
    "time_90": "time to 90 deg",
    "time_180": "time to 180 deg",
    "steady_speed_ratio": "steady speed over approach speed",
    "pull_out_yaw_rate": "yaw rate after pull-out",
}
"""Names of indices that are not their key with spaces."""
_COMPARED = (
    "first_overshoot",
    "second_overshoot",
    "initial_turning_time",
    "reach",
    "period",
    "largest_yaw_rate",
)
_TELLING = (
    "tactical_diameter",
    "first_overshoot",
    "track_reach",
    "loop_height",
    "largest_cross_track_error",
)
"""The index of each kind of manoeuvre that stands on the first screen."""
_CHANNELS = {
    "u": "surge velocity\nu", "v": "sway velocity\nv", "r": "yaw rate\nr", "p": "roll rate\np",
    "psi": "heading\n", "phi": "roll angle\n", "w": "heave velocity\nw", "q": "pitch rate\nq",
    "z": "depth\n", "theta": "pitch angle\n",
    "cmd_delta": "rudder\ncommand", "cmd_n": "revolutions\ncommand", "cmd_port": "port command\n",
    "cmd_stbd": "starboard\ncommand",
}  # fmt: skip
_SHOWN = ("u", "v", "r", "p", "psi", "phi", "w", "q", "z", "theta")


def index_title(name: str) -> str:
    """Return a manoeuvring index in words."""
    return _TITLES.get(name, name.replace("_", " "))


def sections(run: RunFiles) -> list[Section]:
    """Return the manoeuvring indices and the figures that stand in the folder."""
    content = run.json("indices.json")
    flown = read_figures(run.path / "figures", "manoeuvres")
    out = []
    if content.get("rows"):
        out.append(Section("", [*(one.part() for one in flown), _flights(content)]))
        blocks: list[Block] = [Text(_about(content), quiet=True)]
        blocks += [Section(title, [table]) for title, table in index_tables(content)]
        out.append(Section("Manoeuvring indices", blocks))
    return [*out, *figures_section(run.path / "figures")]


def _flights(content: Content) -> Table:
    """Return a row for each flight: what went wrong, else the most telling of its indices."""

    def telling(row: Content) -> str:
        return next((name for name in _TELLING if name in row["indices"]), "")

    def outcome(row: Content) -> Cell | str:
        if row["fault"]:
            return bad_where(row["fault"], True)
        return index_title(telling(row)) or "ended as it should"

    def value(row: Content) -> str:
        found = _entries(row).get(telling(row))
        return DASH if found is None else "{} {}".format(*_shown(content, telling(row), found))

    rows = sorted(content["rows"], key=lambda row: not row["fault"])
    several = len({row["craft"] for row in rows}) > 1
    columns: list[Column] = [("flight", "log")]
    return table_of(
        rows[: max(_EACH, sum(bool(row["fault"]) for row in rows))],
        [
            *columns,
            *([("vessel", "craft")] if several else []),
            ("outcome", outcome),
            ("value", value, str),
        ],
    )


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
    return text + (f" Flights without indices: {', '.join(without)}." if without else "")


def indices_text(content: Content) -> str:
    """Return the contents of indices.json for the terminal."""
    return "\n\n".join(f"{title}\n{table.text()}" for title, table in index_tables(content))


def _entries(row: Content) -> dict[str, Content]:
    """Return the indices of a flight that are one number, with lengths and limits beside them."""
    found: Content = row["indices"]
    return {
        name: {
            "value": value,
            "lengths": found.get(f"{name}_lengths"),
            **row["limits"].get(name, {}),
        }
        for name, value in found.items()
        if not isinstance(value, list) and not name.endswith("_lengths")
    }


def _shown(content: Content, name: str, entry: Content, key: str = "value") -> tuple[str, str]:
    """Return a number of an index and its unit, as they are shown."""
    unit, factor = shown_unit(str(content["units"].get(name, "-")))
    value = entry.get(key)
    return number(None if value is None else factor * value, 4), unit


def index_tables(content: Content) -> list[tuple[str, Table]]:
    """Return titles and tables of the manoeuvring indices of indices.json.

    Few flights have a table each, with a row for each index; more stand in one table for each kind
    of manoeuvre, with a row for each flight.
    """
    groups: dict[str, list[Content]] = {}
    few = len({row["log"] for row in content["rows"]}) <= _EACH
    for row in content["rows"]:
        if _entries(row):
            groups.setdefault(str(row["log" if few else "manoeuvre"]), []).append(row)
    return [
        (
            name.replace("_", " "),
            _by_index(content, {row["craft"]: _entries(row) for row in rows})
            if few
            else _by_flight(content, rows),
        )
        for name, rows in groups.items()
    ]


def _by_index(content: Content, crafts: Mapping[str, Mapping[str, Content]]) -> Table:
    """Return a row for each index of one manoeuvre; of two crafts the second is compared to the
    first.

    Args:
        content: whose `units` are those of the indices.
        crafts: of what flew it `value` by index, and what there is of `lengths`, `interval` over
            draws, `ship` at full scale, `limit`, `kept` and `kept_share` of the draws.
    """
    every = [entry for of in crafts.values() for entry in of.values()]

    def shown(craft: str, key: str, name: str) -> str:
        return _shown(content, name, crafts[craft].get(name, {}), key)[0]

    def lengths(craft: str, name: str) -> str:
        found = crafts[craft].get(name, {}).get("lengths")
        return "" if found is None else fixed(found, 2)

    def apart(name: str) -> str:
        values: list[Any] = [of.get(name, {}).get("value") for of in crafts.values()]
        return _shown(content, name, {} if None in values else {"value": values[1] - values[0]})[0]

    def limit(name: str) -> Cell:
        found = [of[name] for of in crafts.values() if "limit" in of.get(name, {})]
        if not found:
            return Cell("")
        kept = all(entry["kept"] for entry in found)
        share = found[0].get("kept_share")
        note = ("kept" if kept else "exceeded") if share is None else f"kept by {100 * share:.0f} %"
        return Cell(_shown(content, name, found[0], "limit")[0], note, "" if kept else "bad")

    def within(name: str) -> str:
        (of,) = crafts.values()
        return interval(of[name].get("interval"), shown_unit(content["units"][name])[1])

    columns: list[Column] = [
        ("index", index_title),
        ("unit", lambda name: _shown(content, name, {})[1], str),
        *((craft, partial(shown, craft, "value"), str) for craft in crafts),
        *([("difference", apart, str)] if len(crafts) == 2 else []),
    ]
    if any("interval" in entry for entry in every):
        columns.append((f"{100 * content['level']:.0f} % interval", within, str))
    if any(entry.get("lengths") is not None for entry in every):
        columns += [(f"{craft} [L]", partial(lengths, craft), str) for craft in crafts]
    if float(content.get("scale", 1)) != 1:
        columns += [("ship", partial(shown, craft, "ship"), str) for craft in crafts]
    if any("limit" in entry for entry in every):
        columns.append(("IMO limit", limit))
    return table_of(dict.fromkeys(name for of in crafts.values() for name in of), columns)


def _by_flight(content: Content, rows: Sequence[Content]) -> Table:
    """Return a row for each flight of one kind of manoeuvre."""
    several = len({row["craft"] for row in rows}) > 1

    def cell(row: Content, name: str) -> Cell:
        entry = _entries(row).get(name, {})
        text, _ = _shown(content, name, entry)
        return Cell(text) if entry.get("kept", True) else Cell(text, "beyond the IMO limit", "bad")

    columns: list[Column] = [
        ("log", lambda row: f"{row['log']} ({row['craft']})" if several else row["log"])
    ]
    for name in dict.fromkeys(name for row in rows for name in _entries(row)):
        title = f"{index_title(name)} [{_shown(content, name, {})[1]}]"
        columns.append((title, lambda row, name=name: cell(row, name)))
    return table_of(rows, columns)


def flight_figures(flown: Mapping[str, Sequence[Flight]]) -> Iterator[Figure]:
    """Draw track, motion and commands of flights and, of spirals, yaw rate over helm.

    Of many flights, only the first of each kind of manoeuvre has a still picture.

    Args:
        flown: flights of the same manoeuvres by what flew them; of two, the first is the solid line
            and the second the dashed one.
    """
    groups: list[Sequence[Flight]] = list(zip(*flown.values(), strict=True))
    kinds: dict[str, Sequence[Flight]] = {}
    for group in groups:
        kinds.setdefault(group[0].manoeuvre.kind, group)
    stills = groups if len(groups) <= _EACH else list(kinds.values())
    looks = {"recorded": Look("recorded", GREY, width=2.2, order=2)}
    looks |= {
        craft: replace(DASHED if place else SOLID, label=craft) for place, craft in enumerate(flown)
    }
    looks["way-point"] = Look("way-point", "#666666", kind="points", marker="s", size=5, order=5)
    looks["reversals"] = replace(ZERO, label="heading of reversals", dash="dotted")
    looks["start"] = START
    shown = [*stills, *(one for one in groups if one not in stills)][:_MOST_CASES]
    logs = [flight.motion for group in shown for flight in group]
    present = dict.fromkeys(name for log in logs for name in log.channels)
    channels: list[str] = [name for name in _SHOWN if name in present]
    channels += [name for name in present if name.startswith("cmd_")]
    channels = channels[:_MOST_PANELS]
    units = {name: shown_unit(log.units[name]) for log in logs for name in log.channels}
    units |= {name: ("rpm", 60.0) for log in logs for name in log.units if log.units[name] == "1/s"}
    panels = [Panel("north [m]", "east [m]", kind="map", height=380)]
    panels += [
        Panel(f"{_CHANNELS.get(name, name)} [{units[name][0]}]".replace("\n ", "\n"), height=145)
        for name in channels
    ]
    panels[-1] = replace(panels[-1], x_label="time [s]")
    cases = []
    for group in [one for one in groups if one in shown]:
        motion = group[0].motion
        length = max(float(flight.motion.t[-1]) for flight in group)
        cases.append(
            Case(
                motion.name.replace("_", " "),
                _flight_curves(list(flown), group, {name: units[name][1] for name in channels}),
                f"{group[0].manoeuvre.kind.replace('_', ' ')}, {length:.0f} s",
                group in stills,
            )
        )
    yield Figure(
        "manoeuvres",
        "Manoeuvres",
        "North is up, scales of the track are equal, and each track begins at its start. Below,"
        " the motion itself, without the noise of sensors, and the commands over time.",
        looks,
        panels,
        cases,
        "Manoeuvre",
    )
    for group in stills:
        if isinstance(group[0].manoeuvre, Spiral):
            yield _spiral(list(flown), group, looks)


def _flight_curves(
    crafts: Sequence[str], group: Sequence[Flight], factors: Mapping[str, float]
) -> list[dict[str, Curve]]:
    manoeuvre, first = group[0].manoeuvre, group[0].motion
    x0, y0 = (float(first[name][0]) for name in ("x", "y"))
    drawn: dict[str, Log] = {}
    if isinstance(manoeuvre, Replay):
        drawn["recorded"] = manoeuvre.recorded
    drawn |= {craft: flight.motion for craft, flight in zip(crafts, group, strict=True)}
    track: dict[str, Curve] = {}
    out: list[dict[str, Curve]] = [track, *({} for _ in factors)]
    for name, log in drawn.items():
        # a recording, as far as it was flown
        known = log.t - log.t[0] <= first.t[-1] if name == "recorded" else slice(None)
        time = (log.t - log.t[0])[known] if name == "recorded" else log.t
        if "x" in log.channels and "y" in log.channels:
            track[name] = (log["y"][known] - y0, log["x"][known] - x0)
        for panel, (channel, factor) in zip(out[1:], factors.items(), strict=True):
            if channel in log.channels:
                curve = (time, factor * np.asarray(log[channel][known], dtype=float))
                panel[name] = steps(*curve) if channel.startswith("cmd_") else curve
    track["start"] = (np.zeros(1), np.zeros(1))
    if isinstance(manoeuvre, Waypoints):
        north, east = np.array(manoeuvre.points).T
        track["way-point"] = (east - y0, north - x0)
    if isinstance(manoeuvre, Zigzag) and "psi" in factors:
        turn = np.array([-1.0, 1.0]) * manoeuvre.heading
        heading = factors["psi"] * (first["psi"][0] + turn)
        out[1 + list(factors).index("psi")]["reversals"] = (np.zeros(2), heading)
    return out


def _spiral(crafts: Sequence[str], group: Sequence[Flight], looks: Mapping[str, Look]) -> Figure:
    name, manoeuvre = group[0].motion.name, group[0].manoeuvre
    by_angle = isinstance(manoeuvre, Spiral) and len(manoeuvre.rudders) > 0
    panel: dict[str, Curve] = {}
    for craft, flight in zip(crafts, group, strict=True):
        found = flight.manoeuvre.indices(flight.motion)
        helm = (DEG if by_angle else 1.0) * np.asarray(found["steers"])
        panel[craft] = panel[f"{craft} steady"] = (helm, np.degrees(found["yaw_rates"]))
    label = "rudder [deg]" if by_angle else "helm [share of full steer]"
    return Figure(
        f"spiral_{name}",
        f"Spiral: {name}",
        "Steady yaw rate over helm; a loop about 0 shows an unstable vessel.",
        {craft: looks[craft] for craft in crafts}
        | {f"{craft} steady": replace(looks[craft], kind="points") for craft in crafts},
        [Panel("steady yaw rate [deg/s]", label, name, height=360)],
        [Case("", [panel])],
    )


def booklet(run: RunFiles) -> Section | None:
    """Return a table for each standard manoeuvre and one that compares measured zigzags.

    None where the run has no booklet.json.
    """
    content = run.json("booklet.json")
    if not content:
        return None
    scale = float(content["scale"])
    hull = f"a hull of {number(float(content['length']))} m"
    hull += f", a model at 1:{number(scale)}" if scale != 1 else ""
    ship = " The column ship scales the values by Froude's law." if scale != 1 else ""
    about = (
        f"Model {content['model']} ran these manoeuvres for {hull}.{ship} The intervals"
        f" ({100 * content['level']:.0f} %) come from {content['draws']} draws of the parameters"
        " from their uncertainty after the trials. They assume that the model's form is right."
    )
    blocks: list[Block] = [Text(about)]
    for page in content["pages"]:
        if not page["split"]:
            parts: list[Block] = [_by_index(content, {content["model"]: page["indices"]})]
            if page["faults"]:
                draws = plural(page["faults"], "draw")
                text = f"The intervals leave out {draws} that did not end the manoeuvre."
                parts.append(Bullets([text], warning=True))
            blocks.append(Section(page_title(page), parts))
    repeated = [page for page in content["pages"] if page["split"]]
    if repeated:
        firsts = [page["indices"].get("first_overshoot", {}) for page in repeated]
        apart = [abs(found["difference"]) for found in firsts if "difference" in found]
        about = (
            "The model steers the rudder angle of each trial and reverses it at the trial's"
            " headings, from the state that the trial began with."
        )
        if apart:
            worst = number(math.degrees(max(apart)), 2)
            about += f" First overshoots differ by at most {worst} deg."
        title = "Measured zigzags, repeated in closed loop"
        blocks.append(Section(title, [Text(about), _repeated(content, repeated)]))
    return Section("Manoeuvring booklet", blocks)


def page_title(page: Content) -> str:
    """Return the name of a page, with the split of a measured log."""
    name = str(page["name"])
    return f"{name} ({page['split']})" if page["split"] else name.replace("_", " ")


def _repeated(content: Content, pages: Sequence[Content]) -> Table:
    """Return measured and predicted indices of the repeated zigzags, a row for each."""
    used = {
        name: shown_unit(content["units"][name])
        for name in _COMPARED
        if any("measured" in page["indices"].get(name, {}) for page in pages)
    }

    def cell(page: Content, name: str, key: str) -> Cell:
        found, factor = page["indices"].get(name, {}), used[name][1]
        if "measured" not in found:
            return Cell(DASH)
        if key == "difference":
            return Cell(number(factor * found[key], 2))
        note = interval(found.get("interval"), factor) if key == "value" else ""
        return Cell(number(factor * found[key]), note)

    return table_of(
        pages,
        [
            ("log", page_title),
            *(
                (title, lambda page, name=name, key=key: cell(page, name, key))
                for name in used
                for title, key in (
                    ("measured", "measured"),
                    ("model", "value"),
                    ("difference",) * 2,
                )
            ),
        ],
        groups=[(f"{index_title(name)} [{unit}]", 3) for name, (unit, _) in used.items()],
    )


def booklet_figures(run: RunFiles) -> Iterator[Figure]:
    """Draw the turning circles with all draws and the repeated zigzags of a booklet."""
    content, frame = run.json("booklet.json"), run.frame("booklet.parquet")
    if not content or frame is None:
        return
    by_page = {str(name): rows for name, rows in frame.groupby("page", sort=False)}
    pages: list[Mapping[str, Any]] = content["pages"]
    circles = [page for page in pages if page["manoeuvre"] == "turning_circle"]
    if circles:
        yield _circles(by_page, circles, content)
    zigzags = [page for page in pages if page["manoeuvre"] == "zigzag"]
    for place in range(0, len(zigzags), _MOST_ZIGZAGS):
        chosen = zigzags[place : place + _MOST_ZIGZAGS]
        panels = [
            Panel("heading, rudder [deg]", "time [s]", page_title(page), height=200, group=str(i))
            for i, page in enumerate(chosen)
        ]
        yield Figure(
            f"booklet_zigzags_{place // _MOST_ZIGZAGS + 1}",
            "Zigzags in closed loop",
            "The model steers by its own heading with the rudder angle and the reversals of"
            " each trial; the rudder is dotted. Look for the height of the peaks (overshoot)"
            f" and for periods that run apart. The band holds {100 * content['level']:.0f} % of the"
            " draws at each instant.",
            {
                "band": Look("band of the draws", SOLID.color, kind="fill", alpha=0.22, order=1),
                "model": replace(SOLID, label="model"),
                "rudder": Look("rudder", "#737373", "dotted", 1.0, order=1),
                "measured": replace(MEASURED, width=1.1, order=5),
            },
            panels,
            [Case("", [_zigzag(by_page[page["name"]], content["level"]) for page in chosen])],
            columns=min(2, len(chosen)),
        )


def _circles(
    by_page: Mapping[str, Any], pages: Sequence[Mapping[str, Any]], content: Content
) -> Figure:
    length = float(content["length"])
    panel: dict[str, Curve] = {}
    looks = {
        "draws": Look("draws", SOLID.color, width=0.7, alpha=0.12, order=1),
        "model": replace(SOLID, label="model"),
    }
    of_draws: dict[bool, list[Curve]] = {True: [], False: []}
    for page in pages:
        rows, found = by_page[page["name"]], page["indices"]
        for draw, part in rows[rows["draw"] >= 0].groupby("draw"):
            of_draws[draw == 0].append((part["y"] / length, part["x"] / length))
        if "tactical_diameter" in found:
            side = 1.0 if rows[rows["draw"] == 0]["psi"].iloc[-1] > 0 else -1.0
            advance, transfer, diameter = (
                found[name]["lengths"] for name in ("advance", "transfer", "tactical_diameter")
            )
            name = page_title(page)
            panel[name] = joined(
                [
                    ([0.0, side * transfer], [advance, advance]),
                    ([side * diameter] * 2, [0.0, advance]),
                ]
            )
            looks[name] = Look(
                f"{name}: advance {advance:.2f}, tactical diameter {diameter:.2f}",
                width=0.8,
                dash="solid" if side > 0 else "dashed",
                order=4,
            )
    panel |= {"draws": joined(of_draws[False]), "model": joined(of_draws[True])}
    panel["start"] = (np.zeros(1), np.zeros(1))
    return Figure(
        "booklet_circles",
        "Turning circles",
        "North is up; distances are in hull lengths from the place of the order. Thin"
        f" lines are {content['draws']} draws of the model's parameters. Black lines mark"
        " advance (to 90 deg) and tactical diameter (to 180 deg) of the fitted model.",
        looks | {"start": START},
        [Panel("north [hull lengths]", "east [hull lengths]", kind="map", height=380)],
        [Case("", [panel])],
    )


def _zigzag(rows: Any, level: float) -> dict[str, Curve]:
    def heading(part: Any) -> np.ndarray:
        turned: np.ndarray = DEG * (part["psi"] - part["psi"].iloc[0]).to_numpy()
        return turned

    fitted, measured = rows[rows["draw"] == 0], rows[rows["draw"] == -1]
    t = fitted["t"].to_numpy()
    out = {"model": (t, heading(fitted)), "rudder": (t, DEG * fitted["rudder"].to_numpy())}
    drawn = [heading(part) for _, part in rows[rows["draw"] > 0].groupby("draw")]
    first = rows[rows["draw"] == 1]["t"].to_numpy()
    if drawn and first.size:
        # flights that end at their stop condition are of different length: the band ends with the
        # shortest
        size = min(map(len, drawn))
        ends = np.quantile(
            [line[:size] for line in drawn], (0.5 - level / 2, 0.5 + level / 2), axis=0
        )
        out["band"] = band(first[:size], *ends)
    if len(measured):
        out["measured"] = (measured["t"].to_numpy(), heading(measured))
    return out
