"""Whether inputs stand on the clock of the motion: the shift in time with which a fit leaves least.

A vessel cannot answer before it is told. That it answers late may be its actuators; among logs of
one vessel, though, the delay is the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.actuators.propeller import propellers
from residnet.data.doctor.effects.one_step import blocks_of, integrals, regressors
from residnet.data.doctor.findings import Finding, shifted

_STEERING = ("delta", "tau_n", "acting_tau_n", "cmd_delta", "nozzle", "cmd_nozzle")
_SHIFTS = 12
# an answer so early, s or steps, is no inaccuracy
_EARLY = 0.45
_SURE = 3.0
_BETTER = 1.35
# delays are compared where they are known so well, s or steps
_KNOWN = 0.3
_SHARP = 1.1
_SECTIONS = 10
# minima that are looked at closely, and how many times the least counts as good a fit
_MINIMA = 4
_ALIKE = 1.15


@dataclass(frozen=True)
class Delay:
    """When the motion answers an input.

    Attributes:
        names: channels of the input.
        seconds: how late the answer comes; negative where it comes before the input.
        error: standard error of that, s.
        better: what a fit leaves without the shift, over what it leaves with it (sums of squares).
        late: what the best shift leaves that is no early answer, over the least that any leaves.
        sharp: `better` where the shift is wrong by the least lag that matters to either side.
    """

    names: tuple[str, ...]
    seconds: float
    error: float
    better: float
    late: float
    sharp: float


def steered(log: Log, inputs: Sequence[str]) -> dict[tuple[str, ...], str]:
    """Return the inputs that may be shifted together -> the velocity that answers them."""
    out: dict[tuple[str, ...], str] = {}
    rudder = next((name for name in _STEERING if name in inputs), "")
    if rudder and "r" in log.channels:
        out[(rudder,)] = "r"
    turning = [name for name in propellers(log, inputs) if not name.startswith("cmd_")]
    if len(turning) == 1 and "u" in log.channels:
        out[tuple(turning)] = "u"
    elif len(turning) > 1 and "r" in log.channels:
        out[tuple(turning)] = "r"
    return {
        names: answer
        for names, answer in out.items()
        if all(float(np.nanstd(log[n])) > 0.02 * np.nanmax(np.abs(log[n])) for n in names)
    }


def delay_of(log: Log, names: tuple[str, ...], answer: str) -> Delay | None:
    """Return how late a velocity answers inputs; None where the log does not tell."""
    step = float(np.median(np.diff(log.t)))
    first, size = blocks_of(log, (answer,))
    reach = max(2 * size, round(3.0 / step))
    if len(log) < 20 * size or len(log) < 6 * reach:
        return None
    first = first[(first >= reach) & (first + size + reach < len(log))]
    moving: dict[str, np.ndarray] = {
        name: log[name] for name in ("u", "v", "r") if name in log.channels
    }
    other = [
        name for name in log.channels if name in ("n", "delta", "wind_speed") and name not in names
    ]
    fixed = regressors(moving, {name: log[name] for name in other}, len(log))
    known = integrals(fixed, log.t, first, size)
    y = moving[answer][first + size] - moving[answer][first]
    driven = _drive(log, names)

    def left(shift: int) -> np.ndarray:
        x = np.concatenate((known, integrals(driven, log.t, first - shift, size)), axis=1)
        return _rest(x, y) ** 2

    sums = {shift: left(shift) for shift in _around(0, reach, _SHIFTS)}
    gap = max(round(reach / _SHIFTS), 1)
    rough = {shift: float(np.nansum(rest)) for shift, rest in sums.items()}
    for least in _lowest(rough)[:_MINIMA]:
        near = (shift for shift in _around(least, gap, 6) if abs(shift) <= reach)
        sums |= {shift: left(shift) for shift in near}
    total = {shift: float(np.nansum(rest)) for shift, rest in sums.items()}
    best = _likeliest(total, step)
    if abs(best) >= reach - gap:
        return None
    rest, plain = sums[best], sums[0]
    good = np.isfinite(rest) & np.isfinite(plain)
    if good.sum() < 5 * known.shape[1]:
        return None
    # how well the least is determined: its curvature against what is left in sections of the log
    sections = np.array_split(np.flatnonzero(good), _SECTIONS)
    spread = [
        min(sums, key=lambda shift: float(sums[shift][part].sum())) * step for part in sections
    ]
    error = 1.4826 * float(np.median(np.abs(np.array(spread) - np.median(spread))))
    error = max(error / np.sqrt(_SECTIONS) * 1.5, 0.25 * step)
    better = float(plain[good].sum() / max(rest[good].sum(), 1e-300))
    apart = max(round(_EARLY * 1.5 / step), 2)
    beside = [float(left(best + side)[good].sum()) for side in (-apart, apart)]
    sharp = min(beside) / max(float(rest[good].sum()), 1e-300)
    late = min(value for shift, value in total.items() if -shift * step <= _EARLY)
    late /= max(min(total.values()), 1e-300)
    return Delay(names, best * step, error, better, late, sharp)


def _around(centre: int, reach: int, count: int) -> list[int]:
    """Return shifts from `centre` to `reach` samples on both sides, `count` a side."""
    return sorted({centre + round(k * reach / count) for k in range(-count, count + 1)})


def _lowest(sums: Mapping[int, float]) -> list[int]:
    """Return the shifts of the minima of what fits leave, by shift, the lowest first."""
    shifts = sorted(sums)
    total = np.array([sums[shift] for shift in shifts])
    fenced = np.concatenate(([np.inf], total, [np.inf]))
    minima = np.flatnonzero((total <= fenced[:-2]) & (total <= fenced[2:]))
    return [shifts[i] for i in minima[np.argsort(total[minima])]]


def _likeliest(total: Mapping[int, float], step: float) -> int:
    """Return the shift that fits best; of several alike the least that is no early answer.

    An input that repeats itself, as that of a zigzag, fits as well half a period away.
    """
    least = min(total.values())
    alike = [shift for shift in _lowest(total) if total[shift] <= _ALIKE * least]
    return min(alike, key=lambda shift: (-shift * step > _EARLY, abs(shift)))


def timing_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the inputs that the motion answers before they are given."""
    step = float(np.median(np.diff(log.t)))
    for names, answer in steered(log, inputs).items():
        delay = delay_of(log, names, answer)
        if delay is None:
            continue
        early = -delay.seconds
        sure = delay.better > _BETTER and delay.late > _ALIKE
        if early > max(_EARLY, 1.5 * step, _SURE * delay.error) and sure:
            channels = ", ".join(names)
            text = (
                f"{answer} answers {channels} {early:.2f} +- {2.0 * delay.error:.2f} s before it is"
                f" given (a fit leaves {delay.better:.1f} times less with it shifted)"
            )
            yield Finding(
                "will mislead",
                "acausal",
                text,
                {"lag": delay.seconds, "error": delay.error, "better": delay.better},
                "the clocks of inputs and motion differ: shift one of them",
                repair=shifted(names, early),
            )


def delays_between(logs: Sequence[Log], inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the logs in which the motion answers at another delay than in the others."""
    found: dict[tuple[str, ...], list[tuple[Log, Delay]]] = {}
    for log in logs:
        for names, answer in steered(log, inputs).items():
            delay = delay_of(log, names, answer)
            step = float(np.median(np.diff(log.t)))
            if delay is not None and delay.error < max(_KNOWN, 0.5 * step) and delay.sharp > _SHARP:
                found.setdefault(names, []).append((log, delay))
    for names, members in found.items():
        if len(members) < 3:
            continue
        for log, delay in members:
            others = [other for one, other in members if one is not log]
            usual = float(np.median([other.seconds for other in others]))
            scatter = 1.4826 * float(np.median([abs(other.seconds - usual) for other in others]))
            step = float(np.median(np.diff(log.t)))
            apart = delay.seconds - usual
            error = float(np.hypot(delay.error, np.median([other.error for other in others])))
            if abs(apart) > max(_EARLY, 1.5 * step, 4.0 * scatter, _SURE * error):
                text = (
                    f"{log.name}: the motion answers {', '.join(names)} {apart:+.2f} s later than"
                    f" in {len(others)} other logs"
                )
                yield Finding(
                    "will mislead",
                    "timing",
                    text,
                    {"lag": apart, "error": error},
                    "the clocks of inputs and motion differ in this log: shift one of them",
                )


def _drive(log: Log, names: Sequence[str]) -> np.ndarray:
    columns = []
    for name in names:
        values = log[name]
        columns += [values, values * np.abs(values)]
    return np.stack(columns, axis=-1)


def _rest(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return what a least-squares fit of y [K] on x [K, k] leaves [K], NaN where it is unknown."""
    good = np.isfinite(x).all(axis=1) & np.isfinite(y)
    out = np.full(y.size, np.nan)
    part = x[good]
    scale = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
    part = part / scale
    gram = part.T @ part + 1e-9 * np.eye(part.shape[1])
    out[good] = y[good] - part @ np.linalg.solve(gram, part.T @ y[good])
    return out
