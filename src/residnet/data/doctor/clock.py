"""What the data doctor sees in the clock: rate, jitter, gaps, order, start."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, Level, share_of

# stamps scatter by this share of a step before interpolation between them suffers
_MOST_JITTER = 0.05
# longest time step, in usual ones, that the grid interpolates across
_BRIDGED = 3.0
# stamps beyond this count from 1970
_EPOCH = 1e8


def order_findings(log: Log) -> list[Finding]:
    """Return why nothing else can be examined: times that are NaN, repeat or run backwards."""
    if not np.isfinite(log.t).all():
        count = int((~np.isfinite(log.t)).sum())
        text = f"{count} of {len(log)} samples have no time"
        return [
            Finding(
                "fatal", "time_missing", text, {"count": count}, "delete them or restore their time"
            )
        ]
    backwards, repeats = np.flatnonzero(np.diff(log.t) < 0.0), np.flatnonzero(np.diff(log.t) == 0.0)
    out = []
    if backwards.size:
        text = (
            f"time runs backwards {backwards.size} times, first after t ="
            f" {log.t[backwards[0]]:.6g} s"
        )
        out.append(
            Finding(
                "fatal",
                "time_backwards",
                text,
                {"count": backwards.size},
                "sort the rows, or split the log where its clock restarts",
            )
        )
    if repeats.size:
        text = f"{repeats.size} time stamps repeat, first t = {log.t[repeats[0]]:.6g} s"
        out.append(
            Finding(
                "fatal", "duplicate_rows", text, {"count": repeats.size}, "delete the repeated rows"
            )
        )
    return out


def clock_findings(log: Log) -> Iterator[Finding]:
    """Return the findings about an increasing clock."""
    dt = np.diff(log.t)
    step, span = float(np.median(dt)), float(log.t[-1] - log.t[0])
    near = dt[dt <= 1.5 * step]
    jitter = float(near.std() / step)
    level: Level = "will mislead" if jitter > _MOST_JITTER else "note"
    text = (
        f"{1.0 / step:.4g} Hz over {span:.1f} s from t = {log.t[0]:.1f} s, steps vary by"
        f" {share_of(jitter)} (standard deviation)"
    )
    action = (
        "use the sender's stamps, or a coarser grid (prepare.grid.step), so that averaging replaces"
        " interpolation"
        if level != "note"
        else ""
    )
    yield Finding(
        level, "clock", text, {"rate": 1.0 / step, "jitter": jitter, "span": span}, action
    )
    yield from _gaps(log, dt, step, span)
    if abs(log.t[0]) > step:
        kind = "Unix time" if log.t[0] > _EPOCH else "not at 0"
        action = "times count from the log's own clock, nothing to do"
        yield Finding(
            "note",
            "clock_start",
            f"time starts at {log.t[0]:.10g} s ({kind})",
            {"start": float(log.t[0])},
            action,
        )


def _gaps(log: Log, dt: np.ndarray, step: float, span: float) -> Iterator[Finding]:
    short = (dt > 1.5 * step) & (dt <= _BRIDGED * step * (1.0 + 1e-6))
    if short.any():
        text = (
            f"{int(short.sum())} single samples or pairs are missing (steps up to"
            f" {dt[short].max():.3g} s)"
        )
        yield Finding(
            "note",
            "dropped_samples",
            text,
            {"count": short.sum(), "longest": dt[short].max()},
            "the grid interpolates across them",
        )
    gaps = np.flatnonzero(dt > _BRIDGED * step * (1.0 + 1e-6))
    if gaps.size:
        longest, lost = gaps[np.argmax(dt[gaps])], float((dt[gaps] - step).sum())
        text = (
            f"{gaps.size} gaps, {lost:.2f} s in all, the longest {dt[longest]:.2f} s after t ="
            f" {log.t[longest]:.2f} s"
        )
        at = np.zeros(len(log), dtype=bool)
        at[gaps + 1] = True
        level: Level = "fatal" if lost > 0.5 * span else "will mislead"
        figures = {
            "count": gaps.size,
            "lost": lost,
            "longest": float(dt[longest]),
            "t": float(log.t[longest]),
        }
        yield Finding(level, "gaps", text, figures, "split the log there (mask kind: gap)", at)
