"""Whether revolutions drive the vessel the right way, and are revolutions per second."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.effects.one_step import blocks_of, integrals
from residnet.data.doctor.findings import Finding, scaled
from residnet.data.doctor.following import slip_in_words

_STEERING = ("delta", "cmd_delta")
# rad of turning per revolution, at full rudder; vessels lie between .003 and .03
_FEWEST_TURNS = 8e-4
_MOST_TURNS = 0.3
# no propeller of a vessel turns faster, 1/s
_FASTEST = 250.0
_AGAINST = 0.9
_SURE = 6.0
# ratio of speed to revolutions by which a log may differ from others of its vessel
_SAME_ADVANCE = 8.0


def propellers(log: Log, inputs: Sequence[str]) -> list[str]:
    """Return the inputs that are revolutions."""
    found = [
        name
        for name in inputs
        if log.units[name] == "1/s" and float(np.nanmax(np.abs(log[name]))) > 0.0
    ]
    # what a shaft does tells more than what it was told to do
    return [name for name in found if not name.startswith("cmd_")] or found


def propeller_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return revolutions of the wrong sign, or that cannot be revolutions per second."""
    names = propellers(log, inputs)
    if not names:
        return
    for name in names:
        yield from _unit(log, name)
    if "u" in log.channels:
        yield from _signs(log, names)


def _unit(log: Log, name: str) -> Iterator[Finding]:
    fastest = float(np.nanquantile(np.abs(log[name]), 0.95))
    factor = 0.0
    if fastest > _FASTEST:
        text, factor = f"{name} reaches {fastest:.4g} 1/s, more than any propeller", 60.0
    elif "r" in log.channels:
        rudder = [
            float(np.nanquantile(np.abs(log[other]), 0.95))
            for other in _STEERING
            if other in log.channels
        ]
        share = min(max(rudder, default=0.35) / 0.35, 1.0)
        turning = float(np.nanquantile(np.abs(log["r"]), 0.95)) / max(share, 0.1)
        ratio = turning / max(fastest, 1e-12)
        if fastest > 20.0 and ratio < _FEWEST_TURNS:
            factor = 60.0
        elif fastest < 1.0 and ratio > _MOST_TURNS:
            factor = 1.0 / 60.0
        text = f"{name} reaches {fastest:.3g} 1/s, out of proportion to how the vessel turns"
    if factor:
        action = "correct its unit in the channel map"
        text += ": rpm taken as 1/s?" if factor > 1.0 else ": 1/s taken as rpm?"
        figures = {"largest": fastest}
        yield Finding("will mislead", "unit", text, figures, action, repair=scaled((name,), factor))


def _signs(log: Log, names: Sequence[str]) -> Iterator[Finding]:
    moving = np.abs(log["u"]) > 0.3 * float(np.nanquantile(np.abs(log["u"]), 0.9))
    action = "turn it in the channel map (sign: -1)"
    against = [
        name
        for name in names
        if float(np.mean((log[name] * log["u"])[moving & (log[name] != 0.0)] < 0.0)) > _AGAINST
        and float(np.mean((log[name] != 0.0)[moving])) > _AGAINST
    ]
    for name in against:
        text = f"{name} turns against the way that the vessel goes"
        yield Finding(
            "will mislead", "propeller_sign", text, {}, action, repair=scaled((name,), -1.0)
        )
    if against:
        return
    for name, sure in _thrusts(log, names).items():
        if sure < -_SURE:
            text = f"more {name} makes the vessel slower ({-sure:.0f} standard errors)"
            yield Finding(
                "will mislead",
                "propeller_sign",
                text,
                {"t": sure},
                action,
                repair=scaled((name,), -1.0),
            )


def _thrusts(log: Log, names: Sequence[str]) -> dict[str, float]:
    """Return propeller -> effect of its thrust on the surge, in standard errors."""
    first, size = blocks_of(log, ("u",))
    other = [log[name] for name in ("v", "r") if name in log.channels]
    drift = other[0] * other[1] if len(other) == 2 else np.zeros(len(log))
    u = log["u"]
    table = [np.ones(len(log)), u, u * np.abs(u), drift]
    table += [log[name] * np.abs(log[name]) for name in names]
    x = integrals(np.stack(table, axis=-1), log.t, first, size)
    y = u[first + size] - u[first]
    good = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[good], y[good]
    if y.size < 40:
        return {}
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    x = x / scale
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-8)
    values = inverse @ (x.T @ y)
    rest = y - x @ values
    section = np.arange(y.size) * 20 // y.size
    scores = np.add.reduceat(x * rest[:, None], np.searchsorted(section, np.arange(20)), axis=0)
    errors = np.sqrt(np.maximum(np.diag(inverse @ (scores.T @ scores) @ inverse), 1e-300))
    varied = [float(np.nanstd(log[name])) > 0.05 * np.nanmax(np.abs(log[name])) for name in names]
    effect = (values / errors)[-len(names) :]
    return {
        name: float(value)
        for name, value, moves in zip(names, effect, varied, strict=True)
        if moves
    }


def units_between(logs: Sequence[Log], names: Sequence[str]) -> Iterator[Finding]:
    """Return the logs whose revolutions are out of proportion to those of the others."""
    for name in names:
        advance = []
        for log in logs:
            fast = float(np.nanquantile(np.abs(log[name]), 0.9))
            advance.append(float(np.nanquantile(np.abs(log["u"]), 0.9)) / max(fast, 1e-9))
        usual = float(np.median(advance))
        for log, value in zip(logs, advance, strict=True):
            ratio = usual / max(value, 1e-12)
            if not 1.0 / _SAME_ADVANCE < ratio < _SAME_ADVANCE and len(logs) > 2:
                text = (
                    f"{log.name}: {name} is {ratio:.3g} times as large for its speed as in the"
                    f" other logs{slip_in_words(ratio)}"
                )
                yield Finding(
                    "will mislead",
                    "unit_between",
                    text,
                    {"ratio": ratio},
                    "correct its unit in the channel map",
                )
