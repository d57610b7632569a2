"""What the data doctor sees in single channels and in the clock: gaps, freezes, jumps, outliers, limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import ACCELERATION, STATE, VELOCITY
from residnet.data.doctor_findings import Finding, Level, show
from residnet.data.masks import Frozen, Outlier
from residnet.data.readers.base import unwrap

_CLIPPABLE = (*VELOCITY, "phi", "p", *ACCELERATION)


def channel_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Findings about names, clock and values of a log as recorded; `inputs` drive the vessel and may jump and rest at their limits."""
    yield from _channels(log)
    yield from _clock(log)
    yield from _missing(log)
    yield from _repeats(log)
    yield from _jumps(log, inputs)
    yield from _outliers(log)
    yield from _limits(log, inputs)


def _channels(log: Log) -> Iterator[Finding]:
    named = ", ".join(f"{name} [{unit}]" for name, unit in log.units.items())
    yield Finding("info", "channels", f"{len(log.channels)} channels, {len(log)} samples, manoeuvre {log.manoeuvre}: {named}")
    absent = [name for name in STATE if name not in log.channels]
    if absent:
        yield Finding("warning", "absent", f"no {', '.join(absent)}: free runs cannot be scored on what is not measured")


def _clock(log: Log) -> Iterator[Finding]:
    dt = np.diff(log.t)
    step, span = float(np.median(dt)), float(log.t[-1] - log.t[0])
    jitter = float(dt[dt <= 1.5 * step].std() / step)
    level: Level = "warning" if jitter > 0.05 else "info"
    text = f"{1.0 / step:.4g} Hz over {span:.1f} s from t = {log.t[0]:.1f} s, steps vary by {100.0 * jitter:.2g} % (standard deviation)"
    text += "; interpolation will smooth" if level == "warning" else ""
    yield Finding(level, "clock", text, {"rate": 1.0 / step, "jitter": jitter, "span": span})
    gaps = np.flatnonzero(dt > 1.5 * step)
    if gaps.size:
        longest, lost = gaps[np.argmax(dt[gaps])], float((dt[gaps] - step).sum())
        text = f"{gaps.size} gaps, {lost:.2f} s in all, the longest {dt[longest]:.2f} s after t = {log.t[longest]:.2f} s; mask them (kind: gap)"
        yield Finding("error" if lost > 0.5 * span else "warning", "gaps", text, {"count": gaps.size, "lost": lost, "longest": float(dt[longest])})


def _missing(log: Log) -> Iterator[Finding]:
    for name, values in log.channels.items():
        share = float(np.isnan(values).mean())
        if share:
            text = f"{name} is missing in {100.0 * share:.2g} % of the samples; mask them (kind: nan)"
            yield Finding("error" if share > 0.5 else "warning", "nan", text, {"share": share})


def _repeats(log: Log) -> Iterator[Finding]:
    same = float((np.diff(log.stack(tuple(log.channels)), axis=0) == 0.0).all(axis=1).mean())
    if same > 0.01:
        text = f"{100.0 * same:.2g} % of the rows repeat the row before: logged faster than measured, or at rest"
        yield Finding("error" if same > 0.5 else "warning", "repeated_rows", text, {"share": same})
    if "x" in log.channels and "y" in log.channels:
        share = float(Frozen().apply(log).mean())
        held = float((np.diff(log.stack(("x", "y")), axis=0) == 0.0).all(axis=1).mean())
        if share:
            text = f"position repeats bit by bit in {100.0 * held:.2g} % of the steps; freezes of 5 steps or more and the 2 s after each "
            text += f"make {100.0 * share:.2g} % of the samples unusable; mask them (kind: frozen)"
            yield Finding("error" if share > 0.5 else "warning", "frozen", text, {"share": share, "held": held})


def _jumps(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Changes within one sample."""
    for name, values in log.channels.items():
        unit = log.units[name]
        smooth = unwrap(values) if unit == "rad" else values
        span, change = float(np.nanmax(smooth) - np.nanmin(smooth)), np.abs(np.nan_to_num(np.diff(smooth)))
        at = int(np.argmax(change))
        share = float(change[at]) / span if span > 0.0 else 0.0
        figures = {"largest": float(change[at]), "t": float(log.t[at + 1]), "share_of_range": share}
        text = f"{name} changes by {show(change[at], unit)} within one sample ({100.0 * share:.0f} % of its range) at t = {log.t[at + 1]:.2f} s"
        if name in inputs and share > 0.25:
            yield Finding("info", "input_jump", f"{text}; derivatives are biased around it, mask them (kind: input_jump)", figures)
        elif name in VELOCITY and share > 0.1:
            yield Finding("warning", "jump", f"{text}; mask it (kind: jump)", figures)


def _outliers(log: Log) -> Iterator[Finding]:
    for name in (name for name in STATE if name in log.channels):
        share = float(Outlier(channels=(name,)).apply(log).mean())
        if share > 0.001:
            text = f"{100.0 * share:.2g} % of {name} lie more than 3 standard deviations from their neighbours; mask them (kind: outlier)"
            yield Finding("warning" if share > 0.01 else "info", "outliers", text, {"share": share})


def _limits(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Samples exactly at the largest or smallest value of their channel."""
    for name in (*(name for name in _CLIPPABLE if name in log.channels and name not in inputs), *inputs):
        known = log[name][np.isfinite(log[name])]
        low, high = known.min(), known.max()
        at = (known == low) | (known == high)
        share = float(at.mean())
        # every channel reaches each extreme once, and one of few levels (a switch, a constant) is there by nature
        if at.sum() <= 2 or share <= 0.01 or np.unique(known).size <= 20:
            continue
        text = (
            f"{name} is exactly at its limits {show(low, log.units[name])} or {show(high, log.units[name])} in {100.0 * share:.2g} % of the samples"
        )
        if name in inputs:
            yield Finding("info", "at_limits", text, {"share": share})
        else:
            yield Finding("warning", "clipping", f"{text}: the sensor clips or holds", {"share": share})
