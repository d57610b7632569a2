"""Identified actuators as lines of a vessel file, and as numbers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from residnet.physics.actuators.identify import StepAnswer, ThrottleMap, ThrustFit


def vessel_lines(
    run: str,
    files: Sequence[Path],
    throttle: ThrottleMap | None,
    step: StepAnswer | None,
    thrust: tuple[ThrustFit, ThrustFit] | None,
) -> str:
    """Return lines for the section `actuators` of a vessel file, 95 % intervals as comments."""
    lines = [f"# from {', '.join(path.name for path in files)}; intervals are 95 %"]
    if throttle is not None:
        k, o, m = throttle.slope, throttle.offset, throttle.n_max
        lines.append(
            f"# n = {k.value * 60:.6g} rpm * throttle {o.value * 60:+.4g} rpm (slope"
            f" {k.low * 60:.6g} .. {k.high * 60:.6g})"
        )
        about = (
            f"{m.low * 60:.5g} .. {m.high * 60:.5g}"
            if throttle.saturated
            else "largest measured: nothing saturated"
        )
        lines.append(f"n_max: {m.value * 60:.5g} rpm  # {about}")
    if step is not None:
        lines.append(
            f"n_rate: {step.rate.value * 60:.5g} rpm/s  # {step.rate.low * 60:.5g} .."
            f" {step.rate.high * 60:.5g}"
        )
        lines.append(
            f"# dead_time: {step.dead_time.value:.3g} s  ({step.dead_time.low:.3g} .."
            f" {step.dead_time.high:.3g})"
        )
    for name, fit in zip(("forward", "reverse"), thrust or (), strict=False):
        lines.append(
            f"{name}: [{', '.join(f'{c.value:.6g}' for c in fit.coefficients)}]  # rms residual"
            f" {fit.rms:.3g} N per thruster"
        )
        lines += [
            f"#   c{i}: {c.low:.6g} .. {c.high:.6g} {c.unit}"
            for i, c in enumerate(fit.coefficients)
        ]
    if thrust is not None:
        lines.append(f"curve_range: [{thrust[1].low * 60:.5g} rpm, {thrust[0].high * 60:.5g} rpm]")
    lines.append(f"source: {json.dumps(f'identified by residnet, run {run}')}")
    return "\n".join(lines) + "\n"


def numbers(
    throttle: ThrottleMap | None,
    step: StepAnswer | None,
    thrust: tuple[ThrustFit, ThrustFit] | None,
) -> dict[str, Any]:
    """Return the identified actuators as the content of actuators.json.

    Args:
        throttle: map from throttle to revolutions, where identified.
        step: rate limit and dead time, where identified.
        thrust: thrust curves ahead and astern, where identified.
    """
    out: dict[str, Any] = {"schema": "residnet.actuators/1"}
    if throttle is not None:
        parts = {"slope": throttle.slope, "offset": throttle.offset, "n_max": throttle.n_max}
        out["throttle"] = {name: estimate._asdict() for name, estimate in parts.items()} | {
            "saturated": throttle.saturated
        }
    if step is not None:
        out["step"] = {name: estimate._asdict() for name, estimate in step._asdict().items()}
    for name, fit in zip(("forward", "reverse"), thrust or (), strict=False):
        entries = {f"c{i}": c._asdict() for i, c in enumerate(fit.coefficients)}
        out[name] = entries | {"low": fit.low, "high": fit.high, "rms": fit.rms}
    return out
