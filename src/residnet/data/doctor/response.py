"""Whether the vessel answers its steering: to the right side, and not before it is given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding
from residnet.data.doctor.signals import noise_of

# steering channels of which a positive value turns to starboard
_STEERING = ("delta", "tau_n", "acting_tau_n", "cmd_delta")
_PAIRS = (("n_port", "n_stbd"), ("cmd_port", "cmd_stbd"))
_FEWEST = 100
_SURE = 6.0
# so many times less must be left with the inputs shifted in time
_BETTER = 1.3
# so many times more must be left without the steering
_WORTH = 1.2


def response_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the sign and timing of the yaw rate's answer to what steers."""
    found = (
        _steering(log, inputs)
        if "r" in log.channels and np.isfinite(log["r"]).sum() >= _FEWEST
        else None
    )
    if found is not None and _opposite(log, found[1]):
        text = f"{found[0]} stays on one side and the vessel turns to the other"
        yield Finding(
            "will mislead",
            "rudder_sign",
            text,
            {},
            "turn it in the channel map (sign: -1), and check the sign of r and psi",
        )
        return
    answer = None if found is None else _answer(log, found[1])
    if found is None or answer is None:
        return
    name = found[0]
    figures = {
        "effect": answer.effect,
        "t": answer.sure,
        "lag": answer.lag,
        "better": answer.better,
    }
    sure = answer.surest
    if (
        sure < -_SURE
        and answer.worth > _WORTH
        and (answer.better < _BETTER or answer.best_sure < 0.0)
    ):
        text = (
            f"positive {name} turns the vessel to port (yaw acceleration {answer.effect:.3g} per"
            f" unit, {-sure:.0f} standard errors)"
        )
        action = "turn it in the channel map (sign: -1), and check the sign of r and psi"
        yield Finding("will mislead", "rudder_sign", text, figures, action)
    elif sure > _SURE:
        text = f"positive {name} turns the vessel to starboard ({sure:.0f} standard errors)"
        yield Finding("note", "rudder_sign", text, figures)


@dataclass(frozen=True)
class _Answer:
    """How the yaw rate answers.

    Attributes:
        effect: yaw acceleration per unit of steering.
        sure: that in standard errors.
        lag: shift of the steering with which a yaw model leaves least, s; positive where the answer
            comes late.
        better: what the model leaves without the shift, over what it leaves with it (sums of
            squares).
        best_sure: effect in standard errors with the shift.
        worth: what a yaw model without steering leaves, over what it leaves with it.
    """

    effect: float
    sure: float
    lag: float
    better: float
    best_sure: float
    worth: float

    @property
    def surest(self) -> float:
        """The effect in standard errors; with the shift where it is surer and of the same sign."""
        same = self.sure * self.best_sure > 0.0 and abs(self.sure) > 0.5 * _SURE
        return self.best_sure if same and abs(self.best_sure) > abs(self.sure) else self.sure


def _opposite(log: Log, steer: np.ndarray) -> bool:
    """Return whether steering and yaw rate both stay on one side, and not on the same."""
    good = np.isfinite(log["r"]) & np.isfinite(steer)
    r, steering = _smoothed(log["r"])[good], steer[good]
    if r.size < _FEWEST or float(np.abs(r).mean()) < 6.0 * noise_of(log["r"]):
        return False
    one_sided = all(
        abs(float(values.sum())) > 0.95 * float(np.abs(values).sum()) for values in (r, steering)
    )
    return one_sided and float(r.sum()) * float(steering.sum()) < 0.0


def _steering(log: Log, inputs: Sequence[str]) -> tuple[str, np.ndarray] | None:
    """Return the channel that steers and its values [T]; None where no sense is known."""
    known = (*inputs, *(name for name in log.channels if name not in inputs))
    for name in _STEERING:
        if name in known and float(np.nanstd(log[name])) > 1e-9:
            return name, log[name]
    for port, starboard in _PAIRS:
        if port in known and starboard in known:
            steer = log[port] * np.abs(log[port]) - log[starboard] * np.abs(log[starboard])
            if float(np.nanstd(steer)) > 1e-9:
                return f"{port} over {starboard}", steer
    return None


def _answer(log: Log, steer: np.ndarray) -> _Answer | None:
    """Return the effect and timing of steering [T] on the yaw rate; None where nothing can be said.

    Over blocks of a second or so: the change of r on the integrals of 1, r, r|r|, v, v|v| and the
    steering, with the steering shifted in time.
    """
    step, noise = float(np.median(np.diff(log.t))), noise_of(log["r"])
    good = np.isfinite(log["r"]) & np.isfinite(steer)
    if (
        good.sum() < _FEWEST
        or float(np.nanquantile(log["r"], 0.95) - np.nanquantile(log["r"], 0.05)) < 4.0 * noise
    ):
        return None
    smooth, window = _smoothed(log["r"]), 15
    v = (
        _smoothed(log["v"])
        if "v" in log.channels and np.isfinite(log["v"]).sum() > 100
        else np.zeros(len(log))
    )
    dt = np.diff(log.t)

    def area(values: np.ndarray) -> np.ndarray:
        return np.append(0.0, np.nancumsum(0.5 * dt * (values[1:] + values[:-1])))

    reach = _reach(smooth, step)
    every, block = max(round(0.2 / step), 1), max(round(1.0 / step), window)
    first = np.arange(reach + window, len(log) - reach - window - block, every)
    whole = np.append(0.0, np.cumsum(~good | (np.append(dt, step) > 3.0 * step)))
    first = first[whole[np.clip(first + block + 1, 0, len(log))] == whole[first]]
    if first.size < 50:
        return None

    def change(values: np.ndarray, shift: int = 0) -> np.ndarray:
        difference: np.ndarray = values[first + block - shift] - values[first - shift]
        return difference

    columns = [
        log.t - log.t[0],
        area(smooth),
        area(smooth * np.abs(smooth)),
        area(v),
        area(v * np.abs(v)),
    ]
    known, y = np.stack([change(column) for column in columns], axis=-1), change(smooth)
    steering = area(steer)
    shifts = np.unique(np.round(np.linspace(-reach, reach, 61)).astype(int))
    fits = {
        int(shift): _fit(np.column_stack((known, change(steering, int(shift)))), y)
        for shift in shifts
    }
    zero, best = fits[0], min(fits, key=lambda shift: fits[shift][0])
    return _Answer(
        zero[1],
        zero[2],
        best * step,
        zero[0] / max(fits[best][0], 1e-300),
        fits[best][2],
        _fit(known, y)[0] / max(zero[0], 1e-300),
    )


def _reach(r: np.ndarray, step: float) -> int:
    """Return the number of samples after which the yaw rate is no longer correlated with itself.

    A shift can be recognised as far as that.
    """
    known: np.ndarray = np.nan_to_num(r - np.nanmean(r))
    power = np.abs(np.fft.rfft(known, 2 * known.size)) ** 2
    memory = np.fft.irfft(power)[: known.size]
    below = np.flatnonzero(memory < 0.0)
    first: int = int(below[0]) if below.size else known.size
    return max(min(first, known.size // 8, round(30.0 / step)), 3)


def _fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Return the sum of squared residuals, the last coefficient, and its t-value.

    The standard error is that over twenty sections.
    """
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    x = x / size
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-10)
    values = inverse @ (x.T @ y)
    rest = y - x @ values
    section = np.arange(y.size) * 20 // y.size
    scores = np.add.reduceat(x * rest[:, None], np.searchsorted(section, np.arange(20)), axis=0)
    error = float(np.sqrt(max((inverse @ (scores.T @ scores) @ inverse)[-1, -1], 1e-300)))
    return float(rest @ rest), float(values[-1] / size[-1]), float(values[-1]) / error


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Return the values [T] smoothed by a parabola over 15 samples, NaN bridged."""
    at, known = np.arange(values.size), np.isfinite(values)
    return np.asarray(scipy.signal.savgol_filter(np.interp(at, at[known], values[known]), 15, 2))
