"""The report of a course run: how each controller passes the buoys, and how long it takes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from residnet.autopilot.courses.config import BuoyCourseConfig
from residnet.autopilot.courses.course_check import PassingRule
from residnet.autopilot.records import (
    AnyCourseRow,
    CourseEnsembleRow,
    CourseMetricsFile,
    CourseRow,
)
from residnet.autopilot.tasks.course.config import CourseSpreadConfig
from residnet.core.format import DEGREES_PER_RADIAN, format_number
from residnet.report.blocks import Block, Cell, Column, Section, Table, Text, build_table, flag_cell
from residnet.report.figure import (
    COLORS,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    join_with_gaps,
    tick_labels,
)
from residnet.report.figure_files import figures_section, read_figures, write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.run_settings import ShownSettings, read_settings

TRACKS_FILE = "tracks.parquet"
"""File of the simulations of the nominal vessel."""
COURSES_FILE = "courses.parquet"
"""File of the planned courses."""
SPREAD_FILE = "spread.parquet"
"""File with a row for each simulation of a random vessel; only if the config asks for them."""
PROTOCOL_RULES = {
    "enter": "Every buoy's circle of acceptance is to be entered.",
    "sides": "Every buoy is to be passed on its side, outside its circle.",
}
"""Description of the rule of each protocol."""
_DASHES = {"course": "solid", "lookahead": "long", "enclosure": "short", "integral": "dense"}
_GUIDANCE_SUFFIXES = {
    "course": "",
    "lookahead": ", look-ahead",
    "enclosure": ", enclosure",
    "integral": ", integral",
}
_PANELS = (
    ("psi", "heading\n[deg]", DEGREES_PER_RADIAN),
    ("rudder", "rudder\n[deg]", DEGREES_PER_RADIAN),
    ("cross_track", "cross-track\nerror [m]", 1.0),
    ("speed", "speed\n[m/s]", 1.0),
)


class CourseSettings(ShownSettings):
    """Settings of a course run that its page shows.

    Attributes:
        course: buoys and settings of the planning.
        protocols: rules for passing the buoys.
        spread: random vessels and currents; None for none.
    """

    course: BuoyCourseConfig
    protocols: tuple[PassingRule, ...]
    spread: CourseSpreadConfig | None = None


def _iterate_course_figures(
    run: RunFiles, metrics: CourseMetricsFile, settings: CourseSettings
) -> Iterator[Figure]:
    """Yield the figures of planned and steered courses."""
    tracks = run.read_required_parquet(TRACKS_FILE)
    plans = run.read_required_parquet(COURSES_FILE)
    spread_runs = run.read_parquet(SPREAD_FILE)
    styles = _run_styles(tracks, "controller")
    yield Figure(
        "courses",
        "Tracks past the buoys",
        f"{' '.join(PROTOCOL_RULES[name] for name in settings.protocols)} North is"
        " up, and scales of"
        " the track are equal. S and P name the side on which a buoy is left, dotted circles are"
        " those of the buoys, and the triangle is the start; dotted lines are the limits of the"
        " rudder. A track that leaves the picture has lost the course. A controller that leaves the"
        " plan early has to steer more later; look for rudder angles at the limit and for errors"
        " that grow from buoy to buoy.",
        {
            **styles,
            "plan": GlyphStyle("plan", "#BFBFBF", width=5.0, z_order=1),
            "limits": replace(ZERO_LINE_STYLE, label="limits of the rudder", dash="dotted"),
            "circles": GlyphStyle("circles of the buoys", "#737373", "dotted", 0.9, z_order=1),
            "buoys": GlyphStyle("buoys", kind="points", size=3.5, z_order=4),
            "start": GlyphStyle("start", kind="points", marker="^", size=6, z_order=4),
        },
        [
            Panel("north [m]", "east [m]", kind="map", height=420),
            *(Panel(title, height=145) for _, title, _ in _PANELS[:-1]),
            Panel(_PANELS[-1][1], "time [s]", height=145),
        ],
        [
            _protocol_case(
                settings.course,
                protocol,
                radii,
                metrics.rudder,
                tracks[tracks["protocol"] == protocol],
                plans[plans["protocol"] == protocol],
            )
            for protocol, radii in _circle_radii(settings, metrics.smallest.radius).items()
        ],
        "Protocol",
    )
    if spread_runs is not None:
        yield _spread_figure(spread_runs)


def _run_styles(runs: pd.DataFrame, column: str) -> dict[str, GlyphStyle]:
    """Return the style of the curves of each controller and guidance."""
    controllers = runs[column].drop_duplicates().tolist()
    model_pairs = runs[[column, "guidance"]].drop_duplicates()
    return {
        f"{name}{_GUIDANCE_SUFFIXES[guidance]}": GlyphStyle(
            f"{name}{_GUIDANCE_SUFFIXES[guidance]}",
            COLORS[controllers.index(name) % len(COLORS)],
            _DASHES[guidance],
            # tracks that coincide show beside each other
            max(2.6 - 0.7 * controllers.index(name), 1.0),
        )
        for name, guidance in model_pairs.itertuples(index=False, name=None)
    }


def _circle_radii(settings: CourseSettings, min_radius: float) -> dict[str, list[float]]:
    """Return the radii in m of the buoys' circles by protocol.

    Args:
        settings: buoys and protocols.
        min_radius: radius in m of the smallest turn, to which smaller circles are widened.
    """
    course = settings.course
    return {
        protocol: [
            course.acceptance if protocol == "enter" else max(buoy.radius, min_radius)
            for buoy in course.buoys
        ]
        for protocol in settings.protocols
    }


def _protocol_case(
    course: BuoyCourseConfig,
    protocol: str,
    radii: Sequence[float],
    rudder_limit: float,
    tracks: pd.DataFrame,
    plan: pd.DataFrame,
) -> Case:
    """Return the track and the signals of all controllers under one passing rule.

    Args:
        course: buoys and start.
        protocol: name of the rule.
        radii: radius of each buoy's circle in m.
        rudder_limit: largest rudder angle in rad.
        tracks: simulations of the nominal vessel under the rule.
        plan: the planned course.
    """
    east = np.array([buoy.east for buoy in course.buoys])
    north = np.array([buoy.north for buoy in course.buoys])
    angle = np.linspace(0.0, 2.0 * np.pi, 37)
    circles = [
        (x + r * np.sin(angle), y + r * np.cos(angle))
        for x, y, r in zip(east, north, radii, strict=True)
    ]
    limit = DEGREES_PER_RADIAN * np.array([-1.0, 1.0]) * rudder_limit
    track: dict[str, Curve] = {
        "plan": (plan["east"].to_numpy(float), plan["north"].to_numpy(float)),
        "circles": join_with_gaps(circles),
        "buoys": (east, north),
        "start": (np.array([course.start[1]]), np.array([course.start[0]])),
    }
    panels: list[dict[str, Curve]] = [track, *({} for _ in _PANELS)]
    panels[2]["limits"] = (np.zeros(2), limit)
    # a vessel that leaves the picture has lost the course
    plan_coordinates = [
        np.concatenate((plan[name], buoy_coordinates))
        for name, buoy_coordinates in (("east", east), ("north", north))
    ]
    margin = 0.3 * max(map(np.ptp, plan_coordinates)) + max(radii)
    for (controller, guidance), run_track in tracks.groupby(["controller", "guidance"], sort=False):
        name = f"{controller}{_GUIDANCE_SUFFIXES[str(guidance)]}"
        values = {key: run_track[key].to_numpy(float) for key in ("east", "north", "t")}
        is_outside = np.zeros(len(run_track), dtype=bool)
        for key, coordinates in zip(("east", "north"), plan_coordinates, strict=True):
            is_outside |= (values[key] < coordinates.min() - margin) | (
                values[key] > coordinates.max() + margin
            )
        visible_east, visible_north = (
            np.where(is_outside, np.nan, values[key]) for key in ("east", "north")
        )
        track[name] = (visible_east, visible_north)
        for panel, (quantity, _, factor) in zip(panels[1:], _PANELS, strict=True):
            panel[name] = (values["t"], factor * run_track[quantity].to_numpy(float))
    side_labels = [
        (0, float(x), float(y), f"{number}{buoy.leave_to[0].upper()}")
        for number, (x, y, buoy) in enumerate(zip(east, north, course.buoys, strict=True), 1)
    ]
    return Case(protocol, panels, PROTOCOL_RULES[protocol], texts=side_labels)


def _spread_figure(spread_runs: pd.DataFrame) -> Figure:
    """Draw the course times of the random vessels relative to the reference course."""
    styles = _run_styles(spread_runs, "model")
    cases = []
    for protocol, runs in spread_runs.groupby("protocol", sort=False):
        panel: dict[str, Curve] = {}
        medians = []
        runs_by_label = {
            f"{m}{_GUIDANCE_SUFFIXES[str(g)]}": is_selected
            for (m, g), is_selected in runs.groupby(["model", "guidance"])
        }
        for line_index, name in enumerate(styles):
            finished_runs = (
                runs_by_label[name][runs_by_label[name]["finished"]]
                if name in runs_by_label
                else runs[:0]
            )
            offsets = line_index + 0.5 * (
                np.arange(len(finished_runs)) / max(len(finished_runs) - 1, 1) - 0.5
            )
            for is_passed, suffix in ((True, ""), (False, ", missed")):
                is_selected = (finished_runs["passed"] == is_passed).to_numpy(bool)
                panel[name + suffix] = (
                    finished_runs["ratio"].to_numpy(float)[is_selected],
                    offsets[is_selected],
                )
            if len(finished_runs):
                medians.append(
                    ([finished_runs["ratio"].median()] * 2, [line_index - 0.38, line_index + 0.38])
                )
        panel["median"] = join_with_gaps(medians)
        n_unfinished = len(runs) - int(runs["finished"].sum())
        note = (
            f"{n_unfinished} of {len(runs)} simulations did not finish and are left out."
            if n_unfinished
            else ""
        )
        cases.append(
            Case(str(protocol), [panel], f"{PROTOCOL_RULES[str(protocol)]} {note}".strip())
        )
    point_styles = {}
    for name, style in styles.items():
        point_styles[name] = replace(style, kind="points", size=4)
        point_styles[f"{name}, missed"] = replace(point_styles[name], is_hollow=True, label="")
    return Figure(
        "spread",
        "Spread of vessels and currents",
        "Each point is one vessel in one current. It is filled where all buoys were passed as"
        " demanded, and a ring elsewhere; the bar is the median. Simulations that did"
        " not finish are left out.",
        point_styles | {"median": GlyphStyle("median", width=1.2, z_order=4)},
        [
            Panel(
                "",
                "course time over that of the reference, in water at rest",
                height=75 + 36 * len(styles),
                y_names=tick_labels(styles),
                y_limits=(len(styles) - 0.5, -0.5),
            )
        ],
        cases,
        "Protocol",
    )


def sections(run: RunFiles) -> list[Section]:
    """Return the sections: times and margins by protocol, explanations, and figures.

    Raises:
        UsageError: if the folder has no metrics.json.
    """
    metrics = run.read_task_metrics(CourseMetricsFile)
    settings = read_settings(run.path, CourseSettings)
    write_figures(run.path / "figures", _iterate_course_figures(run, metrics, settings))
    sections_written: list[Section] = []
    for protocol, (nominal_rows, spread_rows) in _rows_by_protocol(metrics.rows).items():
        nominal_results = nominal_table(nominal_rows)
        blocks: list[Block] = [Text(_rule_text(nominal_rows)), nominal_results]
        if not sections_written:
            previews = [
                figure.preview() for figure in read_figures(run.path / "figures", "courses")
            ]
            summary_table = nominal_results.select_columns(0, 4)
            summary_table.caption = _summary_caption(nominal_rows)
            sections_written.append(Section("", [*previews, summary_table]))
        if spread_rows:
            blocks.append(Section("Spread of vessels and currents", [spread_table(spread_rows)]))
        sections_written.append(Section(f"Protocol {protocol}", blocks))
    sections_written.append(Section("Definitions", [Text(_course_definitions(metrics, settings))]))
    return [*sections_written, *figures_section(run.path / "figures")]


def _rows_by_protocol(
    rows: Sequence[AnyCourseRow],
) -> dict[str, tuple[list[CourseRow], list[CourseEnsembleRow]]]:
    """Return the rows of the nominal vessel and of the random vessels by protocol."""
    rows_by_protocol: dict[str, tuple[list[CourseRow], list[CourseEnsembleRow]]] = {}
    for row in rows:
        nominal_rows, spread_rows = rows_by_protocol.setdefault(row.protocol, ([], []))
        if isinstance(row, CourseRow):
            nominal_rows.append(row)
        else:
            spread_rows.append(row)
    return rows_by_protocol


def _rule_text(rows: Sequence[CourseRow]) -> str:
    reference_text = f"The reference takes {rows[0].reference_time:.2f} s."
    return f"{PROTOCOL_RULES[rows[0].protocol]} {reference_text}"


def _summary_caption(rows: Sequence[CourseRow]) -> str:
    """Return what the columns of the table on the first screen mean."""
    if rows[0].protocol != "enter":
        return f"{PROTOCOL_RULES[rows[0].protocol]} Clear: passed outside the circle."
    return (
        f"{PROTOCOL_RULES[rows[0].protocol]} Ratio: course time divided by"
        f" {rows[0].reference_time:.2f} s, the time for the shortest computed course."
    )


def tables_text(rows: Sequence[AnyCourseRow]) -> str:
    """Return the tables of a course run for the terminal, from the rows of metrics.json."""
    texts = []
    for nominal_rows, spread_rows in _rows_by_protocol(rows).values():
        texts += [_rule_text(nominal_rows), nominal_table(nominal_rows).to_text()]
        texts += [spread_table(spread_rows).to_text()] if spread_rows else []
    return "\n".join(texts)


def nominal_table(rows: Sequence[CourseRow]) -> Table:
    """Return the table of time, margin and cross-track error of the nominal vessel."""

    def count_cell(count: int | None, row: CourseRow) -> Cell:
        return flag_cell(f"{count} of {row.n}", count != row.n)

    passing_columns: list[Column[CourseRow]] = [
        ("on its side", lambda row: count_cell(row.right_side, row)),
        ("clear", lambda row: count_cell(row.clear, row)),
    ]
    if rows[0].protocol == "enter":
        passing_columns = [("entered", lambda row: count_cell(row.entered, row))]
    return build_table(
        rows,
        [
            ("controller", "model"),
            ("guidance", "guidance"),
            ("time [s]", "course_time", 2),
            *passing_columns,
            ("ratio", "ratio", 4),
            ("ratio, turning", "ratio_turning", 4),
            ("margin [m]", "margin", 3),
            ("tightest turn [m]", "tightest_turn", 2),
            ("cross-track, rms [m]", "cross_track_rms", 3),
            ("cross-track, largest [m]", "cross_track_max", 3),
            ("rudder travel [deg]", "travel", 1, DEGREES_PER_RADIAN),
            ("finished", lambda row: Cell("yes") if row.finished else flag_cell("no", True)),
        ],
        is_selected=_is_policy_on_course,
    )


def spread_table(rows: Sequence[CourseEnsembleRow]) -> Table:
    """Return the table of fractions and medians over the random vessels of one protocol."""
    return build_table(
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
        is_selected=_is_policy_on_course,
        caption=f"{rows[0].n} vessels and currents for each controller and guidance.",
    )


def _is_policy_on_course(row: AnyCourseRow) -> bool:
    return row.kind == "policy" and row.guidance == "course"


def _course_definitions(metrics: CourseMetricsFile, settings: CourseSettings) -> list[str]:
    """Return the definitions of the columns of the tables of courses, in sentences."""
    steady_turn = metrics.smallest
    tight_buoys = [
        f"buoy {entry.buoy} ({format_number(entry.radius, 4)} m)"
        for entry in metrics.feasibility
        if not entry.possible
    ]
    feasibility_text = (
        f"The circles of {', '.join(tight_buoys)} are smaller; they are enlarged to this radius."
        if tight_buoys
        else "No circle of a buoy is smaller."
    )
    texts = [
        f"At {math.degrees(metrics.rudder):.3g} deg of rudder the vessel turns with a radius of"
        f" {steady_turn.radius:.2f} m at {steady_turn.speed:.3g} m/s. {feasibility_text}",
        "The reference is the shortest computed course of straight lines and arcs of this radius,"
        " for a vessel without yaw inertia and without margin to the circles. Ratio: course time"
        " divided by the time for the reference course at the service speed of"
        f" {metrics.speed:.3g} m/s. Ratio, turning: the same at the speed in the smallest turn.",
        "On its side and clear: number of buoys passed on their side, and outside their circles."
        " Margin: smallest depth inside a circle to enter, or smallest distance outside a circle to"
        " pass. Tightest turn: smallest radius of the track. The cross-track error is relative to"
        " the plan, which guidance by line of sight does not follow.",
    ]
    return [*texts, _spread_text(settings.spread)]


def _spread_text(spread_config: CourseSpreadConfig | None) -> str:
    if spread_config is None:
        return ""
    lower_effect, upper_effect = spread_config.effect
    lower_time, upper_time = spread_config.time
    bias = (
        f", a rudder bias of at most {math.degrees(spread_config.bias):.3g} deg"
        if spread_config.bias > 0
        else ""
    )
    return (
        f"Spread: {spread_config.flights} vessels with {lower_effect:g} to {upper_effect:g}"
        " times the rudder's effect,"
        f" {lower_time:g} to {upper_time:g} times the time constants{bias}, in currents of"
        f" {spread_config.current:g} m/s from all directions. Ratios of course times do not"
        " allow for"
        " the current. Passed: share of the simulations that passed all buoys as demanded."
    )
