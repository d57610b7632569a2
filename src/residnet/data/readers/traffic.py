"""What the rows of topics tell: rates, gaps, publishers, and lags and levers against the log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.log import Log
from residnet.data.readers.recording import Remark, Series, key_of, remark

# a gap is this many times the usual step, and this many seconds
_GAP_STEPS, _GAP_SECONDS = 5.0, 0.5
# rows below which nothing is said about publishers, lags and levers
_ENOUGH = 100
# lags that are looked for, s, and the least that is reported
_LAGS, _TELLING = np.arange(-2.0, 2.025, 0.05), 0.1
# correlation that calls two signals the same quantity
_SAME = 0.9
_MOST_ROWS = 4000
_LEVER = 0.2


def traffic(series: Series) -> list[Remark]:
    """Return the remarks on a series whose rows are in order."""
    if not len(series):
        return [remark("note", "empty_topic", f"topic {series.name}: holds no rows")]
    out = []
    empty = [path for path, values in series.fields.items() if np.isnan(values).all()]
    if empty:
        shown = ", ".join(empty[:6]) + (", ..." if len(empty) > 6 else "")
        text = f"topic {series.name}: {len(empty)} fields hold no number ({shown})"
        out.append(remark("note", "empty_columns", text, fields=len(empty)))
    if len(series) < 3:
        return out
    step = np.diff(series.clock)
    usual, longest = float(np.median(step)), float(step.max())
    rate = (len(series) - 1) / float(series.clock[-1] - series.clock[0])
    text = (
        f"topic {series.name}: {len(series)} rows, {rate:.3g} Hz, step {usual:.3g} s (median),"
        f" spread {float(np.std(step)):.2g} s, longest {longest:.3g} s"
    )
    figures = {"rows": len(series), "rate": rate, "step": usual, "longest": longest}
    out.append(remark("note", "topic_rate", text, **figures))
    gaps = int((step > max(_GAP_STEPS * usual, _GAP_SECONDS)).sum())
    if gaps:
        at = float(series.clock[int(np.argmax(step))])
        text = (
            f"topic {series.name}: {gaps} gaps, the longest {longest:.3g} s at {at:.1f} s; nothing"
            " is interpolated across"
        )
        out.append(remark("note", "topic_gaps", text, gaps=gaps, longest=longest, at=at))
    return out + _publishers(series, step)


def _publishers(series: Series, step: np.ndarray) -> list[Remark]:
    """Return a remark where several publishers share the topic.

    They are recognised by the sender that the source names, else by values that leap away and come
    straight back (A, B, A) while rows follow each other at irregular short steps, as two trains of
    messages on one track do, or by such leaps alone where nearly every row is one and they are
    wide.
    """
    if series.sender is not None:
        names = [str(name) for name in dict.fromkeys(series.sender.tolist())]
        turns = int((series.sender[1:] != series.sender[:-1]).sum())
        if len(names) > 1 and turns >= len(names):
            text = (
                f"topic {series.name}: rows of {len(names)} senders alternate"
                f" ({', '.join(names[:6])}); name one with `sender`"
            )
            figures = {"senders": len(names), "turns": turns}
            return [remark("will mislead", "several_publishers", text, **figures)]
    short = float((step < 0.2 * step.mean()).mean())
    for path, values in series.fields.items():
        known = values[np.isfinite(values)]
        if known.size < _ENOUGH:
            continue
        leaps, returns, width = _returns(known)
        bursts = short > 0.15 and returns > 0.05 and returns > 0.3 * leaps
        mixed = short > 0.05 and returns > 0.2 and returns > 0.35 * leaps and width > 0.05
        in_turns = returns > 0.3 and returns > 0.8 * leaps and width > 0.05
        if bursts or mixed or in_turns:
            text = (
                f"topic {series.name}: several publishers seem to write to it: field {path} leaps"
                f" away and straight back in {returns:.0%} of the rows, {short:.0%} of the steps"
                " are shorter than a fifth of the mean; do not use it unless the source tells its"
                " senders apart"
            )
            told = {"returns": returns, "short_steps": short}
            return [remark("will mislead", "several_publishers", text, **told)]
    return []


def _returns(known: np.ndarray) -> tuple[float, float, float]:
    """Return the share of rows that change twice, that come back, and the leaps' width.

    A row comes back to the value before; the width is a share of the values' range.
    """
    low, high = np.quantile(known, (0.01, 0.99))
    change = np.abs(np.diff(known))
    first, second, over = change[:-1], change[1:], np.abs(known[2:] - known[:-2])
    leap = (first > 0.0) & (second > 0.0)
    back = leap & (over <= 0.1 * np.minimum(first, second))
    width = float(np.median(first[back])) / float(high - low) if back.any() and high > low else 0.0
    return float(leap.mean()), float(back.mean()), width


def agreement(idle: Sequence[Series], log: Log, start: float) -> list[Remark]:
    """Return the remarks on velocities and positions in topics that the log was not made of.

    `start` is the log's first sample on the recording's clock, s.
    """
    rates: dict[str, np.ndarray] = {n: log[n] for n in ("u", "v", "r") if n in log.channels}
    if {"u", "v", "psi"} <= set(log.channels):
        c, s = np.cos(log["psi"]), np.sin(log["psi"])
        rates["north velocity"] = c * log["u"] - s * log["v"]
        rates["east velocity"] = s * log["u"] + c * log["v"]
    rates = {name: values for name, values in rates.items() if np.isfinite(values).sum() > _ENOUGH}
    out: list[Remark] = []
    for series in idle:
        if len(series) >= _ENOUGH:
            t = series.clock - start + log.t[0]
            for path in series.fields:
                if key_of(path).endswith(("linear_x", "linear_y", "angular_z")):
                    out += _lag(series, path, t, log.t, rates)
            out += _lever(series, t, log)
    return out


def _at(t: np.ndarray, clock: np.ndarray, values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    out: np.ndarray = np.interp(t, clock[known], values[known], left=np.nan, right=np.nan)
    return out


def _lag(
    series: Series, path: str, t: np.ndarray, clock: np.ndarray, rates: dict[str, np.ndarray]
) -> list[Remark]:
    every = max(1, len(series) // _MOST_ROWS)
    at, values = t[::every], series[path][::every]
    sizes = {
        (name, float(lag)): abs(_correlation(values, _at(at - lag, clock, rate)))
        for name, rate in rates.items()
        for lag in _LAGS
    }
    (name, lag), size = max(sizes.items(), key=lambda entry: entry[1], default=(("", 0.0), 0.0))
    # a lag is reported only where it explains a good part of what the two differ by
    if size < _SAME or abs(lag) < _TELLING:
        return []
    without = abs(_correlation(values, _at(at, clock, rates[name])))
    if 1.0 - size > 0.7 * (1.0 - without):
        return []
    verb = f"{'lags' if lag > 0.0 else 'leads'} {name} of the log by {abs(lag):.2f} s"
    text = (
        f"topic {series.name}: {path} {verb} (correlation {size:.3f}, {without:.3f} without the"
        " lag); give the topic's `delays` before it is used"
    )
    figures = {"lag": lag, "correlation": size, "correlation_without": without}
    return [remark("note", "topic_lag", text, **figures)]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < _ENOUGH or np.ptp(a[known]) == 0.0 or np.ptp(b[known]) == 0.0:
        return 0.0
    return float(np.corrcoef(a[known], b[known])[0, 1])


def _lever(series: Series, t: np.ndarray, log: Log) -> list[Remark]:
    """Return whether a topic's positions turn about the log's.

    Both then belong to different points of the vessel.
    """
    pairs = [f"{start}position" for start in ("pose.", "pose.pose.", "")]
    pair = next((p for p in pairs if series.has(f"{p}.x") and series.has(f"{p}.y")), None)
    if pair is None or not {"x", "y", "psi"} <= set(log.channels):
        return []
    known = np.isfinite(log["psi"]) & np.isfinite(log["x"]) & np.isfinite(log["y"])
    if known.sum() < _ENOUGH:
        return []
    x, y, psi = (_at(t, log.t[known], log[name][known]) for name in ("x", "y", "psi"))
    first, second = series[f"{pair}.x"], series[f"{pair}.y"]
    good = np.isfinite(first) & np.isfinite(second) & np.isfinite(x)
    if good.sum() < _ENOUGH or np.ptp(psi[good]) < np.pi / 3:
        return []
    c, s, one = np.cos(psi[good]), np.sin(psi[good]), np.ones(int(good.sum()))
    columns = np.block(
        [[np.stack((c, -s, one, 0.0 * one), 1)], [np.stack((s, c, 0.0 * one, one), 1)]]
    )
    best = (np.inf, np.zeros(4), 0.0)
    for north, east in ((first, second), (second, first)):
        apart = (x - north)[good], (y - east)[good]
        offset = np.concatenate(apart)
        lever, *_ = np.linalg.lstsq(columns, offset, rcond=None)
        residual = float(np.sqrt(np.mean((columns @ lever - offset) ** 2)))
        best = min(best, (residual, lever, float(sum(map(np.std, apart)))), key=lambda fit: fit[0])
    residual, lever, spread = best
    length = float(np.hypot(lever[0], lever[1]))
    if length < _LEVER or residual > 0.5 * spread or residual > length:
        return []
    text = (
        f"topic {series.name}: its positions and the log's belong to points {length:.2f} m apart:"
        f" the log's lies at ({lever[0]:.2f}, {lever[1]:.2f}) m (forward, starboard) of it, rest"
        f" {residual:.3f} m; give `position.antenna` where the log's is an antenna"
    )
    figures = {"forward": float(lever[0]), "starboard": float(lever[1]), "residual": residual}
    return [remark("will mislead", "lever_arm", text, **figures)]
