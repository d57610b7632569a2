"""What the motion says against propellers, rudders and the clock of the inputs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.core.names import sides
from residnet.core.stretches import stretches
from residnet.data.channels import SIGMA_OF_MAD, deviation, quantiles
from residnet.data.doctor.findings import Check, Finding, check, correction
from residnet.data.doctor.statistics import (
    SECTIONS,
    STEERING,
    WINDOW,
    Fit,
    Record,
    blocks_of,
    fit,
    high,
    of_inputs,
    of_motion,
)
from residnet.data.statistics import AT_ONCE, FEWEST, Blocks

_SURE = 6.0
"""Standard errors that call a sign wrong: many, since to turn a right one would ruin a fit."""
_TURN = "turn it in the channel map (sign: -1)"
_TURN_AND_CHECK = f"{_TURN}, and check the sign of r and psi"


def propellers(log: Record) -> list[str]:
    """Return the inputs that are revolutions."""
    found = [name for name in log.inputs if log.units[name] == "1/s" and high(log[name], 1.0) > 0.0]
    # what a shaft does tells more than what it was told to do
    return [name for name in found if not name.startswith("cmd_")] or found


# rad of turning per revolution, at full rudder; vessels lie between .003 and .03
_FEWEST_TURNS, _MOST_TURNS = 8e-4, 0.3
# no propeller of a vessel turns faster, 1/s
_FASTEST = 250.0
_FULL_RUDDER = 0.35
"""Angle of full rudder in rad."""
_LEAST_STEERING = 0.2
"""Share of full rudder from which on the turning of a vessel tells how fast its propellers are."""


@check("actuators", "unit", fix="correct its unit in the channel map", certain=True, few=True)
def propeller_unit(log: Record, found: Check) -> Iterator[Finding]:
    """Report revolutions that cannot be revolutions per second."""
    names = log.of(propellers)
    # one of several may hardly turn while the others drive the vessel
    driving = max((high(log[name]) for name in names), default=0.0)
    for name in names:
        fastest, factor = high(log[name]), 0.0
        text = f"{name} reaches {fastest:.3g} 1/s, out of proportion to how the vessel turns"
        share = _steered(log, names) if "r" in log else 0.0
        if fastest > _FASTEST:
            text, factor = f"{name} reaches {fastest:.4g} 1/s, more than any propeller", 60.0
        elif share > _LEAST_STEERING:
            ratio = high(log["r"]) / min(share, 1.0) / max(driving, 1e-12)
            if fastest > 20.0 and ratio < _FEWEST_TURNS:
                factor = 60.0
            elif driving < 1.0 and ratio > _MOST_TURNS:
                factor = 1.0 / 60.0
        if factor:
            text += ": rpm taken as 1/s?" if factor > 1.0 else ": 1/s taken as rpm?"
            yield found(text, {"largest": fastest}, repair=correction((name,), factor=factor))


def _steered(log: Record, names: Sequence[str]) -> float:
    """Return how far the vessel was steered, as a share of full rudder; 0 where nothing tells.

    Without a rudder it is steered by propellers that differ. A vessel that was not steered does
    not turn, however fast its propellers are.
    """
    rudder = [high(log[name]) / _FULL_RUDDER for name in ("delta", "cmd_delta") if name in log]
    if rudder:
        return max(rudder)
    turns = np.stack([log[name] for name in names])
    return high(np.ptp(turns, axis=0)) / max(high(np.abs(turns).max(axis=0)), 1e-12)


@check("actuators", "propeller_sign", fix=_TURN, needs=("u",), certain=True, few=True)
def propeller_sign(log: Record, found: Check) -> Iterator[Finding]:
    """Report propellers that turn against the way that the vessel goes, or slow it down."""
    names = log.of(propellers)
    moving = np.abs(log["u"]) > 0.3 * high(log["u"], 0.9)
    if not names or not moving.any():
        return
    against = [
        name
        for name in names
        if float(np.mean((log[name] != 0.0)[moving])) > 0.5
        and float(np.mean((log[name] * log["u"])[moving & (log[name] != 0.0)] < 0.0)) > 0.9
    ]
    rate = log["r"][moving & np.isfinite(log["r"])] if "r" in log else np.zeros(0)
    one_way = not rate.size or abs(float(rate.mean())) > 0.8 * float(np.abs(rate).mean())
    if len(against) < len(names) and one_way:
        # a propeller that runs astern beside one that runs ahead is how such a vessel turns
        against = []
    for name in against:
        text = f"{name} turns against the way that the vessel goes"
        yield found(text, repair=correction((name,), factor=-1.0))
    for name, sure in () if against else _reversed(log, names).items():
        text = f"more {name} makes the vessel slower ({sure:.0f} standard errors)"
        yield found(text, {"t": sure}, repair=correction((name,), factor=-1.0))


def _reversed(log: Record, names: Sequence[str]) -> dict[str, float]:
    """Return reversed propellers, and by how many standard errors their thrust is the wrong way.

    All choices of signs are compared by how well the sum of thrusts explains the surge: effects of
    single propellers cannot be told apart where one runs ahead while the other runs astern.
    """
    blocks, u = log.of(blocks_of, "u"), log["u"]
    drift = [log["v"] * log["r"], log["r"] ** 2] if "v" in log and "r" in log else []
    thrusts = np.stack([log[name] * np.abs(log[name]) for name in names], axis=-1)
    table = np.column_stack((np.ones(len(log)), u, u * np.abs(u), *drift, thrusts))
    x, y = blocks.integrals(table)(0), blocks.change(u)
    if (np.isfinite(x).all(axis=1) & np.isfinite(y)).sum() < 40:
        return {}
    known, each = x[:, : -len(names)], x[:, -len(names) :]

    trials = [
        np.array((1.0, *rest)) for rest in itertools.product((1.0, -1.0), repeat=len(names) - 1)
    ]
    fits = [fit(np.column_stack((known, each @ signs)), y) for signs in trials]
    best = min(range(len(fits)), key=lambda i: fits[i].left)
    # other signs must leave clearly less than those that were logged
    best = best if fits[best].left < 0.6 * fits[0].left else 0
    signs, sure = trials[best], fits[best].sure
    total = thrusts @ signs
    # of a thrust that hardly varies the effect cannot be told
    varied = deviation(total) / max(high(total, 1.0), 1e-12)
    if abs(sure) < _SURE or varied < 0.2:
        return {}
    return {
        n: abs(sure) for n, sign in zip(names, signs * np.sign(sure), strict=True) if sign < 0.0
    }


@dataclass(frozen=True)
class Neutral:
    """The rudder angle at which the vessel goes straight, rad, and its standard error."""

    angle: float
    error: float
    effect: float
    effect_error: float


def neutral_angle(log: Record) -> Neutral | None:
    """Return the neutral angle of delta, from the yaw moment that is there without any rudder."""
    found = _yaw_fit(log)
    if found is None or not abs(found.values[1]) > 4.0 * found.errors[1]:
        return None
    moment, effect = (float(value) for value in found.values[:2])
    gradient = np.array([-1.0 / effect, moment / effect**2])
    error = float(np.sqrt(max(gradient @ found.spread[:2, :2] @ gradient, 0.0)))
    return Neutral(-moment / effect, error, effect, float(found.errors[1]))


def _yaw_table(log: Record, *further: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a yaw model linear in the rudder angle, x [K, k] and y [K].

    The first two columns are the moment without rudder and the effect of the rudder, those of
    `further` ones [T], which act as the rudder does, come next.
    """
    blocks, u, r = log.of(blocks_of, "r"), log["u"], log["r"]
    v = log["v"] if "v" in log else np.zeros(len(log))
    speed = u * np.abs(u)
    if "n" in log:
        race = log["n"] * np.abs(log["n"])
        speed, race = (flow / max(float(np.nanmean(np.abs(flow))), 1e-9) for flow in (speed, race))
        speed = speed + race
    columns = [speed, speed * log["delta"], *(speed * one for one in further)]
    columns += [np.abs(u) * r, r * np.abs(r), np.abs(u) * v, v * np.abs(v)]
    if "wind_speed" in log and "wind_dir" in log:
        side = log["wind_dir"] - (log["psi"] if "psi" in log else np.zeros(len(log)))
        columns += [log["wind_speed"] ** 2 * np.sin(k * side) for k in (1.0, 2.0)]
    return blocks.integrals(np.stack(columns, axis=-1))(0), blocks.change(r)


def _yaw_fit(log: Record, *further: np.ndarray) -> Fit | None:
    """Return the fit of the yaw model; None where the log does not tell."""
    if any(name not in log for name in ("delta", "u", "r")):
        return None
    found = fit(*_yaw_table(log, *further))
    varies = log.std("delta") >= math.radians(1.0)
    return found if found.rest.size >= 60 and varies else None


@check("actuators", "rudder_bias", needs=("delta",), certain=True, few=True)
def rudder_bias(log: Record, found: Check) -> Iterator[Finding]:
    """Report a rudder whose zero is not where the vessel goes straight, or that is reversed."""
    neutral = log.of(neutral_angle) if "delta" in log.inputs else None
    if neutral is None:
        return
    if neutral.effect < -_SURE * neutral.effect_error:
        text = "positive delta turns the vessel to port"
        yield found(text, {"effect": neutral.effect}, code="rudder_sign", fix=_TURN_AND_CHECK)
    # hulls and single propellers have a neutral angle of a degree or so; beyond 2.6 even a wind is
    # no excuse
    elif abs(neutral.angle) > max(math.radians(2.6), _SURE * neutral.error):
        text = (
            f"the vessel goes straight at delta = {math.degrees(neutral.angle):+.1f} +-"
            f" {math.degrees(2.0 * neutral.error):.1f} deg"
        )
        yield found(
            text,
            {"angle": neutral.angle, "error": neutral.error},
            fix="take the offset off, or give a steady wind or current as an input",
            repair=correction(("delta",), offset=-neutral.angle),
        )


_WIDER = "log with a wider range, or leave these parts out"


# share of the time at one end, and how much harder the vessel then turns
_AT_END, _HARDER, _SURE_AT_END = 0.03, 1.3, 4.5


@check(
    "actuators",
    "rudder_clipped",
    fix=_WIDER,
    needs=("delta", "u", "r"),
    certain=True,
    few=True,
)
def rudder_clipped(log: Record, found: Check) -> Iterator[Finding]:
    """Report a rudder at whose recorded limit the vessel turns harder than the angle explains."""
    size = high(log["delta"], 1.0)
    at_end = np.abs(log["delta"]) > 0.999 * size
    share, visits = float(at_end.mean()), stretches(at_end)[0].size
    # a turning circle goes there once, and all of it lies there
    if "delta" not in log.inputs or not _AT_END < share < 1.0 - _AT_END or visits < 3:
        return
    # the ramps of a zigzag tell the effect of smaller angles
    fitted, beyond = _yaw_fit(log, np.sign(log["delta"]) * at_end), 0.0
    if fitted is not None:
        sure = float(abs(fitted.values[2]) / fitted.errors[2])
        more = float(fitted.values[2] / (fitted.values[1] * size))
        beyond = sure if more > _HARDER - 1.0 and sure > _SURE_AT_END else 0.0
    beyond = max(beyond, _unexplained(log, at_end) if visits >= 8 else 0.0)
    if beyond > 0.0:
        text = (
            f"at {math.degrees(size):.1f} deg of delta the vessel turns harder than smaller angles"
            f" explain ({beyond:.1f} times what they leave open): its record is cut off there"
        )
        yield found(text, {"limit": size, "harder": beyond})


def _unexplained(log: Record, at_end: np.ndarray) -> float:
    """Return how much harder the vessel turns at the limit, over what a fit elsewhere leaves.

    The fit is one to all that lies off the limit, so it must hold rests at smaller angles; 0 where
    it does not, or explains what happens at the limit.
    """
    blocks, values, (x, y) = log.of(blocks_of, "r"), log["delta"], _yaw_table(log)
    known = np.isfinite(x).all(axis=1) & np.isfinite(y)
    inside, outside = known & blocks.clear_of(~at_end), known & blocks.clear_of(at_end)
    first, half = values[blocks.first], replace(blocks, size=blocks.size // 2)
    moved, most = np.abs(blocks.change(values)) + np.abs(half.change(values)), high(values, 1.0)
    resting = outside & (moved < 0.05 * most) & (np.abs(first) > 0.15 * most)
    if inside.sum() < 10 or resting.sum() < 20:
        return 0.0
    fitted = fit(x[outside], y[outside])
    usual = max(float(np.sqrt(np.mean(fitted.rest**2))), 1e-300)
    left = (y - x @ fitted.values)[inside] * np.sign(first[inside] * fitted.values[1])
    harder = float(np.mean(left)) / usual
    return harder if harder > _SURE_AT_END else 0.0


# so many times less must be left with the inputs shifted in time, and more without the steering
_BETTER, _WORTH = 1.3, 1.2


@check("inputs", "rudder_sign", needs=("r",), certain=True, few=True)
def rudder_sign(log: Record, found: Check) -> Iterator[Finding]:
    """Report the side to which what steers turns the vessel."""
    name, steer = _steering(log)
    if not name or np.isfinite(log["r"]).sum() < 2 * FEWEST:
        return
    good = np.isfinite(log["r"]) & np.isfinite(steer)
    r, given = log.smooth("r")[good], steer[good]
    if good.sum() >= 2 * FEWEST and float(np.abs(r).mean()) >= 6.0 * log.noise("r"):
        one_sided = all(abs(x.sum()) > 0.95 * np.abs(x).sum() for x in (r, given))
        # of a turning circle the loss of speed slows the turn, which no rudder does
        if one_sided and float(r.sum()) * float(given.sum()) < 0.0:
            text = f"{name} stays on one side and the vessel turns to the other"
            yield found(text, fix=_TURN_AND_CHECK)
        elif one_sided:
            text = f"{name} stays on one side and the vessel turns to it"
            yield found(text, level="note", fix="")
        if one_sided:
            return
    # a rudder turns by the square of the speed past it
    flow = np.ones(len(log))
    if "delta" in name and "u" in log:
        flow, good = np.abs(log.smooth("u")), good & np.isfinite(log["u"])
    without, fits = _answers(log, steer, flow, good)
    if not fits:
        return
    zero, best = fits[0], min(fits, key=lambda shift: fits[shift].left)
    plain, moved = zero.sure, fits[best].sure
    # with the shift where that is surer and of the same sign
    same = plain * moved > 0.0 and abs(plain) > 0.5 * _SURE
    sure = moved if same and abs(moved) > abs(plain) else plain
    better = zero.left / max(fits[best].left, 1e-300)
    told = without / max(zero.left, 1e-300) > _WORTH and (better < _BETTER or moved < 0.0)
    effect = float(zero.values[-1] * np.nanmean(flow**2))
    figures = {"effect": effect, "t": plain, "lag": best * log.step, "better": better}
    if sure < -_SURE and told:
        text = (
            f"positive {name} turns the vessel to port (yaw acceleration {effect:.3g} per unit,"
            f" {-sure:.0f} standard errors)"
        )
        both = "exchange the columns of both sides, or check the sign of r and psi"
        yield found(text, figures, fix=_TURN_AND_CHECK if name in log else both)
    elif sure > _SURE:
        text = f"positive {name} turns the vessel to starboard ({sure:.0f} standard errors)"
        yield found(text, figures, level="note", fix="")


def _steering(log: Record) -> tuple[str, np.ndarray]:
    """Return what steers and its values [T], positive to starboard; no name where none is known."""
    for name in STEERING[:4]:
        if name in log and log.std(name) > 1e-9:
            return name, log[name]
    for port, starboard in sides(log).items():
        if log.units[port] != "rad":
            steer = log[port] * np.abs(log[port]) - log[starboard] * np.abs(log[starboard])
            if deviation(steer) > 1e-9:
                return f"{port} less {starboard}", steer
    return "", np.zeros(0)


_HELD = 0.02
"""Share of its size within which a rudder is held; of 24 helices of a torpedo all lie within 1.6 %,
of its zigzags and random steps all beyond 46 %."""
_MOST_ROWS = 10_000
"""Blocks that a rudder's side is told by: more only overlap."""


def _answers(
    log: Record, steer: np.ndarray, flow: np.ndarray, good: np.ndarray
) -> tuple[float, dict[int, Fit]]:
    """Return what a yaw model leaves without steering, and fits with it by shift in samples: that
    without a shift, and the one that leaves least.

    Over blocks of a second or so: the change of r on the integrals of U^2, U r, r|r|, U v, v|v| and
    U^2 times the steering, with the latter shifted in time; nothing where that says nothing.

    Args:
        log: with r.
        steer: what steers [T].
        flow: the speed U that it acts by [T]; 1 where it acts without any.
        good: samples that are known [T].
    """
    r, size = log.smooth("r"), max(round(1.0 / log.step), WINDOW)
    low, top = quantiles(log["r"], 0.05, 0.95)
    v = np.zeros(len(log))
    if "v" in log and np.isfinite(log["v"]).sum() > 2 * FEWEST:
        v = log.smooth("v")
    # a shift can be recognised as far as the yaw rate is correlated with itself
    power = np.abs(np.fft.rfft(r - r.mean(), 2 * r.size)) ** 2
    memory = np.append(np.fft.irfft(power)[: r.size], -1.0)
    reach = max(min(int(np.argmax(memory < 0.0)), r.size // 8, round(30.0 / log.step)), 3)
    gaps = ~good | (np.append(np.diff(log.t), log.step) > 3.0 * log.step) | log.torn(reach + size)
    margin = reach + WINDOW
    stride = max(round(0.2 / log.step), len(log) // _MOST_ROWS, 1)
    first = np.arange(margin, len(log) - margin - size, stride)
    blocks = Blocks(log.t, first, size)
    blocks = replace(blocks, first=first[blocks.clear_of(gaps)])
    if blocks.first.size < FEWEST or top - low < 4.0 * log.noise("r"):
        return 0.0, {}
    terms = np.stack((flow**2, flow * r, r * np.abs(r), flow * v, v * np.abs(v)), axis=-1)
    known, y = blocks.integrals(terms)(0), blocks.change(r)
    given = blocks.integrals((flow**2 * np.nan_to_num(steer))[:, None])
    shifts = sorted({round(float(shift)) for shift in np.linspace(-reach, reach, 61)})
    told = np.isfinite(known).all(axis=1) & np.isfinite(y)
    # of a rudder that is held through a steady turn only its shifted entry would seem to answer
    mean = given(0)[told, 0] / np.maximum(known[told, 0], 1e-300)
    if told.sum() < FEWEST or mean.std() < _HELD * np.abs(mean).mean():
        return 0.0, {}
    length = np.maximum(np.linalg.norm(known[told], axis=0), 1e-300)
    side, sizes, _ = np.linalg.svd(known[told] / length, full_matrices=False)
    side = side[:, sizes > 1e-5 * sizes[0]]
    # what steers explains by the part of it that the other terms do not
    tried = given(shifts)[told][..., 0]
    rest, own = (part - side @ (side.T @ part) for part in (y[told], tried))
    gain = (rest @ own) ** 2 / np.maximum((own**2).sum(axis=0), 1e-300)
    surest = shifts[int(np.argmax(gain))]
    fits = {s: fit(np.column_stack((known, given(s))), y) for s in sorted({0, surest})}
    return fit(known, y).left, fits


# an answer so early, s, is no inaccuracy
EARLY = 0.45
# minima that are looked at closely, and how many times the least counts as good a fit
_MINIMA, _ALIKE = 4, 1.15
_SHIFTS = 12
"""To either side, coarse ones first; chosen by hand: each costs a fit."""


@dataclass(frozen=True)
class Delay:
    """When the motion answers an input.

    Attributes:
        seconds: how late the answer comes; negative where it comes before the input.
        error: standard error of that, s.
        better: what a fit leaves without the shift, over what it leaves with it (sums of squares).
        late: what the best shift leaves that is no early answer, over the least that any leaves.
    """

    seconds: float
    error: float
    better: float
    late: float


def delays(log: Record) -> dict[tuple[str, str], tuple[tuple[str, ...], Delay]]:
    """Return (channels, the velocity that answers) -> the channels one by one, and the delay.

    Channels that may be shifted together are the first that steers, and all propellers.
    """
    pairs: list[tuple[tuple[str, ...], str]] = []
    rudder = next((name for name in STEERING if name in log.inputs), "")
    turning = tuple(name for name in log.of(propellers) if not name.startswith("cmd_"))
    pairs += [((rudder,), "r")] if rudder else []
    pairs += [(turning, "u" if len(turning) == 1 else "r")] if turning else []
    found = {}
    for names, answer in pairs:
        varied = all(log.std(n) > 0.02 * np.nanmax(np.abs(log[n])) for n in names)
        delay = delay_of(log, names, answer) if answer in log and varied else None
        if delay is not None:
            found[", ".join(names), answer] = names, delay
    return found


def delay_of(log: Record, names: Sequence[str], answer: str) -> Delay | None:
    """Return how late a velocity answers inputs; None where the log does not tell."""
    step, blocks = log.step, log.of(blocks_of, answer)
    reach = max(2 * blocks.size, round(3.0 / step))
    if len(log) < max(20 * blocks.size, 6 * reach):
        return None
    first = blocks.first
    inside = (first >= reach) & (first + blocks.size + reach < len(log))
    blocks = replace(blocks, first=first[inside & blocks.clear_of(log.torn(reach))])
    other = [name for name in log if name in ("n", "delta", "wind_speed") and name not in names]
    y = blocks.change(log[answer])
    # shift -> the squares [K] that a fit leaves with the inputs shifted, NaN where unknown, and sum
    sums, total = dict[int, np.ndarray](), dict[int, float]()
    # the flow over a rudder falls as the vessel turns: without their product in the fit the answer
    # seems to come early
    moving = {name: log[name][:, None] for name in log.moving}
    driving = [name for name in (*other, *names) if log.std(name) > 0.0]
    linear = len(driving) > 4

    def given(part: Sequence[str], shifts: Sequence[int] | np.ndarray) -> list[np.ndarray]:
        """Return terms [T, S] of inputs that are shifted by so many samples each."""
        at = np.arange(len(log))[:, None] - np.array(shifts)
        inputs = [np.take(log[name], at, mode="wrap") for name in driving if name in part]
        return of_inputs(inputs, moving.get("u"), linear=linear)

    def integrals(columns: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([blocks.integrals(one)(0) for one in columns], axis=-1)

    fixed = integrals([np.ones((len(log), 1)), *of_motion(moving), *given(other, [0])])

    def look(shifts: Iterable[int]) -> None:
        new = [k for k in dict.fromkeys(shifts) if k not in sums and abs(k) <= reach]
        pieces = np.array_split(new, -(-len(new) * len(log) // AT_ONCE)) if new else ()
        for some in pieces:
            own = integrals(given(names, some))
            x = np.concatenate((fixed.repeat(some.size, axis=1), own), axis=2).transpose(1, 0, 2)
            good = np.isfinite(x).all(axis=2) & np.isfinite(y)
            part, target = np.where(good[..., None], x, 0.0), np.where(good, y, 0.0)[..., None]
            part /= np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1e-300)
            turned = part.transpose(0, 2, 1)
            gram = turned @ part + 1e-9 * np.eye(part.shape[2])
            rest = (target - part @ np.linalg.solve(gram, turned @ target))[..., 0]
            sums.update(zip(some.tolist(), np.where(good, rest**2, np.nan), strict=True))
            total.update(zip(some.tolist(), (rest**2).sum(axis=1).tolist(), strict=True))

    def lowest() -> list[int]:
        """Return the shifts of the minima so far, the lowest first."""
        shifts = sorted(total)
        left = np.array([total[shift] for shift in shifts])
        fenced = np.concatenate(([np.inf], left, [np.inf]))
        minima = np.flatnonzero((left <= fenced[:-2]) & (left <= fenced[2:]))
        return [shifts[i] for i in minima[np.argsort(left[minima])]]

    look(round(k * reach / _SHIFTS) for k in range(-_SHIFTS, _SHIFTS + 1))
    gap = max(round(reach / _SHIFTS), 1)
    look(least + round(k * gap / 6) for least in lowest()[:_MINIMA] for k in range(-6, 7))
    # of several that fit alike the least that is no early answer: an input that repeats itself, as
    # that of a zigzag, fits as well half a period away
    floor = max(min(total.values()), 1e-300)
    alike = [shift for shift in lowest() if total[shift] <= _ALIKE * floor]
    best = min(alike, key=lambda shift: (-shift * step > EARLY, abs(shift)))
    good = np.isfinite(sums[best]) & np.isfinite(sums[0])
    if abs(best) >= reach - gap or good.sum() < 5 * (fixed.shape[2] + len(given(names, [0]))):
        return None
    # how well the least is determined: its scatter over sections of the log
    tried, table = np.array([*sums]) * step, np.array([*sums.values()])
    sections = np.array_split(np.flatnonzero(good), SECTIONS // 2)
    each = [tried[np.argmin(np.nan_to_num(table[:, p].sum(axis=1), nan=np.inf))] for p in sections]
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(np.array(each) - np.median(each))))
    error = max(1.5 * scatter / np.sqrt(len(sections)), 0.25 * step)
    rest = max(float(sums[best][good].sum()), 1e-300)
    late = min(value for shift, value in total.items() if -shift * step <= EARLY) / floor
    return Delay(best * step, error, float(sums[0][good].sum()) / rest, late)


@check(
    "actuators",
    "acausal",
    fix="the clocks of inputs and motion differ: shift one of them",
    certain=True,
    few=True,
)
def acausal(log: Record, found: Check) -> Iterator[Finding]:
    """Report inputs that the motion answers before they are given.

    A vessel cannot answer before it is told. That it answers late may be its actuators; among logs
    of one vessel, though, the delay is the same (`between`).
    """
    for (channels, answer), (names, delay) in log.of(delays).items():
        early = -delay.seconds
        sure = delay.better > 1.35 and delay.late > _ALIKE
        if sure and early > max(EARLY, 1.5 * log.step, 3.0 * delay.error):
            text = (
                f"{answer} answers {channels} {early:.2f} +- {2.0 * delay.error:.2f} s before it is"
                f" given (a fit leaves {delay.better:.1f} times less with it shifted)"
            )
            figures = {"lag": delay.seconds, "error": delay.error, "better": delay.better}
            yield found(text, figures, repair=correction(names, lag=early))
