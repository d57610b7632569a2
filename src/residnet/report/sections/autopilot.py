"""The report of an autopilot run: settling, effort and cost of every controller."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from residnet.control.heading.conditions import quiet_after
from residnet.core.format import DEG, signed
from residnet.judge.autopilots import cycling, not_for
from residnet.report.blocks import Block, Code, Column, Section, Table, Text, bad_where, table_of
from residnet.report.figure import ZERO, Case, Curve, Figure, Look, Panel, band, family, steps
from residnet.report.figure_files import figures_section, read_figures, write_figures
from residnet.report.run_reader import Content, RunFiles

FLIGHTS = "flights.parquet"
"""Responses at the corners of the spread."""
PLANTS = "plants.parquet"
"""What each random vessel gave."""
CONDITIONS = "conditions.parquet"
"""What each flight under the stated conditions cost, by controller."""


class Words(NamedTuple):
    """How a page calls what is steered, its unit and scale from SI, its rate, and what steers."""

    value: str
    unit: str
    scale: float
    rate: str
    rudder: str
    columns: tuple[str, str]


_TURNS = Words("heading", "deg", DEG, "yaw rate", "rudder", ("psi", "r"))
_DIVES = Words("depth", "m", 1.0, "pitch rate", "stern planes", ("z", "q"))


def _flown(run: RunFiles) -> Mapping[str, Any]:
    """Return the config with the times that were flown, those of its pace."""
    return {**run.resolved, **run.metrics.get("flown", {})}


def words_of(test: Mapping[str, Any]) -> Words:
    """Return the words of a run by its `test`."""
    return _DIVES if test.get("depth") else _TURNS


def _step(test: Mapping[str, Any]) -> tuple[float, float]:
    """Return the step of the reference and its band in rad, or in m of depth."""
    if depth := test.get("depth"):
        return float(depth["change"]), float(depth["band"])
    return float(test["heading"]), float(test["band"])


_KINDS = {
    "policy": "learned",
    "network": "learned, no law inside",
    "constants": "law, constants trained",
    "untrained": "policy before training",
    "network_off": "policy, network switched off",
    "classical": "classical, tuned",
    "predictive": "document's autopilot",
    "floor": "knows the nominal vessel",
}


def _figures(run: RunFiles) -> Iterator[Figure]:
    kinds = {row["model"]: row["kind"] for row in run.rows if row["protocol"] == "conditions"}
    flown = {row["model"]: row["kind"] for row in run.rows if row["protocol"] == "nominal"}
    yield _responses(run.frame(FLIGHTS), flown, _flown(run)["test"], run.title)
    words = words_of(_flown(run)["test"])
    yield _distributions(run.frame(PLANTS), flown, run.title, words)
    conditioned = run.frame(CONDITIONS)
    if conditioned is not None:
        yield _costs(conditioned, kinds, run.title, words)
    fits = {name: run.fit(name) for name in run.resolved.get("policies") or {}}
    if fits:
        yield _learning(fits, run.title)


def _looks(kinds: Mapping[str, str]) -> dict[str, Look]:
    """Return how each controller looks; policies have the widest lines and lie on top."""
    return {
        name: replace(look, width=1.8, order=4) if kinds[name] == "policy" else look
        for name, look in family(kinds, width=1.2).items()
    }


def _responses(series: pd.DataFrame, kinds: Mapping[str, str], test: Content, name: str) -> Figure:
    """Draw a step of the nominal vessel; of policies, the corners of the spread as shades."""
    words, (change, settled) = words_of(test), _step(test)
    value, rate = words.columns
    series = series.assign(error=change - series[value])
    looks = _looks(kinds)
    scales = {value: words.scale, "error": words.scale, rate: DEG, "rudder": DEG}
    curves: dict[str, dict[str, Curve]] = {key: {} for key in scales}
    for controller, kind in kinds.items():
        flights = series[series["controller"] == controller]
        for quantity, panel in curves.items():
            wide: Any = scales[quantity] * flights.pivot_table(
                index="t", columns=["effect", "time"], values=quantity
            )
            panel[controller] = (wide.index.to_numpy(), wide[(1.0, 1.0)].to_numpy())
            if kind == "policy" and quantity in (value, "error"):
                shade, color = f"{controller}, corners", looks[controller].color
                looks[shade] = Look(shade, color, kind="fill", alpha=0.25, order=1)
                values = wide.to_numpy()
                panel[shade] = band(wide.index, values.min(axis=1), values.max(axis=1))
    for key, middle in ((value, change), ("error", 0.0)):
        ends = words.scale * (middle + settled * np.array([-1.0, 1.0]))
        curves[key]["settled"] = (np.zeros(2), ends)
    near = 2.5 * words.scale * settled
    looks["settled"] = replace(ZERO, label="band of settling", dash="dotted")
    return Figure(
        "responses",
        f"Step responses of {name}",
        f"Step of {words.scale * change:.3g} {words.unit}. Lines show the nominal vessel, shades"
        " the corners of the spread under the learned policies. The dotted band of"
        f" {words.scale * settled:.1f} {words.unit}, enlarged in the second panel, is the one in"
        " which a change has settled.",
        looks,
        [
            Panel(f"{words.value}\n[{words.unit}]", height=195),
            Panel(f"{words.value} error\n[{words.unit}]", height=150, y_limits=(-near, near)),
            Panel(f"{words.rate}\n[deg/s]", height=150),
            Panel(f"{words.rudder}\n[deg]", "time [s]", height=150),
        ],
        [Case("", list(curves.values()))],
    )


def _shares(
    frame: pd.DataFrame, looks: Mapping[str, Look], quantities: Sequence[tuple[str, float, str]]
) -> list[dict[str, Curve]]:
    """Return the shares of rows that stay below a value, a panel for each quantity."""
    out = []
    for quantity, scale, _ in quantities:
        panel = {}
        for controller in looks:
            values = frame.loc[frame["controller"] == controller, quantity].dropna()
            found = scale * np.sort(values.to_numpy(float))
            share = np.arange(len(found) + 1) / max(len(found), 1)
            panel[controller] = steps(np.concatenate((found[:1], found)), share[: len(found) + 1])
        out.append(panel)
    return out


def _share_panels(
    quantities: Sequence[tuple[str, float, str]], limits: Sequence[Sequence[float]], what: str
) -> list[Panel]:
    return [
        Panel(
            f"share of {what}" if place % 2 == 0 else "",
            text,
            height=200,
            group=quantity,
            x_limits=reach,
            y_limits=(0.0, 1.02),
        )
        for place, ((quantity, _, text), reach) in enumerate(zip(quantities, limits, strict=True))
    ]


def _distributions(
    plants: pd.DataFrame, kinds: Mapping[str, str], name: str, words: Words
) -> Figure:
    """Draw settling time, overshoot, error, rudder travel and energy over random vessels."""
    quantities = (
        ("settling", 1.0, "settling time [s]"),
        ("overshoot", words.scale, f"overshoot [{words.unit}]"),
        ("iae", words.scale, f"integral of the absolute error [{words.unit} s]"),
        ("travel", DEG, f"{words.rudder} travel [deg]"),
        ("energy", DEG**2, "control energy [deg² s]"),
    )
    # axes hold those controllers that settle more often than not
    middle = plants.groupby("controller")["settling"].median()
    settling = plants[plants["controller"].isin(middle.index[middle < plants["settling"].max()])]
    limits: list[Sequence[float]] = []
    for quantity, scale, _ in quantities:
        shown = scale * settling[quantity].to_numpy(float)
        room = 0.05 * float(np.ptp(shown) or abs(shown[0]) or 1.0) if len(shown) else 0.0
        limits.append((shown.min() - room, shown.max() + room) if len(shown) else ())
    looks = _looks(kinds)
    return Figure(
        "distributions",
        f"Random vessels of {name}",
        f"Share of {len(plants) // len(kinds)} random vessels of the spread that stay below a"
        " value. A change that had not settled at the end of its flight counts with the flight's"
        " length. Controllers that seldom settle may lie beyond the axes.",
        looks,
        _share_panels(quantities, limits, "vessels"),
        [Case("", _shares(plants, looks, quantities))],
        columns=2,
    )


def _costs(flights: pd.DataFrame, kinds: Mapping[str, str], name: str, words: Words) -> Figure:
    """Draw the shares of flights under the stated conditions that stay below a value."""
    stated = flights[flights["protocol"] == "conditions"]
    quantities = (
        ("cost", 1.0, "cost [s]"),
        ("time_outside", 1.0, "time outside the band [s]"),
        ("overshoot", words.scale, f"overshoot [{words.unit}]"),
        ("travel", DEG, f"{words.rudder} travel [deg]"),
    )
    known = stated[stated["controller"].isin(kinds)]
    limits: list[Sequence[float]] = []
    for quantity, scale, _ in quantities:
        shown = scale * known[quantity].dropna().to_numpy(float)
        limits.append((0.0, float(np.quantile(shown, 0.98)) * 1.05 or 1.0) if len(shown) else ())
    looks = _looks(kinds)
    return Figure(
        "conditions",
        f"Flights of {name} under the stated conditions",
        f"Share of {stated['flight'].nunique()} flights under the stated conditions that stay below"
        " a value. The two per cent of all flights with the largest values may lie beyond an axis.",
        looks,
        _share_panels(quantities, limits, "flights"),
        [Case("", _shares(stated, looks, quantities))],
        columns=2,
    )


def _learning(fits: Mapping[str, Content], name: str) -> Figure:
    """Draw the cost over the flights that epochs are chosen on, from the start of training on."""
    panel: dict[str, Curve] = {}
    for policy, fit in fits.items():
        curve = [point for point in fit["curve"] if "validation" in point]
        epochs = np.array([0.0, *(point["epoch"] + 1.0 for point in curve)])
        first = fit["start_validation"]
        panel[policy] = (epochs, np.array([first, *(point["validation"] for point in curve)]))
        panel[f"{policy}, start"] = (epochs[:1], np.array([first]))
    looks = _looks(dict.fromkeys(fits, "policy"))
    starts = {f"{policy}, start": replace(ZERO, label="start", dash="dotted") for policy in fits}
    return Figure(
        "learning",
        f"Training of {name}",
        "Mean cost over the flights that epochs are chosen on; epoch 0 is the start, the law as"
        " tuned, and the dotted line goes on from it. The epoch of least cost is kept.",
        looks | starts,
        [Panel("mean cost [s]", "epoch", height=290)],
        [Case("", [panel])],
    )


def sections(run: RunFiles) -> list[Section]:
    """Return costs, comparison, effort, figures and controllers of an autopilot run.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    write_figures(run.path / "figures", _figures(run))
    test = _flown(run)["test"]
    words = words_of(test)
    compared = settling_table(run.rows, run.metrics.get("floor"), words)
    stated = _flown(run).get("conditions")
    cost = cost_table(run.rows, words) if stated else None
    drawn = [one.part() for one in read_figures(run.path / "figures", "responses")]
    # settling of the nominal vessel and of the spread, or the cost of a change
    first = compared.part(0, 3) if cost is None else cost.part(1, 4)
    out = [
        Section("", [*drawn, first]),
        Section("Controllers compared", [compared, Text(_definition(_flown(run)), quiet=True)]),
        Section("Effort", [effort_table(run.rows, words), Text(_effort(test), quiet=True)]),
        *figures_section(run.path / "figures"),
    ]
    if cost is not None and stated:
        blocks: list[Block] = [cost, Text(_conditions(stated), quiet=True)]
        beyond = beyond_table(run.rows)
        if beyond is not None:
            blocks += [Text(["Outside the conditions of tuning and training:"]), beyond]
        out.insert(1, Section("Under the stated conditions", blocks))
    if controllers := run.json("controllers.json"):
        out.append(Section("Controllers", [Code(json.dumps(controllers, indent=1))], folded=True))
    return out


def _by_model(rows: Sequence[Content], protocol: str) -> dict[str, dict[str, Content]]:
    """Return the rows of the controllers that have one of that protocol, by model and protocol."""
    out: dict[str, dict[str, Content]] = {}
    for row in rows:
        out.setdefault(row["model"], {})[row["protocol"]] = row
    return {model: found for model, found in out.items() if protocol in found}


def settling_table(rows: Sequence[Content], floor: str | None, words: Words) -> Table:
    """Return settling time, overshoot and steady errors, a row for each controller.

    Args:
        floor: the controller whose nominal settling time the others are divided by.
    """
    found = _by_model(rows, "nominal")

    def unsettled(row: Content) -> Any:
        lost = sum(row[protocol]["unsettled"] for protocol in ("corners", "random", "nominal"))
        return bad_where(lost, lost)

    def overshoot(row: Content) -> float:
        return max(float(row[protocol]["overshoot"]["max"]) for protocol in ("corners", "random"))

    columns: list[Column] = [
        ("controller", "nominal.model"),
        ("nominal [s]", "nominal.settling.max", 2),
    ]
    if floor:
        base = found[floor]["nominal"]["settling"]["max"]
        columns.append((f"over {floor} [-]", "nominal.settling.max", 3, 1.0 / base))
    columns += [
        ("worst [s]", "corners.settling.max", 2),
        ("random, mean [s]", "random.settling.mean", 2),
        ("random, 95 % [s]", "random.settling.p95", 2),
        (f"overshoot [{words.unit}]", overshoot, 3, words.scale),
        (f"bias [{words.unit}]", "bias.error_end", 4, words.scale),
    ]
    if any(row["protocol"] == "wind" for row in rows):
        columns.append((f"wind [{words.unit}]", "wind.error_end", 4, words.scale))
    return table_of(
        found.values(),
        [*columns, ("not settled", unsettled)],
        selected=lambda row: row["nominal"]["kind"] == "policy",
    )


def effort_table(rows: Sequence[Content], words: Words) -> Table:
    """Return what a change costs over random vessels, and what a course costs at sea."""
    groups = [(f"absolute error [{words.unit} s]", 2), (f"{words.rudder} travel [deg]", 2)]
    groups.append(("energy [deg² s]", 2))
    columns: list[Column] = [("controller", "random.model")]
    for quantity, scale in (("iae", words.scale), ("travel", DEG), ("energy", DEG**2)):
        columns += [
            ("mean", f"random.{quantity}.mean", 2, scale),
            ("95 %", f"random.{quantity}.p95", 2, scale),
        ]
    if sea := [row for row in rows if row["protocol"] == "sea"]:
        at_sea = ["heading", "rudder", *(["heel"] if any("heel_rms" in row for row in sea) else [])]
        columns += [(name, f"sea.{name}_rms.mean", 3, DEG) for name in at_sea]
        groups.append(("sea, root mean square [deg]", len(at_sea)))
    return table_of(
        _by_model(rows, "random").values(),
        columns,
        groups=groups,
        selected=lambda row: row["random"]["kind"] == "policy",
    )


def _definition(config: Mapping[str, Any]) -> list[str]:
    test, words = config["test"], words_of(config["test"])
    change, band = (words.scale * value for value in _step(test))
    return [
        f"One definition holds for all controllers: a step of {change:.3g} {words.unit} without"
        f" prefilter, with the {words.rudder} within {math.degrees(config['rudder']):.3g} deg. A"
        f" change has settled at its last entry into {band:.3g} {words.unit}.",
        "Worst: over the corners of the spread. Random: over"
        f" {test['plants']} vessels drawn from it. Overshoot: the largest over both. Bias: largest"
        f" error after {test['bias_time']:g} s under {math.degrees(test['bias']):.3g} deg of"
        f" constant bias of the {words.rudder}. Not settled: number of changes outside the band at"
        " their end.",
        "Peers are tuned by the cost under the stated conditions."
        if config.get("conditions")
        else "The constants of the peers are given.",
    ]


def _effort(test: Content) -> list[str]:
    texts = [
        f"Mean and 95th percentile over the {test['plants']} random vessels: integral of the"
        f" absolute {words_of(test).value} error, travel of the {words_of(test).rudder} command,"
        " and its energy (the integral of its square)."
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
    return texts


def best_classical(rows: Sequence[Content]) -> Content:
    """Return the row of the classical controller with the least mean cost."""
    of_conditions = [row for row in rows if row["protocol"] == "conditions"]
    classical = [row for row in of_conditions if row["kind"] == "classical"]
    return min(classical or of_conditions, key=_mean_cost)


def _mean_cost(row: Content) -> float:
    return float(row["cost"]["mean"])


def cost_verdict(rows: Sequence[Content]) -> list[str]:
    """Return a sentence for each learned policy, the cheapest first: its cost and the best law's.

    Without stated conditions there is none.
    """
    found = {row["model"]: row for row in rows if row["protocol"] == "conditions"}
    if not found:
        return []
    best = best_classical(rows)
    sentences = []
    for row in sorted(found.values(), key=_mean_cost):
        if row["kind"] not in ("policy", "network"):
            continue
        name, off = row["model"], found.get(f"{row['model']} network off")
        cost, other = row["cost"]["mean"], best["cost"]["mean"]
        without = (
            "; it has no law inside"
            if off is None
            else f"; with its network switched off it costs {off['cost']['mean']:.3f} s"
        )
        sentences.append(
            f"Under the stated conditions '{name}' costs {cost:.3f} s a change,"
            f" {100 * abs(cost / other - 1):.1f} % {'below' if cost < other else 'above'}"
            f" '{best['model']}', the best classical law, with {other:.3f} s{without}."
        )
        if worse := not_for(name, rows):
            sentences.append(f"Do not use '{name}' there: {'; '.join(worse)}.")
        sentences += cycling(name, rows)
    return sentences


def cost_table(rows: Sequence[Content], words: Words) -> Table:
    """Return cost, overshoot and travel under the stated conditions by controller."""
    best = best_classical(rows)
    found = _by_model(rows, "conditions")
    return table_of(
        sorted(found.values(), key=lambda row: _mean_cost(row["conditions"])),
        [
            ("controller", "conditions.model"),
            ("what it is", lambda row: _KINDS[row["conditions"]["kind"]]),
            ("mean [s]", "conditions.cost.mean", 3),
            (
                f"over {best['model']} [%]",
                lambda row: 100 * (_mean_cost(row["conditions"]) / _mean_cost(best) - 1),
                lambda value: signed(value, 1),
            ),
            ("95 % [s]", "conditions.cost.p95", 2),
            ("outside, mean [s]", "conditions.time_outside.mean", 2),
            (f"mean [{words.unit}]", "conditions.overshoot.mean", 2, words.scale),
            (f"95 % [{words.unit}]", "conditions.overshoot.p95", 2, words.scale),
            ("travel, mean [deg]", "conditions.travel.mean", 1, DEG),
            (f"{words.value} [{words.unit}]", "quiet.heading_swing.max", 2, words.scale),
            (f"{words.rudder} [deg]", "quiet.rudder_swing.max", 2, DEG),
            ("diverged", "conditions.diverged", lambda lost: bad_where(lost, lost)),
        ],
        groups=[("", 1), ("cost", 3), ("", 1), ("overshoot", 2), ("", 1), ("swing, most", 2)],
        selected=lambda row: row["conditions"]["kind"] in ("policy", "network"),
    )


def beyond_table(rows: Sequence[Content]) -> Table | None:
    """Return mean and worst costs outside the conditions of training; None without such flights."""
    tests = list(
        dict.fromkeys(row["protocol"] for row in rows if row["protocol"].startswith("beyond_"))
    )
    if not tests:
        return None
    columns: list[Column] = [("controller", f"{tests[0]}.model")]
    for test in tests:
        columns += [
            ("mean [s]", f"{test}.cost.mean", 3),
            ("most [s]", f"{test}.cost.max", 1),
            ("diverged", f"{test}.diverged", lambda lost: bad_where(lost, lost)),
        ]
    return table_of(
        _by_model(rows, tests[0]).values(),
        columns,
        groups=[(test.removeprefix("beyond_"), 3) for test in tests],
        selected=lambda row: row[tests[0]]["kind"] == "policy",
    )


def _conditions(judged: Mapping[str, Any]) -> list[str]:
    given = judged["stated"]
    depth, words = given.get("depth"), words_of(given)
    span = depth["change"] if depth else given["heading"]
    low, high, band = (words.scale * value for value in (*span, (depth or given)["band"]))
    noise = f"{math.degrees(given['noise_psi']):.3g} deg on the {'pitch' if depth else 'heading'}"
    if depth:
        noise = f"{depth['noise']:.3g} m on the depth, {noise}"
    texts = [
        f"{judged['flights']} changes of {words.value} of {low:.3g} to {high:.3g} {words.unit},"
        " which no tuning or training has seen, the same for all controllers. The vessel's K lies"
        f" within {given['effect'][0]:g} to {given['effect'][1]:g} and its T within"
        f" {given['time'][0]:g} to {given['time'][1]:g} of the nominal one; commands arrive"
        f" {given['delay'][0]:g} to {given['delay'][1]:g} s late; the {words.rudder} has a bias of"
        f" up to {math.degrees(given['bias']):.3g} deg and a slow push of"
        f" {math.degrees(given['push']):.3g} deg; the noise is {noise} and"
        f" {math.degrees(given['noise_r']):.3g} deg/s on the {words.rate}.",
        f"Cost: the integral of |e| / (|e| + {band:.3g} {words.unit}) over"
        f" {given['duration']:g} s from the change on, plus {given['overshoot_weight']:g} s per"
        f" {'decimetre' if depth else 'deg'} of overshoot and {given['travel_weight']:g} s per deg"
        f" of {words.rudder} travel. Swing: largest movement, peak to"
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
