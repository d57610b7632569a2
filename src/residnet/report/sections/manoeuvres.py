"""Manoeuvres: their indices, figures of their runs, and the manoeuvring booklet.

A craft is a vessel or a learned model that performs the manoeuvres. A flight is one run of a
manoeuvre.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.format import (
    DASH,
    DEGREES_PER_RADIAN,
    DisplayUnit,
    display_unit,
    format_count,
    format_fixed,
    format_interval,
    format_number,
)
from residnet.core.log import Log
from residnet.evaluation.booklet_records import (
    BookletFile,
    BookletIndex,
    BookletRow,
    FlightIndices,
    IndicesFile,
)
from residnet.manoeuvres.closed_loop import Spiral, Zigzag
from residnet.manoeuvres.open_loop import Replay
from residnet.manoeuvres.trials import ManoeuvreRun
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Section,
    Table,
    Text,
    build_table,
    flag_cell,
)
from residnet.report.figure import (
    DASHED_STYLE,
    GREY,
    MEASURED_STYLE,
    SOLID_STYLE,
    START_STYLE,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    band_outline,
    join_with_gaps,
    step_curve,
)
from residnet.report.figure_files import figures_section, read_figures
from residnet.report.run_reader import RunFiles

if TYPE_CHECKING:
    import pandas as pd

_MAX_SEPARATE_FLIGHTS = 12
"""Maximum number of manoeuvres with a table and an image each. With more manoeuvres, only the first
of each kind has them.
"""
_MAX_CASES = 30
"""Largest number of manoeuvres in the interactive figure; limits the page to a few megabytes."""
_MAX_PANELS = 12
"""Largest number of panels in the interactive figure, for the same reason."""
_MAX_ZIGZAGS = 6
"""Largest number of zigzags in an image, so that it fits on one page."""
_INDEX_TITLES = {
    "time_90": "time to 90 deg",
    "time_180": "time to 180 deg",
    "steady_speed_ratio": "steady speed over approach speed",
    "pull_out_yaw_rate": "yaw rate after pull-out",
}
"""Titles of indices that differ from the key with spaces."""
_COMPARED_INDICES = (
    "advance",
    "transfer",
    "tactical_diameter",
    "steady_diameter",
    "first_overshoot",
    "second_overshoot",
    "initial_turning_time",
    "reach",
    "period",
    "largest_yaw_rate",
)
_MAIN_INDICES = (
    "tactical_diameter",
    "first_overshoot",
    "track_reach",
    "loop_height",
    "largest_cross_track_error",
)
"""Index of each kind of manoeuvre shown on the first screen."""
_CHANNEL_TITLES = {
    "u": "surge velocity\nu", "v": "sway velocity\nv", "r": "yaw rate\nr", "p": "roll rate\np",
    "psi": "heading\n", "phi": "roll angle\n", "w": "heave velocity\nw", "q": "pitch rate\nq",
    "z": "depth\n", "theta": "pitch angle\n",
    "cmd_delta": "rudder\ncommand", "cmd_n": "revolutions\ncommand", "cmd_port": "port command\n",
    "cmd_stbd": "starboard\ncommand",
}  # fmt: skip
_PLOTTED_CHANNELS = ("u", "v", "r", "p", "psi", "phi", "w", "q", "z", "theta")


def index_title(name: str) -> str:
    """Return the words for a manoeuvring index, such as `tactical diameter`."""
    return _INDEX_TITLES.get(name, name.replace("_", " "))


def sections(run: RunFiles) -> list[Section]:
    """Return the sections with manoeuvring indices and the figures in the folder."""
    content = run.read_record(IndicesFile, "indices.json")
    figures = read_figures(run.path / "figures", "manoeuvres")
    sections_written = []
    if content is not None and content.rows:
        sections_written.append(
            Section("", [*(figure.preview() for figure in figures), _trials_table(content)])
        )
        blocks: list[Block] = [Text(_introduction(content), is_secondary=True)]
        blocks += [Section(title, [table]) for title, table in index_tables(content)]
        sections_written.append(Section("Manoeuvring indices", blocks))
    return [*sections_written, *figures_section(run.path / "figures")]


def _trials_table(content: IndicesFile) -> Table:
    """Return the table of simulated manoeuvres: the fault, or the main indices, of each."""

    def main_index(row: FlightIndices) -> str:
        return next((name for name in _MAIN_INDICES if name in row.indices), "")

    def outcome(row: FlightIndices) -> Cell | str:
        if row.fault:
            return flag_cell(row.fault, True)
        return index_title(main_index(row)) or "completed"

    def value(row: FlightIndices) -> str:
        name = main_index(row)
        entry = row.scalar_indices.get(name)
        return DASH if entry is None else "{} {}".format(*_format_index(content, name, entry.value))

    rows = sorted(content.rows, key=lambda row: not row.fault)
    columns: list[Column[FlightIndices]] = [("run", lambda row: row.log)]
    if len({row.craft for row in rows}) > 1:
        columns.append(("vessel", lambda row: row.craft))
    columns += [("outcome", outcome), ("value", value, str)]
    n_shown = max(_MAX_SEPARATE_FLIGHTS, sum(bool(row.fault) for row in rows))
    return build_table(rows[:n_shown], columns)


def _introduction(content: IndicesFile) -> str:
    if content.length is None:
        text = "The length of the hull is not known, so there are no values in hull lengths."
    else:
        text = (
            f"L: hull lengths of {format_number(content.length)} m. The limits are those of IMO"
            " resolution MSC.137(76), where they apply to a manoeuvre."
        )
    kinds_without_indices = dict.fromkeys(
        row.manoeuvre.replace("_", " ") for row in content.rows if not row.indices
    )
    return text + (
        f" Runs without indices: {', '.join(kinds_without_indices)}."
        if kinds_without_indices
        else ""
    )


def indices_text(content: IndicesFile) -> str:
    """Return the contents of indices.json for the terminal."""
    return "\n\n".join(f"{title}\n{table.to_text()}" for title, table in index_tables(content))


def _format_index(
    content: IndicesFile | BookletFile, name: str, value: float | None
) -> tuple[str, str]:
    """Return the displayed value of an index, a dash for None, and its unit."""
    unit, factor = display_unit(content.units.get(name, "-"))
    return format_number(None if value is None else factor * value, 4), unit


def index_tables(content: IndicesFile) -> list[tuple[str, Table]]:
    """Return titles and tables of the manoeuvring indices in indices.json.

    With few manoeuvres each has a table with one row per index. With many manoeuvres there is one
    table per kind with one row per manoeuvre.
    """
    groups: dict[str, list[FlightIndices]] = {}
    is_separate = len({row.log for row in content.rows}) <= _MAX_SEPARATE_FLIGHTS
    for row in content.rows:
        if row.scalar_indices:
            groups.setdefault(row.log if is_separate else row.manoeuvre, []).append(row)
    return [
        (
            name.replace("_", " "),
            _table_by_index(content, {row.craft: row.scalar_indices for row in rows})
            if is_separate
            else _table_by_trial(content, rows),
        )
        for name, rows in groups.items()
    ]


def _limit_cell(
    content: IndicesFile | BookletFile,
    crafts: Mapping[str, Mapping[str, BookletIndex]],
    name: str,
) -> Cell:
    """Return the limit of an index, with a note whether all crafts meet it."""
    limited_entries = [
        entry
        for craft_indices in crafts.values()
        if (entry := craft_indices.get(name)) is not None and entry.limit is not None
    ]
    if not limited_entries:
        return Cell("")
    is_met = all(entry.kept for entry in limited_entries)
    share_met = limited_entries[0].kept_share
    note = (
        ("met" if is_met else "exceeded")
        if share_met is None
        else f"met in {100 * share_met:.0f} % of the draws"
    )
    limit_text = _format_index(content, name, limited_entries[0].limit)[0]
    return Cell(limit_text, note, "" if is_met else "bad")


def _difference_text(
    content: IndicesFile | BookletFile,
    crafts: Mapping[str, Mapping[str, BookletIndex]],
    name: str,
) -> str:
    """Return the difference of an index, second craft minus first, as text."""
    first, second = (craft_indices.get(name) for craft_indices in crafts.values())
    difference = None if first is None or second is None else second.value - first.value
    return _format_index(content, name, difference)[0]


def _table_by_index(
    content: IndicesFile | BookletFile, crafts: Mapping[str, Mapping[str, BookletIndex]]
) -> Table:
    """Return one row per index of a manoeuvre, with the second craft compared to the first.

    Args:
        content: contents of the file, which hold the units of the indices.
        crafts: indices of each craft by name.
    """
    entries = [entry for craft_indices in crafts.values() for entry in craft_indices.values()]

    def format_value(craft: str, name: str) -> str:
        entry = crafts[craft].get(name)
        return _format_index(content, name, None if entry is None else entry.value)[0]

    def format_ship_value(craft: str, name: str) -> str:
        entry = crafts[craft].get(name)
        return _format_index(content, name, None if entry is None else entry.ship)[0]

    def lengths(craft: str, name: str) -> str:
        entry = crafts[craft].get(name)
        return "" if entry is None or entry.lengths is None else format_fixed(entry.lengths, 2)

    def interval_text(name: str) -> str:
        (craft_indices,) = crafts.values()
        return format_interval(
            craft_indices[name].interval, display_unit(content.units[name]).factor
        )

    columns: list[Column[str]] = [
        ("index", index_title),
        ("unit", lambda name: _format_index(content, name, None)[1], str),
        *((craft, partial(format_value, craft), str) for craft in crafts),
    ]
    if len(crafts) == 2:
        columns.append(("difference", partial(_difference_text, content, crafts), str))
    if isinstance(content, BookletFile) and any(entry.interval for entry in entries):
        columns.append((f"{100 * content.level:.0f} % interval", interval_text, str))
    if any(entry.lengths is not None for entry in entries):
        columns += [(f"{craft} [L]", partial(lengths, craft), str) for craft in crafts]
    if isinstance(content, BookletFile) and content.scale != 1:
        columns += [("ship", partial(format_ship_value, craft), str) for craft in crafts]
    if any(entry.limit is not None for entry in entries):
        columns.append(("IMO limit", partial(_limit_cell, content, crafts)))
    return build_table(
        dict.fromkeys(name for craft_indices in crafts.values() for name in craft_indices), columns
    )


def _table_by_trial(content: IndicesFile, rows: Sequence[FlightIndices]) -> Table:
    """Return the table of one kind of manoeuvre, with a row for each simulation."""
    has_several = len({row.craft for row in rows}) > 1

    def cell(row: FlightIndices, name: str) -> Cell:
        entry = row.scalar_indices.get(name)
        text, _ = _format_index(content, name, None if entry is None else entry.value)
        is_exceeded = entry is not None and entry.kept is False
        return Cell(text, "beyond the IMO limit", "bad") if is_exceeded else Cell(text)

    columns: list[Column[FlightIndices]] = [
        ("log", lambda row: f"{row.log} ({row.craft})" if has_several else row.log)
    ]
    for name in dict.fromkeys(name for row in rows for name in row.scalar_indices):
        title = f"{index_title(name)} [{_format_index(content, name, None)[1]}]"
        columns.append((title, lambda row, name=name: cell(row, name)))
    return build_table(rows, columns)


def trial_figures(trials_by_craft: Mapping[str, Sequence[ManoeuvreRun]]) -> Iterator[Figure]:
    """Draw track, motion and commands of manoeuvres, and yaw rate against helm for spirals.

    With many manoeuvres only the first of each kind has a static image.

    Args:
        trials_by_craft: trials of the same manoeuvres by craft; the first craft is drawn solid, the
            second dashed.
    """
    groups: list[Sequence[ManoeuvreRun]] = list(zip(*trials_by_craft.values(), strict=True))
    first_of_kind: dict[str, Sequence[ManoeuvreRun]] = {}
    for group in groups:
        first_of_kind.setdefault(group[0].manoeuvre.kind, group)
    static_groups = groups if len(groups) <= _MAX_SEPARATE_FLIGHTS else list(first_of_kind.values())
    styles = {"recorded": GlyphStyle("recorded", GREY, width=2.2, z_order=2)}
    styles |= {
        craft: replace(DASHED_STYLE if index else SOLID_STYLE, label=craft)
        for index, craft in enumerate(trials_by_craft)
    }
    styles["way-point"] = GlyphStyle(
        "way-point", "#666666", kind="points", marker="s", size=5, z_order=5
    )
    styles["reversals"] = replace(ZERO_LINE_STYLE, label="heading of reversals", dash="dotted")
    styles["start"] = START_STYLE
    shown_groups = [
        *static_groups,
        *(group_of_trials for group_of_trials in groups if group_of_trials not in static_groups),
    ][:_MAX_CASES]
    logs = [trial.true_log for group in shown_groups for trial in group]
    present = dict.fromkeys(name for log in logs for name in log.channels)
    channels: list[str] = [name for name in _PLOTTED_CHANNELS if name in present]
    channels += [name for name in present if name.startswith("cmd_")]
    channels = channels[:_MAX_PANELS]
    units = {name: display_unit(log.units[name]) for log in logs for name in log.channels}
    rpm = DisplayUnit("rpm", 60.0)
    units |= {name: rpm for log in logs for name in log.units if log.units[name] == "1/s"}
    panels = [Panel("north [m]", "east [m]", kind="map", height=380)]
    panels += [
        Panel(
            f"{_CHANNEL_TITLES.get(name, name)} [{units[name].name}]".replace("\n ", "\n"),
            height=145,
        )
        for name in channels
    ]
    panels[-1] = replace(panels[-1], x_label="time [s]")
    cases = []
    for group in [group_of_trials for group_of_trials in groups if group_of_trials in shown_groups]:
        motion = group[0].true_log
        length = max(float(trial.true_log.t[-1]) for trial in group)
        cases.append(
            Case(
                motion.name.replace("_", " "),
                _trial_curves(
                    list(trials_by_craft), group, {name: units[name].factor for name in channels}
                ),
                f"{group[0].manoeuvre.kind.replace('_', ' ')}, {length:.0f} s",
                group in static_groups,
            )
        )
    yield Figure(
        "manoeuvres",
        "Manoeuvres",
        "North is up, scales of the track are equal, and each track begins at its start. Below,"
        " the motion itself, without the noise of sensors, and the commands over time.",
        styles,
        panels,
        cases,
        "Manoeuvre",
    )
    for group in static_groups:
        if isinstance(group[0].manoeuvre, Spiral):
            yield _spiral_figure(list(trials_by_craft), group, styles)


def _trial_curves(
    crafts: Sequence[str], group: Sequence[ManoeuvreRun], factors: Mapping[str, float]
) -> list[dict[str, Curve]]:
    """Return the track and the channels of one manoeuvre by craft, a dictionary for each panel.

    Args:
        crafts: names of the crafts.
        group: run of each craft.
        factors: plotted channel -> factor from SI to its displayed unit.
    """
    manoeuvre = group[0].manoeuvre
    first_motion = group[0].true_log
    x0, y0 = (float(first_motion[name][0]) for name in ("x", "y"))
    logs: dict[str, Log] = {}
    if isinstance(manoeuvre, Replay):
        logs["recorded"] = manoeuvre.recorded
    logs |= {craft: trial.true_log for craft, trial in zip(crafts, group, strict=True)}
    track: dict[str, Curve] = {}
    panels: list[dict[str, Curve]] = [track, *({} for _ in factors)]
    for name, log in logs.items():
        # a replayed recording, up to the end of the simulation
        was_simulated = (
            log.t - log.t[0] <= first_motion.t[-1] if name == "recorded" else slice(None)
        )
        time = (log.t - log.t[0])[was_simulated] if name == "recorded" else log.t
        if "x" in log.channels and "y" in log.channels:
            track[name] = (log["y"][was_simulated] - y0, log["x"][was_simulated] - x0)
        for panel, (channel, factor) in zip(panels[1:], factors.items(), strict=True):
            if channel in log.channels:
                curve = (time, factor * np.asarray(log[channel][was_simulated], dtype=float))
                panel[name] = step_curve(*curve) if channel.startswith("cmd_") else curve
    track["start"] = (np.zeros(1), np.zeros(1))
    if manoeuvre.marked_positions:
        north, east = np.array(manoeuvre.marked_positions).T
        track["way-point"] = (east - y0, north - x0)
    if isinstance(manoeuvre, Zigzag) and "psi" in factors:
        reversal_changes = np.array([-1.0, 1.0]) * manoeuvre.heading
        heading = factors["psi"] * (first_motion["psi"][0] + reversal_changes)
        panels[1 + list(factors).index("psi")]["reversals"] = (np.zeros(2), heading)
    return panels


def _spiral_figure(
    crafts: Sequence[str], group: Sequence[ManoeuvreRun], styles: Mapping[str, GlyphStyle]
) -> Figure:
    """Return the figure of yaw rate against helm of a spiral manoeuvre."""
    name = group[0].true_log.name
    manoeuvre = group[0].manoeuvre
    by_angle = isinstance(manoeuvre, Spiral) and len(manoeuvre.rudders) > 0
    panel: dict[str, Curve] = {}
    for craft, trial in zip(crafts, group, strict=True):
        indices = trial.manoeuvre.compute_indices(trial.true_log)
        helm = (DEGREES_PER_RADIAN if by_angle else 1.0) * np.asarray(indices["steers"])
        panel[craft] = panel[f"{craft} steady"] = (helm, np.degrees(indices["yaw_rates"]))
    label = "rudder [deg]" if by_angle else "helm [share of full steer]"
    return Figure(
        f"spiral_{name}",
        f"Spiral: {name}",
        "Steady yaw rate over helm; a loop about 0 shows an unstable vessel.",
        {craft: styles[craft] for craft in crafts}
        | {f"{craft} steady": replace(styles[craft], kind="points") for craft in crafts},
        [Panel("steady yaw rate [deg/s]", label, name, height=360)],
        [Case("", [panel])],
    )


def _describe_model_error(content: BookletFile) -> str:
    """Return a sentence on the error of the model's form in the intervals."""
    counts = {
        entry.repeated_trials
        for page in content.pages
        if not page.split
        for entry in page.indices.values()
        if entry.repeated_trials is not None
    }
    if not counts:
        return "They assume that the model's form is right: fewer than two trials are repeated."
    count_text = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
    return (
        "They also contain the error of the model's form: the deviation of repeated trials from"
        f" the measured ones ({count_text} trials, by index)."
    )


def booklet_section(run: RunFiles) -> Section | None:
    """Return a table for each standard manoeuvre and one that compares measured zigzags.

    None if the run has no booklet.json.
    """
    content = run.read_record(BookletFile, "booklet.json")
    if content is None:
        return None
    scale = content.scale
    hull_text = f"a hull of {format_number(content.length)} m"
    hull_text += f", a model at 1:{format_number(scale)}" if scale != 1 else ""
    scale_text = " The column ship scales the values by Froude's law." if scale != 1 else ""
    introduction = (
        f"Model {content.model} ran these manoeuvres for {hull_text}.{scale_text} The intervals"
        f" ({100 * content.level:.0f} %) come from {content.draws} draws of the parameters"
        f" from their uncertainty after the trials. {_describe_model_error(content)}"
    )
    blocks: list[Block] = [Text(introduction)]
    for page in content.pages:
        if not page.split:
            page_blocks: list[Block] = [_table_by_index(content, {content.model: page.indices})]
            if page.faults:
                draws = format_count(page.faults, "draw")
                warning = f"The intervals leave out {draws} that did not end the manoeuvre."
                page_blocks.append(Bullets([warning], is_warning=True))
            blocks.append(Section(page_title(page), page_blocks))
    if content.remarks:
        blocks.append(Bullets([f"Left out: {remark}." for remark in content.remarks]))
    for kind, title, introduction in (
        (
            "zigzag",
            "Measured zigzags, repeated in closed loop",
            "The model steers the rudder angle of each trial and reverses it at the trial's"
            " headings, from the state that the trial began with.",
        ),
        (
            "turning_circle",
            "Measured turning circles, repeated",
            "The model holds the rudder angle of each trial, from the state that the trial began"
            " with.",
        ),
    ):
        repeated_pages = [page for page in content.pages if page.split and page.manoeuvre == kind]
        if not repeated_pages:
            continue
        first_overshoots = [page.indices.get("first_overshoot") for page in repeated_pages]
        differences = [
            abs(overshoot.difference)
            for overshoot in first_overshoots
            if overshoot is not None and overshoot.difference is not None
        ]
        if differences:
            largest_difference = format_number(math.degrees(max(differences)), 2)
            introduction += f" First overshoots differ by at most {largest_difference} deg."
        blocks.append(
            Section(title, [Text(introduction), _repeated_trial_table(content, repeated_pages)])
        )
    return Section("Manoeuvring booklet", blocks)


def page_title(page: BookletRow) -> str:
    """Return the name of a page, with the split of a measured log."""
    return f"{page.name} ({page.split})" if page.split else page.name.replace("_", " ")


def _repeated_trial_table(content: BookletFile, pages: Sequence[BookletRow]) -> Table:
    """Return measured and predicted indices of the repeated trials, a row for each."""

    def measured_index(page: BookletRow, name: str) -> BookletIndex | None:
        entry = page.indices.get(name)
        return None if entry is None or entry.measured is None else entry

    columns: list[Column[BookletRow]] = [("log", page_title)]
    groups: list[tuple[str, int]] = []
    for name in _COMPARED_INDICES:
        if not any(measured_index(page, name) for page in pages):
            continue
        unit, factor = display_unit(content.units[name])
        groups.append((f"{index_title(name)} [{unit}]", 3))

        def measured_cell(page: BookletRow, name: str = name, factor: float = factor) -> Cell:
            entry = measured_index(page, name)
            if entry is None or entry.measured is None:
                return Cell(DASH)
            return Cell(format_number(factor * entry.measured))

        def model_cell(page: BookletRow, name: str = name, factor: float = factor) -> Cell:
            entry = measured_index(page, name)
            if entry is None:
                return Cell(DASH)
            return Cell(
                format_number(factor * entry.value), format_interval(entry.interval, factor)
            )

        def difference_cell(page: BookletRow, name: str = name, factor: float = factor) -> Cell:
            entry = measured_index(page, name)
            if entry is None or entry.difference is None:
                return Cell(DASH)
            return Cell(format_number(factor * entry.difference, 2))

        columns += [
            ("measured", measured_cell),
            ("model", model_cell),
            ("difference", difference_cell),
        ]
    return build_table(pages, columns, groups=groups)


def booklet_figures(run: RunFiles) -> Iterator[Figure]:
    """Draw the turning circles with all draws and the repeated zigzags of a manoeuvring booklet."""
    content = run.read_record(BookletFile, "booklet.json")
    frame = run.read_parquet("booklet.parquet")
    if content is None or frame is None:
        return
    by_page = {str(name): rows for name, rows in frame.groupby("page", sort=False)}
    circle_pages = [
        page
        for page in content.pages
        # the track after a pull-out would hide the circles
        if page.manoeuvre == "turning_circle" and not page.split and not page.demand.get("pull_out")
    ]
    if circle_pages:
        yield _turning_circle_figure(by_page, circle_pages, content)
    zigzag_pages = [page for page in content.pages if page.manoeuvre == "zigzag"]
    for first_index in range(0, len(zigzag_pages), _MAX_ZIGZAGS):
        figure_pages = zigzag_pages[first_index : first_index + _MAX_ZIGZAGS]
        panels = [
            Panel("heading, rudder [deg]", "time [s]", page_title(page), height=200, group=str(i))
            for i, page in enumerate(figure_pages)
        ]
        yield Figure(
            f"booklet_zigzags_{first_index // _MAX_ZIGZAGS + 1}",
            "Zigzags in closed loop",
            "The model repeats the rudder angle and the reversal angles of each trial in closed"
            " loop with its predicted heading; the rudder is dotted. Compare the overshoots and the"
            f" periods. The band contains {100 * content.level:.0f} % of the draws at each time.",
            {
                "band": GlyphStyle(
                    "band of the draws", SOLID_STYLE.color, kind="fill", alpha=0.22, z_order=1
                ),
                "model": replace(SOLID_STYLE, label="model"),
                "rudder": GlyphStyle("rudder", "#737373", "dotted", 1.0, z_order=1),
                "measured": replace(MEASURED_STYLE, width=1.1, z_order=5),
            },
            panels,
            [
                Case(
                    "",
                    [_zigzag_curves(by_page[page.name], content.level) for page in figure_pages],
                )
            ],
            columns=min(2, len(figure_pages)),
        )


def _turning_circle_figure(
    by_page: Mapping[str, pd.DataFrame], pages: Sequence[BookletRow], content: BookletFile
) -> Figure:
    """Return the figure of turning circles in hull lengths: all draws, and the fitted model."""
    length = content.length
    panel: dict[str, Curve] = {}
    styles = {
        "draws": GlyphStyle("draws", SOLID_STYLE.color, width=0.7, alpha=0.12, z_order=1),
        "model": replace(SOLID_STYLE, label="model"),
    }
    curves_by_role: dict[bool, list[Curve]] = {True: [], False: []}
    for page in pages:
        rows = by_page[page.name]
        for draw_number, draw_rows in rows[rows["draw"] >= 0].groupby("draw"):
            curves_by_role[draw_number == 0].append(
                (draw_rows["y"].to_numpy() / length, draw_rows["x"].to_numpy() / length)
            )
        if "tactical_diameter" in page.indices:
            turn_sign = 1.0 if rows[rows["draw"] == 0]["psi"].iloc[-1] > 0 else -1.0
            advance, transfer, diameter = (
                page.indices[name].value / length
                for name in ("advance", "transfer", "tactical_diameter")
            )
            name = page_title(page)
            panel[name] = join_with_gaps(
                [
                    ([0.0, turn_sign * transfer], [advance, advance]),
                    ([turn_sign * diameter] * 2, [0.0, advance]),
                ]
            )
            styles[name] = GlyphStyle(
                f"{name}: advance {advance:.2f}, tactical diameter {diameter:.2f}",
                width=0.8,
                dash="solid" if turn_sign > 0 else "dashed",
                z_order=4,
            )
    panel |= {
        "draws": join_with_gaps(curves_by_role[False]),
        "model": join_with_gaps(curves_by_role[True]),
    }
    panel["start"] = (np.zeros(1), np.zeros(1))
    return Figure(
        "booklet_circles",
        "Turning circles",
        "North is up; distances are in hull lengths from the place of the order. Thin"
        f" lines are {content.draws} draws of the model's parameters. Black lines mark"
        " advance (to 90 deg) and tactical diameter (to 180 deg) of the fitted model.",
        styles | {"start": START_STYLE},
        [Panel("north [hull lengths]", "east [hull lengths]", kind="map", height=380)],
        [Case("", [panel])],
    )


def _zigzag_curves(rows: pd.DataFrame, level: float) -> dict[str, Curve]:
    """Return heading changes and rudder angles of a zigzag over time in deg.

    Draw 0 is the fitted model, draw -1 the measured run, and the other draws give the interval.

    Args:
        rows: samples of all draws.
        level: coverage of the interval.
    """

    def relative_heading_deg(draw_rows: pd.DataFrame) -> np.ndarray:
        heading_change: np.ndarray = (
            DEGREES_PER_RADIAN * (draw_rows["psi"] - draw_rows["psi"].iloc[0]).to_numpy()
        )
        return heading_change

    fitted_rows = rows[rows["draw"] == 0]
    measured_rows = rows[rows["draw"] == -1]
    t = fitted_rows["t"].to_numpy()
    traces = {
        "model": (t, relative_heading_deg(fitted_rows)),
        "rudder": (t, DEGREES_PER_RADIAN * fitted_rows["rudder"].to_numpy()),
    }
    draw_headings = [
        relative_heading_deg(part) for _, part in rows[rows["draw"] > 0].groupby("draw")
    ]
    first_draw_times = rows[rows["draw"] == 1]["t"].to_numpy()
    if draw_headings and first_draw_times.size:
        # flights that end at their stop condition are of different length: the band ends with the
        # shortest
        n_common = min(map(len, draw_headings))
        band_limits = np.quantile(
            [line[:n_common] for line in draw_headings], (0.5 - level / 2, 0.5 + level / 2), axis=0
        )
        traces["band"] = band_outline(first_draw_times[:n_common], *band_limits)
    if len(measured_rows):
        traces["measured"] = (measured_rows["t"].to_numpy(), relative_heading_deg(measured_rows))
    return traces
