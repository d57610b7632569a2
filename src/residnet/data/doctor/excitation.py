"""How much of the vessel's envelope logs cover, and whether effects can be separated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.arrays.paged import LARGE
from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, share_of, show
from residnet.data.doctor.signals import MEASURED, averaged, noise_of

# a vessel at rest for this share of a log makes it one about noise
_MOST_REST = 0.1
_COLLINEAR = 30.0
_RECORD = "record manoeuvres: zigzag, 3-2-1-1"


def excitation_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the findings about ranges, spectrum, standstill and collinearity of one log."""
    moving = []
    for name in (*(name for name in VELOCITY if name in log.channels), *inputs):
        values, unit = log[name][np.isfinite(log[name])], log.units[name]
        low, high, std = float(values.min()), float(values.max()), float(values.std())
        figures = {"min": low, "max": high, "std": std}
        if std > 1e-6 * max(abs(low), abs(high)):
            moving.append(name)
            text = (
                f"{name} from {show(low, unit)} to {show(high, unit)}, standard deviation"
                f" {show(std, unit)}"
            )
            band = _band(log, name) if name in inputs else 0.0
            if band:
                text += f", 95 % of its power below {band:.3g} Hz"
                figures["band"] = band
            yield Finding("note", "range", text, figures)
        else:
            text = (
                f"{name} stays at {show(low, unit)}: its effect cannot be identified from this log"
                " alone"
            )
            yield Finding("note", "constant", text, figures)
    yield from _rest(log)
    if len(moving) > 1:
        yield from _collinearity(log, moving)


def still(log: Log) -> np.ndarray | None:
    """Return [T] bool: no motion beyond the noise over two seconds.

    None where u, v or r is not measured.
    """
    if any(name not in log.channels for name in VELOCITY):
        return None
    step = float(np.median(np.diff(log.t)))
    samples = max(round(2.0 / step), 5)
    at_rest = np.ones(len(log), dtype=bool)
    speed = np.hypot(averaged(log["u"], samples), averaged(log["v"], samples))
    for values, noise in (
        (speed, np.hypot(noise_of(log["u"]), noise_of(log["v"]))),
        (np.abs(averaged(log["r"], samples)), noise_of(log["r"])),
    ):
        usual = float(np.nanquantile(values, 0.95))
        # what is left of the noise after averaging, but never a motion that is one for this vessel
        at_rest &= values < min(
            max(0.03 * usual, 4.0 * noise / np.sqrt(samples)),
            max(0.2 * usual, 4.0 * noise / np.sqrt(samples)),
        )
    return at_rest


def _rest(log: Log) -> Iterator[Finding]:
    at_rest = still(log)
    if at_rest is not None:
        share = float(at_rest.mean())
        starts, stops = stretches(at_rest)
        longest = int(np.argmax(stops - starts)) if starts.size else 0
        seconds = float(log.t[stops[longest] - 1] - log.t[starts[longest]]) if starts.size else 0.0
        if share > 0.02 and seconds > 3.0:
            text = (
                f"the vessel rests for {share_of(share)} of the time, at most {seconds:.1f} s on"
                f" end from t = {log.t[starts[longest]]:.2f} s"
            )
            figures = {"share": share, "longest": seconds, "t": float(log.t[starts[longest]])}
            action = "leave these parts out: they hold noise only"
            yield Finding(
                "will mislead" if share > _MOST_REST else "note",
                "standing",
                text,
                figures,
                action,
                at_rest,
            )
    if "u" in log.channels and "v" in log.channels:
        speed = np.hypot(log["u"], log["v"])
        slow = 0.1 * float(np.nanpercentile(speed, 95))
        share = float(np.mean(speed[np.isfinite(speed)] <= slow))
        if share > 0.05:
            text = (
                f"the vessel stands almost still (slower than {show(slow, 'm/s')}, a tenth of its"
                f" speed) for {share_of(share)} of the time"
            )
            action = "there is little to learn there"
            yield Finding("note", "slow", text, {"share": share}, action)


def _band(log: Log, name: str) -> float:
    """Return the frequency in Hz below which 95 % of a channel's power lies.

    0 where it is too short.
    """
    values, step = log[name], float(np.median(np.diff(log.t)))
    known = np.isfinite(values)
    if known.sum() < 20:
        return 0.0
    power = (
        np.abs(
            np.fft.rfft(np.interp(log.t, log.t[known], values[known]) - values[known].mean())[1:]
        )
        ** 2
    )
    total = np.cumsum(power)
    return (
        float((1 + np.searchsorted(total, 0.95 * total[-1])) / (len(log) * step))
        if total[-1] > 0.0
        else 0.0
    )


def _collinearity(log: Log, names: Sequence[str]) -> Iterator[Finding]:
    columns = log.stack(tuple(names))
    columns = columns[np.isfinite(columns).all(axis=1)]
    if columns.shape[0] < 10 * len(names):
        return
    condition, worst = conditioning(columns, names)
    text = f"condition number of {_list(names)} (centred, scaled): {condition:.3g}"
    if condition > _COLLINEAR:
        text += (
            f"; {', '.join(worst)} move together in this log: their effects are separated by other"
            " manoeuvres only"
        )
    yield Finding("note", "condition", text, {"condition": condition})


def _list(names: Sequence[str]) -> str:
    return f"[{', '.join(names)}]" if len(names) <= 12 else f"{len(names)} channels"


def conditioning(columns: np.ndarray, names: Sequence[str]) -> tuple[float, list[str]]:
    """Return the condition number of columns [N, k], and the names that move together most.

    Columns are centred and scaled; there are up to three names.
    """
    scaled = (columns - columns.mean(axis=0)) / np.maximum(
        columns.std(axis=0), np.finfo(float).tiny
    )
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], 1e-16 * singular[0], np.finfo(float).tiny))
    return condition, [
        names[i] for i in np.argsort(-np.abs(directions[-1]))[:3] if abs(directions[-1][i]) > 0.2
    ]


def set_findings(logs: Sequence[Log], inputs: Sequence[str] | None) -> Iterator[Finding]:
    """Return whether a fit to all logs together has something to learn from."""
    driving = _common(logs, inputs)
    awake = {
        name: max(_awake(log, name) for log in logs)
        for name in VELOCITY
        if all(name in log.channels for log in logs)
    }
    if awake and max(awake.values()) < 1.0:
        text = (
            f"no velocity varies beyond its noise in any of {len(logs)} logs: a fit would find"
            " nothing but noise"
        )
        yield Finding(
            "fatal",
            "no_excitation",
            text,
            {f"{name}_over_noise": value for name, value in awake.items()},
            "record manoeuvres: zigzag, 3-2-1-1",
        )
    if not driving:
        return
    spread = {name: max(_relative(log[name]) for log in logs) for name in driving}
    if max(spread.values()) < 1e-3:
        text = f"no input ({', '.join(driving)}) varies within any of {len(logs)} logs"
        # constant in each, but not the same in all
        if max(_between(logs, name) for name in driving) <= 1e-2:
            yield Finding(
                "will mislead",
                "no_excitation",
                f"{text}: what they do cannot be identified",
                {"spread": max(spread.values())},
                _RECORD,
            )
    held = [name for name in driving if _between(logs, name) < 1e-3 and spread[name] < 1e-3]
    if held:
        yield Finding(
            "note",
            "constant_inputs",
            f"{', '.join(held)} never varies: its effect cannot be separated from a constant",
            {"count": len(held)},
        )
    moving = [name for name in (*awake, *driving) if name not in held]
    if len(moving) > 1:
        # of very many samples evenly spread ones tell the same
        every = -(-sum(len(log) for log in logs) // LARGE)
        columns = np.concatenate([log.stack(tuple(moving))[::every] for log in logs])
        columns = columns[np.isfinite(columns).all(axis=1)]
        if columns.shape[0] >= 10 * len(moving):
            condition, worst = conditioning(columns, moving)
            text = f"{len(logs)} logs together: condition number of {_list(moving)} {condition:.3g}"
            if condition > _COLLINEAR:
                text += (
                    f"; {', '.join(worst)} move together: give one of them, or add manoeuvres that"
                    " move them apart"
                )
            yield Finding("note", "condition", text, {"condition": condition})


def _common(logs: Sequence[Log], inputs: Sequence[str] | None) -> list[str]:
    names = (
        inputs
        if inputs is not None
        else [name for name in logs[0].channels if name not in MEASURED]
    )
    return [
        name
        for name in names
        if all(name in log.channels for log in logs) and not name.startswith(("wind", "current"))
    ]


def _awake(log: Log, name: str) -> float:
    """Return the spread of a velocity over the least that counts; below 1 it does not vary.

    Only what its averaged noise does not explain counts.
    """
    step = float(np.median(np.diff(log.t)))
    samples = max(round(2.0 / step), 5)
    smooth = averaged(log[name], samples)
    known = smooth[np.isfinite(smooth)]
    if known.size < 10:
        return 0.0
    scale = (
        float(np.abs(np.nanmean(np.hypot(log["u"], log["v"]))))
        if "u" in log.channels and "v" in log.channels
        else 0.0
    )
    least = max(
        3.0 * noise_of(log[name]) / np.sqrt(samples),
        0.02 * scale if name != "r" else np.radians(0.05),
        1e-9,
    )
    return float(known.std() / least)


def _relative(values: np.ndarray) -> float:
    """Return the spread of a channel over its size, beyond its noise."""
    known = values[np.isfinite(values)]
    size = float(np.abs(known).max(initial=0.0))
    return max(float(known.std()) - 1.5 * noise_of(known), 0.0) / size if size > 0.0 else 0.0


def _between(logs: Sequence[Log], name: str) -> float:
    """Return the spread of a channel over all logs, over its size."""
    return _relative(np.concatenate([log[name] for log in logs]))
