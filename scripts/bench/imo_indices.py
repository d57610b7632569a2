"""Coverage of the 95 % intervals of IMO's indices on ships drawn at random, from model tests.

    python scripts/bench/imo_indices.py [--first 0] [--count 40] [--forms standard model_tests]
        [--table FILE]

Each ship is a Mariner whose derivatives and steering gear (rate and lag) are drawn; every second
one has modulus terms instead of cubic ones. Eight tests at 1:50 with noise identify it, and the
booklet predicts the full-scale ship. Printed for each form of the hull and each index: the share of
intervals that contain the index of the drawn ship, the median relative width of the intervals, and
the median relative error. `chosen` is the form with the smallest error on the validation log.
"""

from __future__ import annotations

import copy
import json
import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bench
import numpy as np
import yaml

from residnet.core.config import validate_config
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.evaluation.booklet import BookletConfig, build_booklet
from residnet.identification.fitter import FitStore, Fitter
from residnet.identification.prepared import prepare_splits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.trials import simulate_trials
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.actuators.steering_gear import identify_steering_gear
from residnet.tasks.demo import (
    BASIN_LENGTH,
    BASIN_SCALE,
    measure_basin_tests,
    simulate_basin_tests,
)
from residnet.tasks.fit.booklet import compute_booklet_pages

SPLIT = {
    "train": ("TC_20_S", "TC_35_P", "ZZ_15-5_S", "ZZ_20-20_P"),
    "validation": ("ZZ_10-10_P",),
    "test": ("TC_35_S", "ZZ_10-10_S", "ZZ_20-20_S"),
}
"""Tests by split, as `residnet new` splits them."""
INDICES = {
    "circle": ("advance", "tactical_diameter"),
    "zigzag_10": ("initial_turning_distance", "first_overshoot", "second_overshoot"),
    "zigzag_20": ("first_overshoot",),
}
"""Indices with a limit in IMO resolution MSC.137(76), by manoeuvre."""
MANOEUVRES: tuple[dict[str, Any], ...] = (
    {"kind": "turning_circle", "name": "circle", "rudder": "35 deg", "until": "200 deg"},
    {"kind": "zigzag", "name": "zigzag_10", "rudder": "10 deg", "heading": "10 deg"},
    {"kind": "zigzag", "name": "zigzag_20", "rudder": "20 deg", "heading": "20 deg"},
)
_LINEAR = ["1", "v", "r", "u v", "u r", "u|u| delta"]
_MODULUS = ["v|v|", "r|r|", "v|r|", "r|v|"]
_CUBIC = ["v^3", "v^2 r", "v r^2", "r^3"]
_SURGE = ["1", "u", "u|u|", "v r"]
_EVEN = ["v^2", "r^2", "u|u| delta^2"]
_SATURATION = "u|u| delta^3"
FORMS = {
    "standard": (_SURGE, [*_LINEAR, *_MODULUS], 0.05),
    "model_tests": ([*_SURGE, *_EVEN], [*_LINEAR, *_MODULUS, _SATURATION], 0.0),
    "cubic": ([*_SURGE, *_EVEN], [*_LINEAR, *_CUBIC, _SATURATION], 0.0),
}
"""Terms of surge, terms of sway and yaw, and weight of the prior of symmetry, by form of the hull.
`standard` and `model_tests` are the recipes."""
SPEED = 7.7175
"""Service speed of the ship in m/s."""
CIRCLE_DURATION = 80.0
"""Duration of the tests in s, at the scale of the model."""
_REFERENCE_DRIFT = 0.2
"""Non-dimensional sway velocity and yaw rate at which cubic and modulus terms are equal."""


def draw_ship(seed: int) -> dict[str, Any]:
    """Return the content of the vessel file of a drawn ship."""
    generator = np.random.default_rng([137, seed])
    vessel: dict[str, Any] = yaml.safe_load((bench.CONFIGS / "vessels/mariner.yaml").read_text())
    has_modulus = seed % 2 == 1
    modulus_of = {"v^3": "v|v|", "v^2 r": "r|v|", "v r^2": "v|r|", "r^3": "r|r|"}
    for axis, terms in vessel["coefficients"].items():
        drawn = {}
        for term, value in terms.items():
            new_value = float(value) * math.exp(0.15 * generator.standard_normal())
            if has_modulus and term in modulus_of:
                drawn[modulus_of[term]] = _REFERENCE_DRIFT * new_value
            else:
                drawn[term] = new_value
        vessel["coefficients"][axis] = drawn
    vessel["name"] = "ship"
    vessel["rudder"] |= {
        "rate": f"{generator.uniform(2.3, 5.0):.4g} deg/s",
        "response": {"kind": "first_order", "time": f"{generator.uniform(0.5, 3.0):.4g} s"},
    }
    return vessel


def simulate_truth(vessel: str, step: float) -> dict[str, dict[str, float]]:
    """Return the indices of the full-scale ship in the manoeuvres of the booklet."""
    config = validate_config(
        {
            "vessel": vessel,
            "duration": 2500.0,
            "step": step,
            "trials": [{"kind": "zigzag", "count": 1, "heading": ["10 deg"]}],
            "identification": {},
            "validation": {},
        },
        SimulatedTrials,
        "bench",
    )
    manoeuvres = make_booklet_config({}).manoeuvres
    runs = simulate_trials(manoeuvres, config)
    return {
        run.manoeuvre.name or "": run.manoeuvre.compute_indices(run.true_log, None)
        for run in runs
        if run.fault_text is None
    }


def make_booklet_config(gear: dict[str, Any], model: str = "hull") -> BookletConfig:
    """Return the settings of the booklet at the scale of the model tests."""
    manoeuvres = [
        {**entry, "drive": 1.0, "start": "0 s"}
        | ({"reversals": 3} if entry["kind"] == "zigzag" else {})
        for entry in MANOEUVRES
    ]
    content = {
        "model": model,
        "length": BASIN_LENGTH,
        "scale": BASIN_SCALE,
        "inputs": {"delta": {"steer": "35 deg", **gear}},
        "initial": {"u": SPEED / BASIN_SCALE**0.5},
        "duration": 2500.0 / BASIN_SCALE**0.5,
        "repeat": ["train", "validation", "test"],
        "skip_failed": True,
        "draws": 25,
        "manoeuvres": manoeuvres,
    }
    return validate_config(content, BookletConfig, "bench")


def make_settings(forms: list[str]) -> FitSettings:
    """Return the settings of the fits, without networks."""
    baselines = {
        form: {
            "kind": "regressors",
            "ridge": 1e-4,
            "terms": {"u": FORMS[form][0], "v": FORMS[form][1], "r": FORMS[form][1]},
            "dissipative": True,
            "bounded": True,
        }
        for form in forms
    }
    refits = {
        form: {"horizon": "20 s", "every": "10 s", "prior": 1.0, "asymmetric": FORMS[form][2]}
        for form in forms
    }
    content = {
        "prepare": {
            "grid": {"step": "0.1 s"},
            "derivative": {"kind": "savitzky_golay", "window": "0.9 s", "order": 2},
            "hold": "mean",
        },
        "signals": {"inputs": ["delta"]},
        "integrator": "semi_implicit_euler",
        "bands": None,
        "evaluation": {
            "protocols": {"T60": {"kind": "windows", "length": "60 s", "first": "5 s"}},
            "selection": "T60",
            "scales": {"u": "0.08 m/s", "v": "0.09 m/s", "r": "4 deg/s"},
        },
        "baseline": {"kind": "regressors", "sets": ["linear"]},
        "baselines": baselines,
        "refit": refits,
    }
    return validate_config(content, FitSettings, "bench")


def predict_ship(
    logs: dict[str, Log], forms: list[str]
) -> dict[str, tuple[float, dict[tuple[str, str], tuple[float, float, float]]]]:
    """Return validation error, and value and interval by manoeuvre and index, for each form."""
    gear_parameters = identify_steering_gear([*logs.values()], "cmd_delta", "delta")
    gear: dict[str, Any] = {}
    if gear_parameters.rate is not None:
        gear["rate"] = gear_parameters.rate.value
    for name in ("lag", "delay"):
        parameter = getattr(gear_parameters, name)
        if parameter is not None:
            gear[name] = parameter.value
    kinds = {"TC": "turning_circle", "ZZ": "zigzag"}
    splits = {
        split: [logs[name].replace(manoeuvre=kinds[name[:2]]) for name in names]
        for split, names in SPLIT.items()
    }
    settings = make_settings(forms)
    prepared = prepare_splits(splits, settings)
    fitter = Fitter(prepared, settings, FitStore())
    results = {}
    for form in forms:
        fitted_model = fitter.fit_baseline(form)
        config = make_booklet_config(gear, form)
        pages, _ = compute_booklet_pages(config, fitted_model, prepared, fitter.velocity_limits)
        booklet = build_booklet(form, BASIN_LENGTH, BASIN_SCALE, config.draws, config.level, pages)
        predictions = {}
        for row in booklet.pages:
            for name in INDICES.get(row.name, ()):
                entry = row.indices.get(name)
                if entry is not None and entry.interval is not None:
                    factor = entry.ship / entry.value
                    low, high = entry.interval
                    predictions[row.name, name] = (entry.ship, factor * low, factor * high)
        results[form] = (float(fitted_model.notes["validation"]), predictions)
    return results


def print_coverage(hits: Mapping[str, Mapping[str, Sequence[tuple[bool, float, float]]]]) -> None:
    """Print coverage, median width and median error, by form and index."""
    for form, by_label in hits.items():
        every = [entry[0] for entries in by_label.values() for entry in entries]
        print(f"{form}: {np.mean(every):.3f} of {len(every)} intervals contain the index")
        for label, entries in by_label.items():
            covered_share = np.mean([entry[0] for entry in entries])
            width, error = np.nanmedian([entry[1:] for entry in entries], axis=0)
            print(
                f"  {label:38s} {covered_share:6.3f} of {len(entries):3d}, width {width:.3f}, error"
                f" {error:.3f}"
            )


def main() -> None:
    """Print the coverage of each index."""
    arguments = bench.options(__doc__, first=0, count=40, forms=FORMS, table=None)
    forms = list(arguments.forms)
    hits: dict[str, dict[str, list[tuple[bool, float, float]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    begin = time.perf_counter()
    for seed in range(arguments.first, arguments.first + arguments.count):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "ship.yaml"
            file.write_text(yaml.safe_dump(draw_ship(seed)))
            truth = simulate_truth(str(file), 0.1 * BASIN_SCALE**0.5)
            motion = simulate_basin_tests(str(file))
        logs = {
            # a full circle; the rest costs time only
            name: log.select_rows(log.t < CIRCLE_DURATION)
            for name, log in measure_basin_tests(motion, np.random.default_rng([50, seed])).items()
        }
        try:
            results = predict_ship(logs, forms)
        except ResidnetError as error:
            print(f"ship {seed}: {error}")
            continue
        chosen = min(results, key=lambda form: results[form][0])
        results["chosen"] = copy.copy(results[chosen])
        for form, (_, predictions) in results.items():
            for manoeuvre, names in INDICES.items():
                for name in names:
                    value = truth.get(manoeuvre, {}).get(name)
                    if value is None:
                        continue
                    label = f"{manoeuvre} {name}"
                    prediction = predictions.get((manoeuvre, name))
                    # an index that the booklet leaves out is no hit
                    entry = (False, math.nan, math.nan)
                    if prediction is not None:
                        ship, low, high = prediction
                        entry = (
                            low <= value <= high,
                            (high - low) / abs(value),
                            abs(ship / value - 1.0),
                        )
                    hits[form][label].append(entry)
        covered = [entry[0] for entries in hits["chosen"].values() for entry in entries]
        print(
            f"ship {seed}: {chosen} chosen; {np.mean(covered):.3f} of {len(covered)} covered;"
            f" {time.perf_counter() - begin:.0f} s",
            flush=True,
        )
        if arguments.table is not None:
            Path(arguments.table).write_text(json.dumps(hits))
    print_coverage(hits)


if __name__ == "__main__":
    main()
