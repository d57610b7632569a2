"""The report of an autopilot run: one self-contained HTML file, from the run folder alone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd

from residnet.core.config import load_mapping
from residnet.judge.autopilots import effort_table, table
from residnet.report.figures.autopilot import draw_distributions, draw_responses
from residnet.report.plain_page import Part, write_page

FLIGHTS = "flights.parquet"
"""By this file an autopilot's run folder is known."""
PLANTS = "plants.parquet"
"""What each random vessel gave."""


def write_autopilot_report(run: Path) -> Path:
    """Draw figures and write `report.html` from metrics.json, controllers.json and flights.parquet;
    returns the report's path.
    """
    metrics = json.loads((run / "metrics.json").read_text())
    config = load_mapping(run / "resolved.yaml")
    kinds = {row["model"]: row["kind"] for row in metrics["rows"]}
    test = config["test"]
    draw_responses(
        run / "figures" / "responses.png",
        pd.read_parquet(run / FLIGHTS),
        kinds,
        test["heading"],
        test["band"],
        config["name"],
    )
    draw_distributions(
        run / "figures" / "distributions.png", pd.read_parquet(run / PLANTS), kinds, config["name"]
    )
    controllers = json.loads((run / "controllers.json").read_text())
    shown = [
        Part(_definition(config), table(metrics["rows"], metrics["floor"])),
        Part(_effort(test), effort_table(metrics["rows"])),
    ]
    return write_page(run, shown, [Part("", json.dumps(controllers, indent=1), "Controllers")])


def _effort(test: dict[str, Any]) -> str:
    """What the table of effort means."""
    text = (
        f"Effort over the {test['plants']} random vessels, mean and 95th percentile: integral of"
        " the absolute heading error, travel of the rudder command, and its energy, the integral"
        " of its square."
    )
    if test.get("wind"):
        text += (
            f" Wind: largest error after {test['bias_time']:g} s in {test['wind']:g} m/s from eight"
            " directions."
        )
    if sea := test.get("sea"):
        text += (
            f" Sea: roots of mean squares over {test['sea_time']:g} s after the step in waves of"
            f" {sea['significant_height']:g} m significant height and {sea['peak_period']:g} s peak"
            f" period that travel towards {math.degrees(sea['direction']):.3g} deg"
            f" ({sea['spectrum']['kind']}), mean over eight realisations, on a course of"
            f" {math.degrees(test['heading']):.3g} deg."
        )
    return text


def _definition(config: dict[str, Any]) -> str:
    test = config["test"]
    return (
        f"One definition for all controllers: step of {math.degrees(test['heading']):.3g} deg"
        f" without prefilter, rudder within {math.degrees(config['rudder']):.3g} deg, settled at"
        f" the last entry into {math.degrees(test['band']):.3g} deg. Worst: over the corners of the"
        f" spread; random: mean over {test['plants']} vessels drawn from it; overshoot: the largest"
        f" over both; bias: largest error after {test['bias_time']:g} s under"
        f" {math.degrees(test['bias']):.3g} deg of constant rudder bias. Linear peers are tuned for"
        f" the least worst settling time with at most {math.degrees(test['overshoot']):.3g} deg of"
        " overshoot at these corners."
    )
