"""Whether revolutions drive the vessel the right way, and are revolutions per second."""

from __future__ import annotations

import itertools
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
_FULL_RUDDER = 0.35
"""Angle of full rudder in rad."""
_LEAST_STEERING = 0.2
"""Share of full rudder from which on the turning of a vessel tells how fast its propellers are."""
_AGAINST = 0.9
_ONE_WAY = 0.8
"""Mean of the yaw rate over that of its size from which on a vessel turns to one side."""
_SURE = 6.0
_VARIED = 0.2
"""Standard deviation of the thrust over its largest value from which on its effect can be told."""
_CLEARLY = 0.6
"""Share of what the logged signs leave that other signs may leave at most to count as better."""
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
        yield from _unit(log, name, names)
    if "u" in log.channels:
        yield from _signs(log, names)


def _unit(log: Log, name: str, names: Sequence[str]) -> Iterator[Finding]:
    fastest = float(np.nanquantile(np.abs(log[name]), 0.95))
    # one of several may hardly turn while the others drive the vessel
    driving = max(float(np.nanquantile(np.abs(log[other]), 0.95)) for other in names)
    factor = 0.0
    if fastest > _FASTEST:
        text, factor = f"{name} reaches {fastest:.4g} 1/s, more than any propeller", 60.0
    elif "r" in log.channels and (share := _steered(log, names)) > _LEAST_STEERING:
        turning = float(np.nanquantile(np.abs(log["r"]), 0.95)) / min(share, 1.0)
        ratio = turning / max(driving, 1e-12)
        if fastest > 20.0 and ratio < _FEWEST_TURNS:
            factor = 60.0
        elif driving < 1.0 and ratio > _MOST_TURNS:
            factor = 1.0 / 60.0
        text = f"{name} reaches {fastest:.3g} 1/s, out of proportion to how the vessel turns"
    if factor:
        action = "correct its unit in the channel map"
        text += ": rpm taken as 1/s?" if factor > 1.0 else ": 1/s taken as rpm?"
        figures = {"largest": fastest}
        yield Finding("will mislead", "unit", text, figures, action, repair=scaled((name,), factor))


def _steered(log: Log, names: Sequence[str]) -> float:
    """Return how far the vessel was steered, as a share of full rudder; 0 where nothing tells.

    Without a rudder it is steered by propellers that differ. A vessel that was not steered does
    not turn, however fast its propellers are.
    """
    rudder = [
        float(np.nanquantile(np.abs(log[other]), 0.95)) / _FULL_RUDDER
        for other in _STEERING
        if other in log.channels
    ]
    if rudder:
        return max(rudder)
    turns = np.stack([log[name] for name in names])
    apart = float(np.nanquantile(np.ptp(turns, axis=0), 0.95))
    return apart / max(float(np.nanquantile(np.abs(turns).max(axis=0), 0.95)), 1e-12)


def _signs(log: Log, names: Sequence[str]) -> Iterator[Finding]:
    moving = np.abs(log["u"]) > 0.3 * float(np.nanquantile(np.abs(log["u"]), 0.9))
    if not moving.any():
        return
    action = "turn it in the channel map (sign: -1)"
    against = [
        name
        for name in names
        if float(np.mean((log[name] != 0.0)[moving])) > 0.5
        and float(np.mean((log[name] * log["u"])[moving & (log[name] != 0.0)] < 0.0)) > _AGAINST
    ]
    if len(against) < len(names) and _turns_one_way(log, moving):
        # a propeller that runs astern beside one that runs ahead is how such a vessel turns
        against = []
    for name in against:
        text = f"{name} turns against the way that the vessel goes"
        yield Finding(
            "will mislead", "propeller_sign", text, {}, action, repair=scaled((name,), -1.0)
        )
    if against:
        return
    for name, sure in _reversed(log, names).items():
        text = f"more {name} makes the vessel slower ({sure:.0f} standard errors)"
        yield Finding(
            "will mislead",
            "propeller_sign",
            text,
            {"t": sure},
            action,
            repair=scaled((name,), -1.0),
        )


def _turns_one_way(log: Log, moving: np.ndarray) -> bool:
    """Return whether the vessel turned to one side all the while, or nothing tells."""
    if "r" not in log.channels:
        return True
    rate = log["r"][moving & np.isfinite(log["r"])]
    return rate.size == 0 or abs(float(rate.mean())) > _ONE_WAY * float(np.abs(rate).mean())


def _reversed(log: Log, names: Sequence[str]) -> dict[str, float]:
    """Return reversed propellers, and by how many standard errors their thrust is the wrong way.

    All choices of signs are compared by how well the sum of thrusts explains the surge: effects of
    single propellers cannot be told apart where one runs ahead while the other runs astern.
    """
    first, size = blocks_of(log, ("u",))
    other = [log[name] for name in ("v", "r") if name in log.channels]
    drift = [other[0] * other[1], other[1] ** 2] if len(other) == 2 else []
    u = log["u"]
    thrusts = [log[name] * np.abs(log[name]) for name in names]
    table = [np.ones(len(log)), u, u * np.abs(u), *drift, *thrusts]
    x = integrals(np.stack(table, axis=-1), log.t, first, size)
    y = u[first + size] - u[first]
    good = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[good], y[good]
    if y.size < 40:
        return {}
    known, each = x[:, : -len(names)], x[:, -len(names) :]
    as_logged = np.ones(len(names))
    left, sure = _thrust(known, each @ as_logged, y)
    signs = as_logged
    for trial in itertools.product((1.0, -1.0), repeat=len(names) - 1):
        turned = np.array((1.0, *trial))
        trial_left, trial_sure = _thrust(known, each @ turned, y)
        if trial_left < min(_CLEARLY * left if signs is as_logged else left, left):
            left, sure, signs = trial_left, trial_sure, turned
    effective = signs * np.sign(sure)
    total = np.tensordot(signs, np.stack(thrusts), axes=1)
    varied = float(np.nanstd(total)) / max(float(np.nanmax(np.abs(total))), 1e-12)
    if abs(sure) < _SURE or varied < _VARIED:
        return {}
    return {name: abs(sure) for name, sign in zip(names, effective, strict=True) if sign < 0.0}


def _thrust(known: np.ndarray, thrust: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return what a thrust leaves of the surge (sum of squares), and its effect over its error.

    Args:
        known: other terms, integrated over blocks [N, J].
        thrust: integrated over blocks [N].
        y: changes of the surge velocity over blocks [N].
    """
    x = np.concatenate((known, thrust[:, None]), axis=1)
    x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-8)
    values = inverse @ (x.T @ y)
    rest = y - x @ values
    # errors hang together within a section
    section = np.arange(y.size) * 20 // y.size
    scores = np.add.reduceat(x * rest[:, None], np.searchsorted(section, np.arange(20)), axis=0)
    errors = np.sqrt(np.maximum(np.diag(inverse @ (scores.T @ scores) @ inverse), 1e-300))
    return float(rest @ rest), float(values[-1] / errors[-1])


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
