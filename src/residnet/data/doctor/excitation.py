"""How much of the vessel's envelope logs cover, and whether effects can be separated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.stretches import stretches
from residnet.data.channels import quantiles
from residnet.data.doctor.findings import Check, Finding, Level, check, share_of, show
from residnet.data.doctor.statistics import Record, averaged, bridged

_COLLINEAR = 30.0
"""Condition number of harmful collinearity: Belsley, Kuh and Welsch, 1980."""


@check("excitation", "range", "note")
def ranges(log: Record, found: Check) -> Iterator[Finding]:
    """Report range and spectrum of velocities and inputs."""
    for name in (*log.moving, *log.inputs):
        values, unit = log[name][np.isfinite(log[name])], log.units[name]
        low, top, std = float(values.min()), float(values.max()), float(values.std())
        figures = {"min": low, "max": top, "std": std}
        if std <= 1e-6 * max(abs(low), abs(top)):
            text = (
                f"{name} stays at {show(low, unit)}: its effect cannot be identified from this log"
                " alone"
            )
            yield found(text, figures, code="constant")
            continue
        text = f"{name} from {show(low, unit)} to {show(top, unit)}, standard deviation"
        text += f" {show(std, unit)}"
        if name in log.inputs and values.size >= 20:
            few = log.few
            power = np.abs(np.fft.rfft(bridged(few.t, few[name]) - values.mean())[1:]) ** 2
            total = np.cumsum(power)
            below = 1 + np.searchsorted(total, 0.95 * total[-1])
            figures["band"] = float(below / (len(few) * log.step))
            text += f", 95 % of its power below {figures['band']:.3g} Hz"
        yield found(text, figures)


def still(log: Record) -> np.ndarray:
    """Return [T] bool: no motion beyond the noise over two seconds."""
    samples = max(round(2.0 / log.step), 5)
    at_rest = np.ones(len(log), dtype=bool)
    speed = np.hypot(averaged(log["u"], samples), averaged(log["v"], samples))
    turning = np.abs(averaged(log["r"], samples))
    noise = np.hypot(log.noise("u"), log.noise("v")), log.noise("r")
    for values, level in zip((speed, turning), noise, strict=True):
        # what is left of the noise after averaging, but never a motion that is one for this vessel
        usual, left = quantiles(values, 0.95)[0], 4.0 * level / np.sqrt(samples)
        at_rest &= values < min(max(0.03 * usual, left), max(0.2 * usual, left))
    return at_rest


@check(
    "excitation",
    "standing",
    fix="leave these parts out: they hold noise only",
    needs=("u", "v", "r"),
)
def rest(log: Record, found: Check) -> Iterator[Finding]:
    """Report a vessel at rest; for a tenth of a log that makes it one about noise."""
    at_rest = still(log)
    starts, stops = stretches(at_rest)
    share = float(at_rest.mean())
    seconds = log.t[stops - 1] - log.t[starts]
    longest = int(np.argmax(stops - starts)) if starts.size else 0
    if share > 0.02 and seconds[longest] > 3.0:
        first, most = float(log.t[starts[longest]]), float(seconds[longest])
        text = (
            f"the vessel rests for {share_of(share)} of the time, at most {most:.1f} s on end from"
            f" t = {first:.2f} s"
        )
        level: Level = "will mislead" if share > 0.1 else "note"
        yield found(text, {"share": share, "longest": most, "t": first}, level=level, at=at_rest)


@check("excitation", "slow", "note", "there is little to learn there", needs=("u", "v"))
def slow(log: Record, found: Check) -> Iterator[Finding]:
    """Report a vessel that hardly moves."""
    speed = np.hypot(log["u"], log["v"])
    limit = 0.1 * quantiles(speed, 0.95)[0]
    share = float(np.mean(speed[np.isfinite(speed)] <= limit))
    if share > 0.05:
        text = (
            f"the vessel stands almost still (slower than {show(limit, 'm/s')}, a tenth of its"
            f" speed) for {share_of(share)} of the time"
        )
        yield found(text, {"share": share})


@check("excitation", "condition", "note", few=True)
def condition(log: Record, found: Check) -> Iterator[Finding]:
    """Report velocities and inputs that move together in a log."""
    names = [
        name
        for name in (*log.moving, *log.inputs)
        if log.std(name) > 1e-6 * np.nanmax(np.abs(log[name]))
    ]
    columns = log.log.stack(names)
    columns = columns[np.isfinite(columns).all(axis=1)]
    if len(names) < 2 or columns.shape[0] < 10 * len(names):
        return
    number, worst = conditioning(columns, names)
    text = f"condition number of {in_brackets(names)} (centred, scaled): {number:.3g}"
    if number > _COLLINEAR:
        text += (
            f"; {', '.join(worst)} move together in this log: their effects are separated by other"
            " manoeuvres only"
        )
    yield found(text, {"condition": number})


def in_brackets(names: Sequence[str]) -> str:
    """Return names in brackets, or how many they are where they are many."""
    return f"[{', '.join(names)}]" if len(names) <= 12 else f"{len(names)} channels"


def conditioning(columns: np.ndarray, names: Sequence[str]) -> tuple[float, list[str]]:
    """Return the condition number of columns [N, k], and the names that move together most.

    Columns are centred and scaled; there are up to three names.
    """
    spread = np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    _, sizes, directions = np.linalg.svd((columns - columns.mean(axis=0)) / spread, False)
    number = float(sizes[0] / max(sizes[-1], 1e-16 * sizes[0], np.finfo(float).tiny))
    most = np.argsort(-np.abs(directions[-1]))[:3]
    return number, [names[i] for i in most if abs(directions[-1][i]) > 0.2]
