"""Stretches that were filled by straight lines between the samples at their ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, share_of
from residnet.data.doctor.signals import noise_of

# shortest stretch, in samples and s
_SAMPLES = 8
_SECONDS = 1.0
# share of a channel that may be straight before this is what the channel always does
_USUAL = 0.4
_MOVED = ("x", "y", "psi", "u", "v", "r")


def interpolated_findings(log: Log, measured: Sequence[str]) -> Iterator[Finding]:
    """Return the stretches in which measured channels run along exactly straight lines."""
    names, at = [], np.zeros(len(log), dtype=bool)
    for name in measured:
        if name in _MOVED:
            straight = _straight(log, name)
            if straight.any():
                names.append(name)
                at |= straight
    if not names:
        return
    starts, stops = stretches(at)
    seconds = log.t[stops - 1] - log.t[starts]
    longest = int(np.argmax(seconds))
    text = (
        f"{', '.join(names)} run along exactly straight lines for {seconds.sum():.1f} s"
        f" ({share_of(float(at.mean()))}), the longest {seconds[longest]:.1f} s from t ="
        f" {log.t[starts[longest]]:.2f} s: they were interpolated"
    )
    figures = {
        "seconds": float(seconds.sum()),
        "longest": float(seconds[longest]),
        "t": float(log.t[starts[longest]]),
        "share": float(at.mean()),
    }
    action = "leave the cells between two measurements empty"
    yield Finding("will mislead", "interpolated", text, figures, action, at, channels=tuple(names))


def _straight(log: Log, name: str) -> np.ndarray:
    """Return [T] bool: samples within runs without curvature, in a channel that has some."""
    values = log[name]
    out = np.zeros(values.size, dtype=bool)
    slope = np.diff(values) / np.diff(log.t)
    bend = np.abs(np.diff(slope))
    known = bend[np.isfinite(bend)]
    if known.size < 100:
        return out
    usual = float(np.median(known))
    rounding = 1e-9 * float(np.nanmax(np.abs(values))) / float(np.median(np.diff(log.t)))
    resolution = _resolution(values) / float(np.median(np.diff(log.t)))
    if resolution > 0.0 and 8.0 * resolution >= usual:
        # between few steps of its resolution a channel runs straight by itself
        return out
    coarse = 2.1 * resolution
    # a smooth channel bends little anyhow: only noise bends at every sample
    noisy = noise_of(values) * np.sqrt(6.0) > 0.5 * float(np.nanmedian(np.abs(np.diff(values, 2))))
    if usual <= 10.0 * rounding or not noisy:
        return out
    flat = np.nan_to_num(bend, nan=np.inf) <= max(1e-5 * usual, rounding, coarse)
    if float(flat.mean()) > _USUAL:
        return out
    moving = np.abs(slope[:-1]) > max(10.0 * rounding, 0.0)
    starts, stops = stretches(flat & moving)
    for start, stop in zip(starts, stops, strict=True):
        long = log.t[stop] - log.t[start] >= _SECONDS
        if stop - start >= _SAMPLES and long:
            out[start : stop + 2] = True
    return out


def _resolution(values: np.ndarray) -> float:
    """Return the least step between the values of a channel, 0 where it has no grid."""
    change = np.abs(np.diff(values))
    change = change[np.isfinite(change) & (change > 0.0)]
    if change.size < 50:
        return 0.0
    least = float(np.quantile(change, 0.01))
    steps = change / least
    on_grid = float((np.abs(steps - np.round(steps)) < 0.02).mean()) > 0.95
    return least if on_grid else 0.0
