"""What heading controllers cost under stated conditions: tables, texts and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from residnet.control.conditions.quiet import quiet_after
from residnet.report.blocks import Block, Cell, Section, Table, Text
from residnet.report.format import DEG, fixed, signed
from residnet.report.run_reader import Content, RunFiles

CONDITIONS = "conditions.parquet"
"""What each flight under the stated conditions cost, by controller."""
_KINDS = {
    "policy": "learned",
    "network": "learned, no law inside",
    "constants": "law, constants trained",
    "untrained": "policy before training",
    "network_off": "policy, network set to zero",
    "classical": "classical, tuned",
    "predictive": "document's autopilot",
    "floor": "knows the nominal vessel",
}


def best_classical(rows: Sequence[Content]) -> Content:
    """Return the row of the classical controller with the least mean cost."""
    of_conditions = [row for row in rows if row["protocol"] == "conditions"]
    classical = [row for row in of_conditions if row["kind"] == "classical"]
    return min(classical or of_conditions, key=lambda row: float(row["cost"]["mean"]))


def cost_verdict(rows: Sequence[Content]) -> list[str]:
    """Return a sentence for each learned policy, the cheapest first: its cost and the best law's.

    Without stated conditions there is none.
    """
    found = {row["model"]: row for row in rows if row["protocol"] == "conditions"}
    if not found:
        return []
    best = best_classical(rows)
    sentences = []
    for name, row in sorted(found.items(), key=lambda entry: float(entry[1]["cost"]["mean"])):
        off = found.get(f"{name} network off")
        if row["kind"] not in ("policy", "network"):
            continue
        cost, other = row["cost"]["mean"], best["cost"]["mean"]
        better = "below" if cost < other else "above"
        without = (
            "; it has no law inside"
            if off is None
            else f"; with its network set to zero it costs {off['cost']['mean']:.3f} s"
        )
        sentences.append(
            f"Under the stated conditions '{name}' costs {cost:.3f} s a change,"
            f" {100 * abs(cost / other - 1):.1f} % {better} '{best['model']}', the best classical"
            f" law, with {other:.3f} s{without}."
        )
    return sentences


def cost_table(rows: Sequence[Content]) -> Table:
    """Return cost, overshoot and rudder travel under the stated conditions by controller."""
    best = best_classical(rows)
    swings = {row["model"]: row for row in rows if row["protocol"] == "quiet"}
    table = Table(
        [
            "controller",
            "what it is",
            "mean [s]",
            f"over {best['model']} [%]",
            "95 % [s]",
            "outside, mean [s]",
            "mean [deg]",
            "95 % [deg]",
            "travel, mean [deg]",
            "heading [deg]",
            "rudder [deg]",
            "diverged",
        ],
        groups=[
            ("", 1),
            ("cost", 3),
            ("", 1),
            ("overshoot", 2),
            ("", 1),
            ("swing, most", 2),
        ],
    )
    for row in sorted(
        (row for row in rows if row["protocol"] == "conditions"),
        key=lambda row: float(row["cost"]["mean"]),
    ):
        quiet = swings[row["model"]]
        table.add(
            row["model"],
            [
                Cell(_KINDS[row["kind"]], mark="text"),
                fixed(row["cost"]["mean"], 3),
                signed(100 * (row["cost"]["mean"] / best["cost"]["mean"] - 1), 1),
                fixed(row["cost"]["p95"], 2),
                fixed(_of(row, "time_outside", "mean"), 2),
                fixed(_degrees(row, "overshoot", "mean"), 2),
                fixed(_degrees(row, "overshoot", "p95"), 2),
                fixed(_degrees(row, "travel", "mean"), 1),
                fixed(_degrees(quiet, "heading_swing", "max"), 2),
                fixed(_degrees(quiet, "rudder_swing", "max"), 2),
                Cell(str(row["diverged"]), mark="bad" if row["diverged"] else ""),
            ],
            selected=row["kind"] in ("policy", "network"),
        )
    return table


def beyond_table(rows: Sequence[Content]) -> Table | None:
    """Return mean and worst costs outside the conditions of training; None without such flights."""
    tests = list(
        dict.fromkeys(row["protocol"] for row in rows if row["protocol"].startswith("beyond_"))
    )
    if not tests:
        return None
    find = {(row["model"], row["protocol"]): row for row in rows}
    table = Table(
        ["controller", *["mean [s]", "most [s]", "diverged"] * len(tests)],
        groups=[(test.removeprefix("beyond_"), 3) for test in tests],
    )
    for name in dict.fromkeys(row["model"] for row in rows if row["protocol"] == tests[0]):
        cells: list[Cell | str] = []
        for test in tests:
            row = find[(name, test)]
            lost = row["diverged"]
            cells += [fixed(row["cost"]["mean"], 3), fixed(row["cost"]["max"], 1)]
            cells.append(Cell(str(lost), mark="bad" if lost else ""))
        table.add(name, cells, selected=find[(name, tests[0])]["kind"] == "policy")
    return table


def conditions_section(run: RunFiles) -> Section | None:
    """Return what every controller costs under the stated conditions, and how they are stated."""
    stated = run.resolved.get("conditions")
    if not stated:
        return None
    blocks: list[Block] = [cost_table(run.rows), Text(_texts(stated), quiet=True)]
    beyond = beyond_table(run.rows)
    if beyond is not None:
        blocks += [Text(["Outside the conditions of tuning and training:"]), beyond]
    return Section("Under the stated conditions", blocks)


def _texts(judged: Mapping[str, Any]) -> list[str]:
    given = judged["stated"]
    low, high = (math.degrees(value) for value in given["heading"])
    texts = [
        f"{judged['flights']} changes of heading of {low:.3g} to {high:.3g} deg, which no tuning or"
        f" training has seen, the same for all controllers. The vessel's K lies within"
        f" {given['effect'][0]:g} to {given['effect'][1]:g} and its T within {given['time'][0]:g}"
        f" to {given['time'][1]:g} of the nominal one; commands arrive {given['delay'][0]:g} to"
        f" {given['delay'][1]:g} s late; the rudder has a bias of up to"
        f" {math.degrees(given['bias']):.3g} deg and a slow push of"
        f" {math.degrees(given['push']):.3g} deg; the noise is"
        f" {math.degrees(given['noise_psi']):.3g} deg on the heading and"
        f" {math.degrees(given['noise_r']):.3g} deg/s on the yaw rate.",
        "Cost: the integral of |e| / (|e| +"
        f" {math.degrees(given['band']):.3g} deg) over {given['duration']:g} s from the change on,"
        f" plus {given['overshoot_weight']:g} s per deg of overshoot and"
        f" {given['travel_weight']:g} s per deg of rudder travel. Swing: largest movement, peak to"
        f" peak, from {quiet_after(given['duration']):.3g} s after a change on in flights without"
        " noise and slow push. Classical controllers are tuned by the same cost, by differential"
        " evolution.",
    ]
    if given["wind"] or given["current"]:
        wind = f"wind of {given['wind'][0]:g} to {given['wind'][1]:g} m/s" if given["wind"] else ""
        current = f"current of up to {given['current']:g} m/s" if given["current"] else ""
        found = " and ".join(part for part in (wind, current) if part)
        texts.append(f"There is {found}, from all directions.")
    if given.get("waves"):
        texts.append(
            "Heading and yaw rate are measured with the motion in waves, of up to"
            f" {math.degrees(given['waves']):.3g} deg (standard deviation) and peak periods of"
            f" {given['wave_period'][0]:g} to {given['wave_period'][1]:g} s."
        )
    return texts


def _of(row: Content, quantity: str, key: str) -> float | None:
    found = row.get(quantity)
    return None if found is None else float(found[key])


def _degrees(row: Content, quantity: str, key: str) -> float | None:
    value = _of(row, quantity, key)
    return None if value is None else DEG * value
