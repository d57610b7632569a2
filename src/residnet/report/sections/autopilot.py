"""The report of an autopilot run: step responses, settling and effort of every controller."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from residnet.report.blocks import Block, Cell, Code, Figure, Section, Table, Text
from residnet.report.figures.autopilot import distributions, responses
from residnet.report.figures.conditions import costs, learning
from residnet.report.figures.files import figures_section, write_drawings
from residnet.report.format import DEG, fixed
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.conditions import CONDITIONS, conditions_section

FLIGHTS = "flights.parquet"
"""Responses at the corners of the spread."""
PLANTS = "plants.parquet"
"""What each random vessel gave."""


def draw(run: RunFiles) -> list[Figure]:
    """Write the figures of an autopilot run from its folder alone; returns them."""
    kinds = {row["model"]: row["kind"] for row in run.rows if row["protocol"] == "conditions"}
    test = run.resolved["test"]
    flights, plants = run.frame(FLIGHTS), run.frame(PLANTS)
    flown = {row["model"]: row["kind"] for row in run.rows if row["protocol"] == "nominal"}
    drawings = [
        responses(flights, flown, test["heading"], test["band"], run.title),
        distributions(plants, flown, run.title),
    ]
    conditioned = run.frame(CONDITIONS)
    if conditioned is not None:
        drawings.append(costs(conditioned, kinds, run.title))
    fits = {
        name: run.json(f"models/{name}/fit.json") for name in run.resolved.get("recurrent") or {}
    }
    if fits:
        drawings.append(learning(fits, run.title))
    return write_drawings(run.path / "figures", drawings)


def sections(run: RunFiles) -> list[Section]:
    """Return comparison, effort, figures and controllers of an autopilot run.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    controllers = run.json("controllers.json")
    found: list[Section | None] = [
        conditions_section(run),
        Section(
            "Controllers compared",
            [
                settling_table(run.rows, run.metrics.get("floor")),
                Text(_definition(run.resolved), quiet=True),
            ],
        ),
        Section("Effort", _effort(run)),
        figures_section(run.path / "figures"),
        Section("Controllers", [Code(json.dumps(controllers, indent=1))], folded=True)
        if controllers
        else None,
    ]
    return [section for section in found if section is not None]


def settling_table(rows: Sequence[Content], floor: str | None) -> Table:
    """Return settling time, overshoot and steady errors, a row for each controller.

    Args:
        rows: of metrics.json.
        floor: the controller whose nominal settling time the others are divided by.
    """
    find = {(row["model"], row["protocol"]): row for row in rows}
    windy = any(row["protocol"] == "wind" for row in rows)
    base = find[(floor, "nominal")]["settling"]["max"] if floor else None
    table = Table(
        [
            "controller",
            "nominal [s]",
            *([f"over {floor} [-]"] if floor else []),
            "worst [s]",
            "random, mean [s]",
            "random, 95 % [s]",
            "overshoot [deg]",
            "bias [deg]",
            *(["wind [deg]"] if windy else []),
            "not settled",
        ]
    )
    for name in dict.fromkeys(row["model"] for row in rows if row["protocol"] == "nominal"):
        nominal, corners, random, bias = (
            find[(name, protocol)] for protocol in ("nominal", "corners", "random", "bias")
        )
        overshoot = max(corners["overshoot"]["max"], random["overshoot"]["max"])
        unsettled = corners["unsettled"] + random["unsettled"] + nominal["unsettled"]
        settling = nominal["settling"]["max"]
        table.add(
            name,
            [
                fixed(settling, 2),
                *([fixed(settling / base, 3)] if base else []),
                fixed(corners["settling"]["max"], 2),
                fixed(random["settling"]["mean"], 2),
                fixed(random["settling"]["p95"], 2),
                fixed(DEG * overshoot, 3),
                fixed(DEG * bias["error_end"], 4),
                *([fixed(DEG * find[(name, "wind")]["error_end"], 4)] if windy else []),
                Cell(str(unsettled), mark="bad" if unsettled else ""),
            ],
            selected=nominal["kind"] == "policy",
        )
    return table


def effort_table(rows: Sequence[Content]) -> Table:
    """Return what a change of heading costs over random vessels, and what a course costs at sea."""
    find = {(row["model"], row["protocol"]): row for row in rows}
    names = list(dict.fromkeys(row["model"] for row in rows if row["protocol"] == "random"))
    sea = [row for row in rows if row["protocol"] == "sea"]
    rolls = any("heel_rms" in row for row in sea)
    groups = [("absolute error [deg s]", 2), ("rudder travel [deg]", 2), ("energy [deg² s]", 2)]
    if sea:
        groups.append(("sea, root mean square [deg]", 3 if rolls else 2))
    at_sea = ["heading", "rudder", *(["heel"] if rolls else [])] if sea else []
    table = Table(["controller", *["mean", "95 %"] * 3, *at_sea], groups=groups)
    for name in names:
        random = find[(name, "random")]
        cells: list[str] = []
        for quantity, scale in (("iae", DEG), ("travel", DEG), ("energy", DEG**2)):
            cells += [fixed(scale * random[quantity][key], 2) for key in ("mean", "p95")]
        for quantity in at_sea:
            found = find.get((name, "sea"), {}).get(f"{quantity}_rms")
            cells.append(fixed(DEG * found["mean"] if found else None, 3))
        table.add(name, cells, selected=random["kind"] == "policy")
    return table


def _definition(config: Mapping[str, Any]) -> list[str]:
    test = config["test"]
    return [
        "One definition holds for all controllers: a step of"
        f" {math.degrees(test['heading']):.3g} deg without prefilter, with the rudder within"
        f" {math.degrees(config['rudder']):.3g} deg. A change has settled at its last entry into"
        f" {math.degrees(test['band']):.3g} deg.",
        "Worst: over the corners of the spread. Random: over"
        f" {test['plants']} vessels drawn from it. Overshoot: the largest over both. Bias: largest"
        f" error after {test['bias_time']:g} s under {math.degrees(test['bias']):.3g} deg of"
        " constant rudder bias. Not settled: number of changes outside the band at their end.",
        "Linear controllers are tuned by the cost under the stated conditions."
        if config.get("conditions")
        else "Linear controllers are tuned for the least worst settling time with at most"
        f" {math.degrees(test['overshoot']):.3g} deg of overshoot at the corners of the spread.",
    ]


def _effort(run: RunFiles) -> list[Block]:
    test = run.resolved["test"]
    texts = [
        f"Mean and 95th percentile over the {test['plants']} random vessels: integral of the"
        " absolute heading error, travel of the rudder command, and its energy (the integral of"
        " its square)."
    ]
    if test.get("wind"):
        texts.append(
            f"Wind: largest error after {test['bias_time']:g} s in {test['wind']:g} m/s from eight"
            " directions."
        )
    if sea := test.get("sea"):
        texts.append(
            f"Sea: root mean squares over {test['sea_time']:g} s after the step, on a course of"
            f" {math.degrees(test['heading']):.3g} deg, mean over eight realisations. The waves"
            f" have {sea['significant_height']:g} m significant height and"
            f" {sea['peak_period']:g} s peak period ({sea['spectrum']['kind']}) and travel towards"
            f" {math.degrees(sea['direction']):.3g} deg."
        )
    return [effort_table(run.rows), Text(texts, quiet=True)]
