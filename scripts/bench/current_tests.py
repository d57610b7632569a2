"""How often a current is detected in logs with and without one.

    python scripts/bench/current_tests.py [--vessels 12] [--logs 6] [--seed 3000]

Small boats drawn at random sail in still water, then in a constant current of 5 to 25 % of their
speed that differs from log to log. Printed for each boat: the significant currents of both, and the
root mean square of the errors of the estimates over their standard errors. A false positive is a
boat in still water with any significant current; `residnet new` would draft `current` for it.
"""

from __future__ import annotations

import math
import time

import bench
import numpy as np
from random_vessels import small_boat_logs

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.log import Log
from residnet.identification.recipe import TrainingDataSummary, make_hull_terms
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.training.current import estimate_currents, select_significant_currents
from residnet.training.current_config import CurrentConfig

_DURATION = 120.0


def add_current(log: Log, current: complex) -> Log:
    """Return a log over ground of a vessel in a current, north + 1j east in m/s."""
    drift = current * (log.t - log.t[0])
    body = current * np.exp(-1j * log["psi"])
    moved = {
        "x": log["x"] + drift.real,
        "y": log["y"] + drift.imag,
        "u": log["u"] + body.real,
        "v": log["v"] + body.imag,
    }
    return log.replace(channels={**log.channels, **moved})


def test_fleet(logs: list[Log], inputs: tuple[str, ...], currents: np.ndarray) -> tuple[int, float]:
    """Return the number of significant currents and the RMS error in standard errors."""
    config = SignalsConfig(inputs=inputs)
    signals = config.build()
    step = float(np.median(np.diff(logs[0].t)))
    prepare = PrepareConfig.model_validate(
        {
            "grid": {"step": step},
            "derivative": {"kind": "savitzky_golay", "window": 13 * step, "order": 2},
            "hold": "mean",
        }
    )
    moved = [add_current(log, current) for log, current in zip(logs, currents, strict=True)]
    prepared = [prepare_log(log, "train", config.input_columns, prepare) for log in moved]
    summary = TrainingDataSummary.from_channel_names(signals.names)
    hull = RegressorsConfig.model_validate(
        {"terms": make_hull_terms(summary), "ridge": 1e-4}
    ).build(signals.names)
    estimates, rows = estimate_currents(hull, signals, prepared, CurrentConfig())
    speeds = [float(np.nanmedian(np.hypot(log["u"], log["v"]))) for log in moved]
    truth = np.stack((currents.real, currents.imag), axis=1)
    errors = (estimates - truth) / np.array([row.standard_error for row in rows])
    return len(select_significant_currents(rows, speeds)), float(np.sqrt(np.mean(errors**2)))


def main() -> None:
    """Print the rates of detection."""
    arguments = bench.options(__doc__, vessels=12, logs=6, seed=3000)
    n_false = 0
    n_detected = 0
    for number in range(arguments.vessels):
        kind = ("boat", "twin")[number % 2]
        inputs = ("n", "delta") if kind == "boat" else ("n_port", "n_stbd")
        seed = arguments.seed + number
        logs = small_boat_logs(kind, seed, arguments.logs, _DURATION)
        rng = np.random.default_rng(seed)
        speed = float(np.median([np.median(log["u"]) for log in logs]))
        sizes = speed * rng.uniform(0.05, 0.25, len(logs))
        currents = sizes * np.exp(1j * rng.uniform(-math.pi, math.pi, len(logs)))
        start = time.process_time()
        still, still_score = test_fleet(logs, inputs, np.zeros(len(logs), dtype=np.complex128))
        moving, moving_score = test_fleet(logs, inputs, currents)
        seconds = time.process_time() - start
        n_false += still > 0
        n_detected += moving
        print(
            f"{kind:5s} {seed}: still water {still} significant (RMS error {still_score:.2f}"
            f" standard errors), with currents {moving} of {len(logs)} ({moving_score:.2f}),"
            f" {seconds:.1f} s",
            flush=True,
        )
    n_logs = arguments.vessels * arguments.logs
    print(f"false positives: {n_false} of {arguments.vessels} boats")
    print(f"detected currents: {n_detected} of {n_logs} logs")


if __name__ == "__main__":
    main()
