"""Every task's page: its sections render from a made-up folder and show the numbers in it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from browser import browser, layout
from made_run import made_run, write_json
from read_page import Page, plain
from residnet_tasks.actuators import ActuatorsTaskConfig
from residnet_tasks.import_logs import ImportConfig
from tiny import write_yaml

from residnet.autopilot.records import RelativeChange, RollMetricsFile
from residnet.autopilot.report import course, roll
from residnet.autopilot.report import heading as autopilot
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.evaluation.intervals import bootstrap_intervals, make_resampling_blocks
from residnet.report.blocks import Section
from residnet.report.fit import fit_sections
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections import manoeuvres, sweep
from residnet.report.sections.variants import plot_differences, tabulate_variants
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.sweep.variants import compare_variants, compute_window_errors

needs_browser = pytest.mark.skipif(browser() is None, reason="no browser is installed")
DEG = math.pi / 180


def resolved(run: Path, content: dict[str, Any]) -> None:
    run.mkdir(parents=True, exist_ok=True)
    write_yaml(run / "resolved.yaml", {"name": "made", **content})


def spread(mean: float) -> dict[str, float]:
    return {"mean": mean, "median": mean, "p95": 1.2 * mean, "max": 1.5 * mean}


def made_autopilot(run: Path) -> Path:
    """Two controllers of one vessel; the second does not settle in four flights."""
    sea: dict[str, Any] = {"significant_height": 1.5, "peak_period": 8.0, "direction": 45 * DEG}
    sea |= {"hull": {"length": 20.0, "breadth": 5.0, "draught": 1.5}}
    test: dict[str, Any] = {
        "heading": 30 * DEG,
        "band": DEG,
        "plants": 5,
        "bias": DEG,
        "bias_time": 60.0,
    }
    test |= {"duration": 20.0, "wind": 10.0, "sea_time": 300.0}
    test |= {"sea": {**sea, "spectrum": {"kind": "jonswap"}}}
    resolved(run, {"task": "autopilot", "rudder": 20 * DEG, "test": test})
    rows = []
    for place, (model, kind) in enumerate({"net": "policy", "pd": "classical"}.items()):
        base = {"model": model, "kind": kind, "split": "simulated", "n": 5, "diverged": 0}
        means = {"settling": 10.0 + place, "overshoot": 0.2 * DEG, "iae": 1.0, "travel": 0.5}
        found = {name: spread(mean) for name, mean in (means | {"energy": 0.1}).items()}
        for protocol in ("nominal", "corners", "random"):
            unsettled = 4 * place if protocol == "random" else 0
            rows.append({**base, "protocol": protocol, **found, "unsettled": unsettled})
        for protocol in ("bias", "wind"):
            rows.append({**base, "protocol": protocol, "error_end": 0.25 * DEG})
        swing = {f"{name}_rms": spread(2.0 * DEG) for name in ("heading", "rudder", "heel")}
        rows.append({**base, "protocol": "sea", **swing})
    metrics = {"schema": "residnet.metrics/1", "run": "made", "channels": {}, "floor": "net"}
    write_json(run / "metrics.json", {**metrics, "flown": {"test": test}, "rows": rows})
    turning = {"gain": 0.5, "time": 1.0, "speed": 2.0, "righting": 0.0}
    controllers = {"schema": "residnet.controllers/1", "turning": turning}
    write_json(
        run / "controllers.json",
        {**controllers, "controllers": {"pd": {"config": {"kind": "pd", "kp": 1.0}}}},
    )
    t = np.arange(0.0, 20.0, 0.5)
    flights = []
    names = ("settling", "overshoot", "iae", "travel", "energy")
    for controller in ("net", "pd"):
        for effect, time in ((1.0, 1.0), (0.8, 1.2)):
            moves = {"t": t, "psi": 30 * DEG * (1 - np.exp(-effect * t / time / 4))}
            moves |= {"r": 0.1 * np.exp(-t / 4), "rudder": 0.2 * np.exp(-t / 4)}
            about = {"controller": controller, "effect": effect, "time": time}
            flights.append(pd.DataFrame({**about, **moves}))
    pd.concat(flights).to_parquet(run / "flights.parquet")
    random = np.random.default_rng(0)
    drawn = {key: random.uniform(1, 2, 10) for key in names}
    plants = pd.DataFrame({"controller": ["net"] * 5 + ["pd"] * 5, **drawn})
    plants.to_parquet(run / "plants.parquet")
    return run


def made_roll(run: Path) -> Path:
    """Six controllers in two sea states and three directions; head seas roll nothing."""
    resolved(run, {"task": "roll"})
    kinds = dict.fromkeys(("heading", "rudder", "fins", "both"), "classical")
    kinds |= {"both_trained": "constants", "learned": "policy"}
    gain_names = ["heading_gain", "yaw_rate_gain", "filter_share", "rudder_roll_rate_gain"]
    gain_names += ["rudder_roll_gain", "fin_roll_rate_gain", "fin_roll_gain"]
    rows = []
    totals = []
    controllers = []
    for i, (model, kind) in enumerate(kinds.items()):
        reduction = 0.15 * i
        shown = {"roll_reduction": reduction, "heading_rms": (0.3 + 0.01 * i) * DEG}
        for state in (3, 4):
            for direction in (0.0, 90.0, 180.0):
                roll_rms = (0.05 if direction == 180.0 else 4.0) * (1.0 - reduction) * DEG
                sea = {"sea_state": state, "direction": direction * DEG, "height": 0.88}
                sea |= {"period": 7.5, "n": 12, "is_judged": direction != 180.0}
                rms = {"roll_rms": roll_rms, "rudder_rms": DEG, "fin_rms": 5 * DEG}
                row = {"model": model, "kind": kind, "split": "simulated"}
                rows.append({**row, **sea, **rms, **shown})
        for total_state in (3, 4, None):
            total = {"model": model, "sea_state": total_state, "roll_rms": 3.3 * DEG}
            totals.append({**total, **shown})
        costs = {"tuning_cost": 2.0, "start_cost": None, "judged_cost": 2.0 - 0.1 * i}
        gains = dict.fromkeys(gain_names, 0.5)
        controllers.append({"model": model, "kind": kind, "gains": gains, **costs, "seconds": 9.0})
    comparison = {
        "policy": "learned", "classical": "both_trained", "tolerance": 0.02, "is_as_good": False,
        "roll": {"value": -0.031, "interval": [-0.04, -0.02]},
        "n_seas": 4, "n_less_roll": 3, "n_larger_heading": 1,
        "heading": {"value": 0.048, "interval": [0.03, 0.06]},
    }  # fmt: skip
    content = {"schema": "residnet.metrics/1", "run": "made", "channels": {}, "speed": 7.71}
    content |= {"comparison": comparison, "controllers": controllers}
    write_json(run / "metrics.json", {**content, "totals": totals, "rows": rows})
    return run


def made_course(run: Path) -> Path:
    """One controller past two buoys under both protocols, with a spread of four flights."""
    buoys = [
        {"north": 100.0, "east": 0.0, "radius": 20.0, "leave_to": "port"},
        {"north": 100.0, "east": 100.0, "radius": 30.0, "leave_to": "starboard"},
    ]
    varied = {"flights": 4, "effect": [0.8, 1.2], "time": [0.8, 1.2], "bias": DEG, "current": 0.5}
    way = {"acceptance": 15.0, "lookahead": 30.0, "buoys": buoys, "start": [0.0, 0.0]}
    about = {"task": "course", "protocols": ["enter", "sides"], "course": way, "spread": varied}
    resolved(run, about)
    flown = {"split": "simulated", "finished": True, "course_time": 61.5, "ratio": 1.025, "n": 2}
    flown |= {"ratio_turning": 0.95, "margin": -0.5, "tightest_turn": 18.0, "travel": 90 * DEG}
    flown |= {"cross_track_rms": 0.75, "cross_track_max": 2.0, "reference_time": 60.0}
    flown |= {"passed": False, "distances": [15.5, 12.0]}
    wide = {"split": "spread", "n": 4, "passed": 0.75, "finished": 1.0, "ratio": 1.04}
    wide |= {"ratio_worst": 1.2, "margin": 1.0, "margin_worst": -2.0}
    wide |= {"cross_track_rms": 0.9, "reference_time": 60.0}
    rows = []
    tracks = []
    plans = []
    drawn = []
    t = np.arange(0.0, 60.0)
    for protocol in ("enter", "sides"):
        base = {"model": "net", "kind": "policy", "guidance": "course", "protocol": protocol}
        passed = {"entered": 2} if protocol == "enter" else {"right_side": 2, "clear": 1}
        rows += [{**base, **passed, **flown}, {**base, **wide}]
        place = {"north": 2 * t, "east": t, "protocol": protocol}
        plans.append(pd.DataFrame(place))
        motion = {"psi": 0.4 + 0 * t, "rudder": 0.1 * np.sin(t), "speed": 2 + 0 * t}
        flight = {"controller": "net", "guidance": "course", "t": t, "cross_track": np.sin(t)}
        tracks.append(pd.DataFrame({**place, **flight, **motion}))
        found = {"ratio": [1.0, 1.1, 1.2, 1.3], "passed": [True, True, True, False]}
        drawn.append(pd.DataFrame({**base, **found, "finished": True}))
    feasibility = [
        {"buoy": buoy, "radius": radius, "smallest": 25.0, "possible": radius > 25.0}
        for buoy, radius in ((1, 20.0), (2, 30.0))
    ]
    content = {"schema": "residnet.metrics/1", "run": "made", "channels": {}, "speed": 2.0}
    smallest = {"radius": 25.0, "speed": 1.5, "yaw_rate": 0.06, "step": 0.1}
    content |= {"rudder": 35 * DEG, "feasibility": feasibility, "smallest": smallest, "rows": rows}
    write_json(run / "metrics.json", content)
    for name, tables in (("tracks", tracks), ("courses", plans), ("spread", drawn)):
        pd.concat(tables).to_parquet(run / f"{name}.parquet")
    return run


def made_simulate(run: Path, logs: int = 2) -> Path:
    """Zigzags of a vessel and a model, and a flight that has no indices."""
    resolved(run, {"task": "simulate"})
    rows: list[dict[str, Any]] = []
    for number in range(logs):
        for craft, overshoot in (("ship", 9.0), ("model", 11.0)):
            distance = {"initial_turning_distance": 8.0, "initial_turning_distance_lengths": 2.0}
            limits = {"first_overshoot": {"limit": 10 * DEG, "kept": overshoot < 10}}
            row: dict[str, Any] = {
                "log": f"zigzag_{number + 1:02d}",
                "manoeuvre": "zigzag",
                "craft": craft,
            }
            row |= {"fault": "", "timed_out": False, "limits": limits}
            rows.append(row | {"indices": {"first_overshoot": overshoot * DEG, **distance}})
    steady = {"log": "constant_01", "manoeuvre": "constant", "indices": {}, "limits": {}}
    rows.append({**steady, "craft": "ship", "fault": "timed out after 60 s", "timed_out": True})
    units = {"first_overshoot": "rad", "initial_turning_distance": "m"}
    units |= {"initial_turning_distance_lengths": "-"}
    about = {"schema": "residnet.indices/1", "run": "made", "length": 4.0}
    write_json(run / "indices.json", {**about, "units": units, "rows": rows})
    return run


def made_import(run: Path) -> Path:
    """Two recordings, one with a finding that needs a look."""
    resolved(run, {"task": "import"})
    t = np.arange(0.0, 10.0, 0.1)
    (run / "logs").mkdir(parents=True)
    for name in ("first", "second"):
        u = np.where(t < 5, 1.0, math.nan)
        log = Log(name, t, {"u": u, "psi": 0.1 * t}, masks={"hard:gap": t > 9})
        log.save(run / "logs" / f"{name}.parquet")
    severe = {"level": "will mislead", "code": "gaps", "text": "a gap of -5 s"}
    note = {"level": "note", "code": "rate", "text": "the topic has 10 Hz"}
    write_json(run / "findings.json", {"first": [severe, note], "second": [note]})
    return run


def made_actuators(run: Path) -> Path:
    """A throttle map, a step response and thrust curves."""
    resolved(run, {"task": "actuators"})

    def estimate(value: float, unit: str) -> dict[str, Any]:
        return {"value": value, "low": 0.9 * value, "high": 1.1 * value, "unit": unit}

    throttle = {name: estimate(40.0, "1/s") for name in ("slope", "offset", "n_max")}
    step = {"rate": estimate(20.0, "1/s^2"), "dead_time": estimate(0.25, "s")}
    curve = {"c0": estimate(0.02, "N s^2"), "low": 0.0, "high": 40.0, "rms": 1.5}
    found = {"throttle": {**throttle, "saturated": False}, "step": step}
    write_json(run / "actuators.json", found | {"forward": curve, "reverse": curve})
    (run / "actuators.yaml").write_text("n_max: 2400 rpm\n")
    return run


def made_variants(run: Path) -> Path:
    """A recipe and a variant that is worse, under two protocols."""
    resolved(run, {"task": "sweep"})
    rows = []
    for variant, overrides, shift in (("recipe", [], 0.0), ("no_head", ["~heads"], 0.05)):
        row = {"variant": variant, "overrides": overrides, "seeds": 3, "windows": 12}
        row |= {"nrmse_mean": 0.2 + shift, "nrmse_sd": 0.01, "seconds": 12.0}
        row |= {"diverged": 0, "nrmse_range": [0.19 + shift, 0.21 + shift], "difference": shift}
        row |= {"difference_ci95": [0.5 * shift, 1.5 * shift] if shift else None}
        rows += [{**row, "protocol": protocol} for protocol in ("T30", "manoeuvre")]
    content = {
        "schema": "residnet.variants/1",
        "run": "made",
        "model": "plsr",
        "split": "test",
        "reference": "recipe",
    }
    write_json(run / "variants.json", content | {"rows": rows})
    return run


def of_task(task: type[Task]) -> Callable[[RunFiles], Sequence[Section]]:
    return lambda run: task.report_sections(RunFolder(run.path))


TASKS: dict[str, tuple[Callable[[Path], Path], Callable[[RunFiles], Sequence[Section]]]] = {
    "actuators": (made_actuators, of_task(ActuatorsTaskConfig)),
    "autopilot": (made_autopilot, autopilot.sections),
    "course": (made_course, course.sections),
    "fit": (made_run, fit_sections),
    "roll": (made_roll, roll.sections),
    "import": (made_import, of_task(ImportConfig)),
    "simulate": (made_simulate, manoeuvres.sections),
    "variants": (made_variants, sweep.sections),
}


def written(run: RunFiles, task: str) -> Path:
    return write_page(run.path, run.title, "Made by hand.", ["Done."], TASKS[task][1](run))


@pytest.fixture(scope="module")
def page_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Writes the page of a made-up run of a task, once."""

    @cache
    def page(task: str) -> Path:
        run = TASKS[task][0](tmp_path_factory.mktemp(task) / "run")
        return written(RunFiles(run), task)

    return page


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_page_whose_sections_hold_something(
    task: str, page_of: Callable[[str], Path]
) -> None:
    path = page_of(task)
    text = plain(path)
    page = Page(text)
    assert len(page.sections) == len(set(page.sections)) >= 3
    assert page.tables
    for table in page.tables:
        assert len(table) > 1, table
    pictures = sum(source.startswith("data:image") for source in page.sources)
    assert pictures == len(list((path.parent / "figures").glob("*.png")))
    shown = re.sub(r"data:image/png;base64,[^\"]+|<script.*?</script>", "", text, flags=re.DOTALL)
    shown = shown.partition('id="provenance"')[0]
    assert re.findall(r"\b(?:None|nan|inf|Undefined)\b|[{}]{2}", shown.partition("<body>")[2]) == []
    if task in ("actuators", "import", "simulate", "variants"):
        # the page of a finished run can be written again, and is the same
        assert plain(written(RunFiles(path.parent), task)) == text


@pytest.mark.long
@needs_browser
@pytest.mark.parametrize("task", TASKS)
def test_nothing_is_wider_than_the_window_and_no_word_is_broken(
    task: str, page_of: Callable[[str], Path], tmp_path: Path
) -> None:
    page = page_of(task)
    for width in (360, 820):
        found = layout(page, width, tmp_path)
        assert (found.overflow, found.broken) == (0, []), width


def test_controllers_are_compared_by_settling_time_and_effort(
    page_of: Callable[[str], Path],
) -> None:
    page = Page(plain(page_of("autopilot")))
    # the first screen has a picture and the first columns
    assert page.tables[0][1] == ["net", "15.00", "1.000", "15.00"]
    settling = ["16.50", "1.100", "16.50", "11.00", "13.20", "0.300", "0.2500", "0.2500", "4"]
    assert {line[0]: line[1:] for line in page.tables[1]}["pd"] == settling
    effort = next(table for table in page.tables if "sea, root mean square [deg]" in table[0])
    shown = ["net", "57.30", "68.75", "28.65", "34.38", "328.28", "393.94", *["2.000"] * 3]
    assert effort[2] == shown


def test_roll_reduction_by_sea_state_and_direction(page_of: Callable[[str], Path]) -> None:
    totals, seas, *_ = Page(plain(page_of("roll"))).tables
    assert totals[-1] == ["learned policy", "75.0", "75.0", "0.350"]
    lines = {line[0]: line[1:] for line in seas}
    assert lines["4, 90 deg"] == ["4.00", "60.0", "75.0", "0.300", "0.340", "0.350"]
    assert len([name for name in lines if name.endswith("deg")]) == 6
    assert 'class="weak">75.0' in plain(page_of("roll"))


def test_a_roll_policy_with_a_larger_heading_error_is_not_as_good(
    page_of: Callable[[str], Path],
) -> None:
    metrics = RunFiles(page_of("roll").parent).read_task_metrics(RollMetricsFile)
    first, figures, _, seas = roll.verdict_texts(metrics)
    assert "combination in 3, and has a larger heading error in 1." in seas
    assert first.startswith("The learned policy is NOT at least as good as")
    assert "(+4.8 %, 95 % confidence interval +3.0 to +6.0 %)" in figures


def test_a_roll_policy_that_training_did_not_improve_is_named_as_the_law(
    page_of: Callable[[str], Path],
) -> None:
    metrics = RunFiles(page_of("roll").parent).read_task_metrics(RollMetricsFile)
    no_change = RelativeChange(value=0.0, interval=(0.0, 0.0))
    comparison = metrics.comparison.model_copy(
        update={"roll": no_change, "heading": no_change, "is_as_good": True}
    )
    first = roll.verdict_texts(metrics.model_copy(update={"comparison": comparison}))[0]
    assert first.startswith("The training did not improve on the law it started from")


def test_a_course_shows_what_was_missed(page_of: Callable[[str], Path]) -> None:
    text = plain(page_of("course"))
    glance, entered, wide, sides, _ = Page(text).tables
    assert glance[1] == ["net", "course", "61.50", "2 of 2", "1.0250"]
    assert entered[1][:6] == [*glance[1], "0.9500"]
    assert sides[1][3:5] == ["2 of 2", "1 of 2"]
    assert wide[1][2:5] == ["75.0", "100.0", "1.0400"]
    assert 'class="bad">1 of 2' in text
    assert "The circles of buoy 1 (20.00 m) are smaller" in text
    assert "The reference takes 60.00 s." in text


def test_indices_stand_flight_by_flight_or_by_kind(
    page_of: Callable[[str], Path], tmp_path: Path
) -> None:
    few = Page(plain(page_of("simulate")))
    # what did not end as it should comes first
    assert few.tables[0][1] == ["constant_01", "ship", "timed out after 60 s", "–"]
    assert few.tables[0][2] == ["zigzag_01", "ship", "first overshoot", "9.000 deg"]
    assert few.tables[1] == [
        ["index", "unit", "ship", "model", "difference", "ship [L]", "model [L]", "IMO limit"],
        ["first overshoot", "deg", "9.000", "11.00", "2.000", "", "", "10.00|exceeded"],
        ["initial turning distance", "m", "8.000", "8.000", "0", "2.00", "2.00", ""],
    ]
    text = plain(written(RunFiles(made_simulate(tmp_path / "many", logs=13)), "simulate"))
    flights, table = Page(text).tables
    assert len(flights) == 1 + 12
    assert table[0] == ["log", "first overshoot [deg]", "initial turning distance [m]"]
    assert len(table) == 1 + 2 * 13
    assert table[2] == ["zigzag_01 (model)", "11.00|beyond the IMO limit", "8.000"]
    assert "Runs without indices: constant." in text


def test_an_import_shows_gaps_channels_and_findings(page_of: Callable[[str], Path]) -> None:
    text = plain(page_of("import"))
    page = Page(text)
    cells = page.table("log", "first")
    assert cells["first"] == ["100", "0.1000", "9.900", "2", "9", "1", "1"]
    assert cells["second"][-2:] == ["0", "1"]
    channels = page.table("channel", "u")
    assert channels["u"] == ["m/s", "1.00", "1.00", "1.00", "50"]
    assert channels["psi"][0] == "deg"
    assert "first: will mislead: a gap of −5 s" in text


def test_actuator_parameters_come_with_intervals(page_of: Callable[[str], Path]) -> None:
    cells = Page(plain(page_of("actuators"))).table("parameter", "largest revolutions")
    assert cells["largest revolutions"] == ["2400 rpm", "2160 to 2640"]
    assert cells["dead time"] == ["0.2500 s", "0.2250 to 0.2750"]
    assert cells["forward thrust, c0"][0].endswith(" N s²")
    assert cells["reverse thrust, rms residual"] == ["1.50 N", "–"]


def test_variants_are_compared_with_the_reference(page_of: Callable[[str], Path]) -> None:
    page = Page(plain(page_of("variants")))
    cells = page.table("variant", "no_head")
    assert cells["no_head"][:2] == ["0.2500|SD 0.0100", "+0.0500|+0.0250 to +0.0750"]
    assert cells["recipe"][1] == ""
    (definitions,) = [table for table in page.tables if table[0] == ["variant", "overrides"]]
    assert ["no_head", "~heads"] in definitions


KEYS = [(f"log{i // 3}", i % 3) for i in range(18)]


def variants(seeds: int) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Return the errors of a recipe and of another that is 0.05 worse by window of six logs, and as
    arrays [seeds, windows] by variant.
    """
    random = np.random.default_rng(0)
    level = random.uniform(0.1, 0.3, 18)
    arrays = {
        name: level + by + random.normal(0, 0.01, (seeds, 18))
        for name, by in (("recipe", 0.0), ("other", 0.05))
    }
    windows = pd.DataFrame(KEYS, columns=["log", "window"]).assign(protocol="T30")
    tables = {
        (name, seed): windows.assign(nrmse=found, diverged=[seed == 1, *[False] * 17])
        for name, each in arrays.items()
        for seed, found in enumerate(each)
    }
    return pd.concat(tables, names=["variant", "seed"]), arrays


def test_rows_of_a_study_are_means_over_windows_and_seeds() -> None:
    table, arrays = variants(3)
    recipe, other = compare_variants(table, "recipe")
    errors = arrays["other"]
    assert other.nrmse_mean == pytest.approx(errors.mean())
    assert other.nrmse_sd == pytest.approx(errors.mean(1).std(ddof=1))
    assert other.nrmse_range == pytest.approx([errors.mean(1).min(), errors.mean(1).max()])
    apart = errors.mean(0) - arrays["recipe"].mean(0)
    assert other.difference == pytest.approx(apart.mean())
    (expected,) = bootstrap_intervals(
        apart[:, None], make_resampling_blocks([i // 3 for i in range(18)])
    )
    assert other.difference_ci95 == pytest.approx(expected)
    assert (recipe.difference, recipe.difference_ci95) == (0.0, None)
    assert (other.windows, other.seeds, other.diverged) == (18, 3, 1)


def test_one_seed_has_no_spread_and_the_reference_no_difference(tmp_path: Path) -> None:
    found = compare_variants(variants(1)[0], "recipe")
    rows = [row.model_copy(update={"seconds": 10.0}) for row in found]
    assert rows[1].nrmse_sd is None
    recipe, other = tabulate_variants(rows, "recipe").rows
    assert [cell.text for cell in recipe.cells[:2]] == [f"{rows[0].nrmse_mean:.4f}", ""]
    assert rows[1].difference_ci95 is not None
    low, high = rows[1].difference_ci95
    assert (other.cells[1].note, other.cells[1].mark) == (f"+{low:.4f} to +{high:.4f}", "best")
    assert other.cells[1].text == f"+{rows[1].difference:.4f}"
    figure = plot_differences(rows, "recipe")
    assert figure.cases[0].curves[0]["difference"][0].tolist() == [rows[1].difference]
    run = made_run(tmp_path / "made")
    for model, split, said in (("gru", "test", "no model 'gru'"), ("selected", "train", "'train'")):
        with pytest.raises(DataError, match=said):
            compute_window_errors(run, model, split)
