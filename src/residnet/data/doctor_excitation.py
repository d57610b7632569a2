"""How much of the vessel's envelope a log covers, and whether effects can be told apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.data.doctor_findings import Finding, Level, show


def excitation_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Findings about ranges, standstill and collinearity of velocities and inputs."""
    moving = []
    for name in (*(name for name in VELOCITY if name in log.channels), *inputs):
        values, unit = log[name][np.isfinite(log[name])], log.units[name]
        low, high, std = float(values.min()), float(values.max()), float(values.std())
        figures = {"min": low, "max": high, "std": std}
        if std > 1e-6 * max(abs(low), abs(high)):
            moving.append(name)
            yield Finding("info", "range", f"{name} from {show(low, unit)} to {show(high, unit)}, standard deviation {show(std, unit)}", figures)
        else:
            text = f"{name} stays at {show(low, unit)}: its effect cannot be identified from this log alone"
            yield Finding("warning", "constant", text, figures)
    if "u" in log.channels and "v" in log.channels:
        speed = np.hypot(log["u"], log["v"])
        slow = 0.1 * float(np.nanpercentile(speed, 95))
        share = float(np.mean(speed[np.isfinite(speed)] <= slow))
        if share > 0.05:
            text = f"slower than {show(slow, 'm/s')} (a tenth of its speed) for {100.0 * share:.2g} % of the time: little to learn there"
            yield Finding("warning" if share > 0.2 else "info", "standing", text, {"share": share})
    if any(name in log.channels for name in VELOCITY) and not any(name in VELOCITY for name in moving):
        yield Finding("error", "no_motion", "no velocity varies: a fit would find nothing but noise")
    if len(moving) > 1:
        yield from _collinearity(log, moving)


def _collinearity(log: Log, names: Sequence[str]) -> Iterator[Finding]:
    columns = log.stack(tuple(names))
    columns = columns[np.isfinite(columns).all(axis=1)]
    if columns.shape[0] < 10 * len(names):
        return
    scaled = (columns - columns.mean(axis=0)) / np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], np.finfo(float).tiny))
    worst = ", ".join(names[i] for i in np.argsort(-np.abs(directions[-1]))[:3] if abs(directions[-1][i]) > 0.2)
    text = f"condition number of [{', '.join(names)}] (centred, scaled): {condition:.3g}"
    level: Level = "error" if condition > 1e6 else "warning" if condition > 30.0 else "info"
    if level != "info":
        text += f"; {worst} move together" + (": one of them must go" if level == "error" else ", their effects are hard to tell apart")
    yield Finding(level, "condition", text, {"condition": condition})
