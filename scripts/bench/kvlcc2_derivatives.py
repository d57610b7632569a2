"""Coverage of the 95 % intervals of derivatives of the KVLCC2 from simulated tests.

    python scripts/bench/kvlcc2_derivatives.py [--first 0] [--count 20] [--order 1] [--table FILE]
        [--prior-weight fixed] [--refit-prior 0] [--horizon 20]

The ship is the MMG model with the coefficients of Yasukawa and Yoshimura (2015), Tables 3 and 4, of
7 m length. Each draw adds noise to its simulated zigzags and turning circles and identifies all
coefficients from the usual priors. Printed for each derivative in the prime I system: its value,
the mean estimate, the mean standard error, and the share of intervals that contain the value. A
derivative is identifiable if its standard error is less than half of its value in most draws.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import bench
import numpy as np

from residnet.core.config import validate_config
from residnet.core.log import Log
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.booklet import BookletConfig
from residnet.evaluation.derivatives import compute_derivatives
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.prepared import prepare_splits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.trials import TrialEnvironment, simulate_manoeuvres
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.similarity import Particulars
from residnet.tasks.fit.booklet import build_booklet_vessel

TANKER: dict[str, Any] = {
    "kind": "mmg",
    "hull": {"length": 7, "beam": 1.27, "draught": 0.46, "mass": "3270 kg", "x_G": 0.244},
    "propeller": {"diameter": "0.216 m", "thrust": [0.2931, -0.2753, -0.1385]},
    "rudder": {"area": 0.0539, "aspect": 1.827, "race": 0.626},
}
PUBLISHED = {
    "m_x": 0.022, "m_y": 0.223, "J_z": 0.011, "R_0": 0.022, "X_vv": -0.040, "X_vr": 0.002,
    "X_rr": 0.011, "X_vvvv": 0.771, "Y_v": -0.315, "Y_r": 0.083, "Y_vvv": -1.607, "Y_vvr": 0.379,
    "Y_vrr": -0.391, "Y_rrr": 0.008, "N_v": -0.137, "N_r": -0.049, "N_vvv": -0.030,
    "N_vvr": -0.294, "N_vrr": 0.055, "N_rrr": -0.013, "t_P": 0.220, "w_P0": 0.35, "C_2p": 1.6,
    "C_2n": 1.1, "t_R": 0.387, "a_H": 0.312, "x_H": -0.464, "gamma_p": 0.640, "gamma_n": 0.395,
    "l_R": -0.710, "epsilon": 1.09, "kappa": 0.50, "Y_0": 0.0, "N_0": 0.0,
}  # fmt: skip
PARTICULARS = Particulars(length=7.0, speed=1.179, draught=0.46, beam=1.27)
NOISE = {"u": 0.004, "v": 0.004, "r": 0.0009, "psi": 0.0009, "x": 0.003, "y": 0.003}
"""Standard deviation of the noise by channel, SI."""
MANOEUVRES: tuple[dict[str, Any], ...] = (
    *({"kind": "zigzag", "name": f"zz_{angle}_{first}", "rudder": f"{angle} deg",
       "heading": f"{angle} deg", "first": first, "reversals": 4}
      for angle in (10, 20) for first in ("starboard", "port")),
    {"kind": "zigzag", "name": "zz_20_5", "rudder": "20 deg", "heading": "5 deg", "reversals": 4},
    *({"kind": "turning_circle", "name": f"tc_{angle}", "rudder": f"{angle} deg",
       "until": "360 deg"} for angle in (35, -35, 20)),
)  # fmt: skip
SPLIT = {
    "train": ("zz_10_starboard", "zz_20_starboard", "zz_20_port", "zz_20_5", "tc_35", "tc_-35"),
    "validation": ("zz_10_port",),
    "test": ("tc_20",),
}


def simulate_tests() -> dict[str, Log]:
    """Return the motion of the published tanker in all tests, without noise."""
    spec, model = build_published()
    content = {
        "model": "mmg",
        "length": 7.0,
        "inputs": {
            "n": {"drive": 10.4},
            "delta": {"steer": "35 deg", "rate": "15.8 deg/s"},
        },
        "initial": {"u": 1.179},
        "duration": 250.0,
        "draws": 20,
        "manoeuvres": [{**entry, "drive": 1.0, "start": "4 s"} for entry in MANOEUVRES],
    }
    config = validate_config(content, BookletConfig, "bench")
    vessel = build_booklet_vessel(config, FittedModel(spec, model, {}), config.inputs)
    sea = TrialEnvironment(None, DisturbanceConfig(), SensorsConfig(), 0)
    runs = simulate_manoeuvres(vessel, config.manoeuvres, sea, config.duration, spec.dt)
    logs = {}
    for run in runs:
        log = run.true_log
        names = ("x", "y", "psi", "u", "v", "r", "delta")
        channels = {name: log[name] for name in names} | {"n": log["cmd_n"]}
        logs[run.manoeuvre.name or ""] = Log(
            log.name, log.t - log.t[0], channels, manoeuvre=run.manoeuvre.kind
        )
    return logs


def build_published() -> tuple[ModelSpec, HybridDynamics]:
    """Return the MMG model with the published coefficients."""
    beliefs = {name: (value, 0.0) for name, value in PUBLISHED.items()}
    spec = ModelSpec.model_validate(
        {
            "name": "mmg",
            "role": "baseline",
            "signals": SignalsConfig(inputs=("n", "delta")).model_dump(),
            "baseline": {**TANKER, "beliefs": beliefs},
            "dt": 0.2,
            "integrator": "heun",
            "low": (0.3, -0.4, -0.08, 8.0, -0.62),
            "high": (1.3, 0.4, 0.08, 12.0, 0.62),
        }
    )
    model = spec.build()
    assert isinstance(model, HybridDynamics)
    return spec, model


def make_settings(prior_weight: str, refit_prior: float, horizon: float) -> FitSettings:
    """Return the settings of the fit: an MMG model with usual priors.

    Args:
        prior_weight: `prior_weight` of the MMG model.
        refit_prior: weight of the least-squares solution in the refit.
        horizon: length of the free runs of the refit in s.
    """
    content = {
        "prepare": {
            "grid": {"step": "0.2 s", "held": ["n"]},
            "hold": "mean",
            "derivative": {"kind": "savitzky_golay", "window": "2.2 s", "order": 2},
        },
        "signals": {"inputs": ["n", "delta"]},
        "integrator": "heun",
        "bands": None,
        "baseline": {"kind": "regressors", "sets": ["linear"]},
        "baselines": {"mmg": {**TANKER, "prior_weight": prior_weight}},
        "refit": {"mmg": {"horizon": horizon, "every": horizon, "prior": refit_prior}},
        "evaluation": {
            "protocols": {"T20": {"kind": "windows", "length": "20 s"}},
            "selection": "T20",
            "scales": {"u": 0.1, "v": 0.08, "r": "1.5 deg/s"},
        },
    }
    return validate_config(content, FitSettings, "bench")


def main() -> None:
    """Print the coverage of each derivative."""
    arguments = bench.options(
        __doc__,
        first=0,
        count=20,
        order=1,
        table=None,
        prior_weight="fixed",
        refit_prior=0.0,
        horizon=20.0,
    )
    spec, model = build_published()
    begin = time.perf_counter()
    logs = simulate_tests()
    settings = make_settings(arguments.prior_weight, arguments.refit_prior, arguments.horizon)
    entries: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for draw in range(arguments.first, arguments.first + arguments.count):
        generator = np.random.default_rng([2, draw])
        noisy = {
            name: log.replace(
                channels={
                    channel: values
                    + NOISE.get(channel, 0.0) * generator.standard_normal(len(values))
                    for channel, values in log.channels.items()
                }
            )
            for name, log in logs.items()
        }
        splits = {split: [noisy[name] for name in names] for split, names in SPLIT.items()}
        fitter = Fitter(prepare_splits(splits, settings), settings, FitStore())
        fitted = fitter.fit_baseline("mmg")
        # the same expansion point for both: the training ranges determine it
        reference = spec.model_copy(update={"low": fitted.spec.low, "high": fitted.spec.high})
        truth = {
            row.name: row.prime_i
            for row in compute_derivatives(
                reference, model, PARTICULARS, order=arguments.order
            ).rows
        }
        assert fitted.covariance is not None
        assert isinstance(fitted.model, HybridDynamics)
        table = compute_derivatives(
            fitted.spec,
            fitted.model,
            PARTICULARS,
            covariance=fitted.covariance.tolist(),
            order=arguments.order,
        )
        for row in table.rows:
            value = truth.get(row.name)
            if value is not None and row.prime_i is not None and row.prime_i_error is not None:
                entries[row.name].append((value, row.prime_i, row.prime_i_error))
        print(f"draw {draw}: {time.perf_counter() - begin:.0f} s", flush=True)
        if arguments.table is not None:
            Path(arguments.table).write_text(json.dumps(entries))
    _print_coverage(entries)


def _print_coverage(entries: dict[str, list[tuple[float, float, float]]]) -> None:
    hits: list[bool] = []
    print(f"{'':12s}{'published':>12s}{'estimate':>12s}{'error':>12s}{'coverage':>10s}")
    for name, rows in entries.items():
        published, estimates, errors = np.array(rows).T
        is_covered = np.abs(estimates - published) <= 1.96 * errors
        is_identifiable = bool(np.median(errors / np.abs(published)) < 0.5)
        print(
            f"{name:12s}{1e5 * published.mean():12.4g}{1e5 * estimates.mean():12.4g}"
            f"{1e5 * errors.mean():12.4g}{is_covered.mean():10.2f}"
            + ("" if is_identifiable else "  not identifiable")
        )
        if is_identifiable:
            hits += is_covered.tolist()
    print(f"identifiable: {np.mean(hits):.3f} of {len(hits)} intervals contain the value")


if __name__ == "__main__":
    main()
