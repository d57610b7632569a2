"""Whether a model behaves like a vessel: damping, stability, symmetry, and motion within bounds.

What a model does where its logs have been, at recorded states and inputs, can make it unsound, so
that a sound one that is as good is selected. What it does elsewhere is reported, and speaks against
no choice.

A full hull may be unstable on a course in truth, so that instability is a fault only where the
vessel, its inputs held, settled from a disturbance such as the entry of a turn, and stayed so for
several times as long as the model's disturbances take to grow. A straight run that nothing disturbs
proves nothing. Disturbances have the size that they had in the log: a model of logs whose wind
nobody measured may swing a little in a steady turn, as the vessel did.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.columns import velocities_on
from residnet.core.errors import DataError
from residnet.core.files import read_json
from residnet.core.format import interval, number, shown_unit
from residnet.core.layout import LATERAL, POSE, SURGE, SWAY
from residnet.core.names import WIND_INPUTS
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec
from residnet.physics.symmetry import (
    axis_parities,
    channel_parity,
    heeling,
    pair_parity,
    partners_of,
)

SCHEMA = "residnet.sanity/1"
DAMPING, STABILITY, SYMMETRY, BOUNDED = CHECKS = ("damping", "stability", "symmetry", "bounded")

_POINTS = 90
"""Recorded states that are looked at, besides those of extreme inputs; chosen by hand."""
_NEGLIGIBLE = 0.05
"""Share of a slope's size elsewhere below which a positive one is no wrong sign."""
_DOUBLING = 300.0
"""Time in s within which a growing disturbance counts."""
_ASYMMETRY = 0.1
"""Uneven part of the acceleration, share of its spread, beyond which sides differ; by choice."""
_LONG_RUN = 300.0
"""Time in s that inputs are held at least: within it a disturbance doubles that counts."""
_PAUSE, _SETTLED = 10.0, 1e-4
_FRACTIONS, _CRUISE = (0.0, 0.25, 0.5, 0.67, 1.0, 1.5), 0.67
"""Speeds of straight running, in the largest of the training data."""
_CORNERS = 64
"""Corners of the inputs' ranges: all of up to six inputs."""
_HELD, _SHORTEST = 0.02, 5.0
"""Share of an input's range within which it is held, and for how long in s at least."""
_GROWN, _STAYED, _DECAYED = 20.0, 3.0, 3.0
_MOST, _SETTLING = 20, 0.25
"""Steady runs that are looked at, and the share of each that settles; chosen by hand."""
_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))


@dataclass(frozen=True)
class Finding:
    """A finding of one check of one model.

    `ok` is None where the check does not apply or could not be made. `fault` says in a few words
    what makes the model unsound, so that one that is as good comes first; it is empty where the
    finding is only reported.
    """

    model: str
    check: str
    ok: bool | None
    text: str
    fault: str = ""


@dataclass(frozen=True)
class SteadyRun:
    """A stretch of a log with held inputs.

    Attributes:
        log: name of the log.
        seconds: that it lasts, its settling left out.
        x: mean state [3 + n] with the pose at zero.
        w: mean inputs [m].
        decay: how many times farther the lateral velocities lie from their last mean when the
            stretch begins than in the end.
        growth: how many times farther the lateral velocities lie from their first third's mean in
            the last third than in the first.
        scatter: standard deviations of the lateral velocities [2].
    """

    log: str
    seconds: float
    x: np.ndarray
    w: np.ndarray
    decay: float
    growth: float
    scatter: np.ndarray


@dataclass(frozen=True)
class Recorded:
    """What training logs hold for the checks.

    Attributes:
        x: recorded states [K, 3 + n] with the pose at zero.
        w: inputs [K, m].
        longest: how long the longest log lasts in s.
        steady: stretches with held inputs.
    """

    x: Tensor
    w: Tensor
    longest: float
    steady: Sequence[SteadyRun]

    @classmethod
    def of(cls, logs: Sequence[Prepared], step: float) -> Recorded:
        """Return points spread evenly over the speeds, those of extreme inputs, and steady runs."""
        # all states of large data would fill the memory: only those of the points are put together
        used = [np.flatnonzero(log.usable) for log in logs]
        pairs = list(zip(logs, used, strict=True))
        speed = np.concatenate(
            [np.hypot(*log.smooth[at, SURGE : SURGE + 2].T) for log, at in pairs]
        )
        order = np.argsort(speed, kind="stable")
        even = order[np.linspace(0, len(order) - 1, min(_POINTS, len(order))).round().astype(int)]
        extreme = []
        for column in range(logs[0].w.shape[1]):
            w = np.concatenate([log.w[at, column] for log, at in pairs])
            extreme += [w.argmin(), w.argmax()]
        rows = np.union1d(even, np.array(extreme, dtype=even.dtype))
        ends = np.cumsum([len(at) for at in used])
        picked = [
            (log, at[rows[(rows >= end - len(at)) & (rows < end)] - (end - len(at))])
            for (log, at), end in zip(pairs, ends, strict=True)
        ]
        x = np.concatenate([log.smooth[at] for log, at in picked])
        w = np.concatenate([log.w[at] for log, at in picked])
        x[:, POSE] = 0.0
        longest = max(float(log.log.t[-1] - log.log.t[0]) for log in logs)
        return cls(torch.from_numpy(x), torch.from_numpy(w), longest, steady_runs(logs, step))


def steady_runs(logs: Sequence[Prepared], step: float) -> list[SteadyRun]:
    """Return the stretches of logs whose inputs hold within 2 % of their ranges.

    The first quarter of each is left out, in which the motion settles, and so are stretches of
    fewer than five seconds.
    """
    used = [log.w[log.usable] for log in logs if log.usable.any()]
    ranges = np.max([w.max(0) for w in used], 0) - np.min([w.min(0) for w in used], 0)
    tolerance = _HELD * np.maximum(ranges, 1e-12)
    out = []
    for log in logs:
        for begin, end in _held(log, tolerance, round(_SHORTEST / step)):
            rows = slice(begin + int(_SETTLING * (end - begin)), end)
            y, lateral = log.smooth[rows], log.smooth[rows, LATERAL]
            x = y.mean(0)
            x[POSE] = 0.0
            third = max(len(lateral) // 3, 1)
            first, last = lateral[:third].mean(0), lateral[-third:].mean(0)
            entry = log.smooth[begin : begin + max(third // 10, 1), LATERAL]
            began, left, early, late = (
                np.abs(part - centre).mean(0)
                for part, centre in (
                    (entry, last),
                    (lateral[-third:], last),
                    (lateral[:third], first),
                    (lateral[-third:], first),
                )
            )
            decay = float((began / np.maximum(left, 1e-9)).max())
            growth = float((late / np.maximum(early, 1e-9)).max())
            w, scatter = log.w[rows].mean(0), lateral.std(0)
            out.append(SteadyRun(log.log.name, len(y) * step, x, w, decay, growth, scatter))
    return out


def _held(log: Prepared, tolerance: np.ndarray, shortest: int) -> Iterator[tuple[int, int]]:
    """First sample and end of each stretch whose inputs stay within a tolerance [m] of its first.

    Stretches follow each other and do not overlap.
    """
    for begin, end in zip(*stretches(log.piece), strict=True):
        start = int(begin)
        while end - start >= shortest:
            away = (np.abs(log.w[start:end] - log.w[start]) > tolerance).any(1)
            stop = start + (int(away.argmax()) if away.any() else end - start)
            if stop - start >= shortest:
                yield start, stop
            start = max(stop, start + 1)


def check_model(
    spec: ModelSpec, model: HybridDynamics, recorded: Recorded, divergence: float = 3.0
) -> list[Finding]:
    """Return all checks of one model, in the order of `CHECKS`.

    Args:
        spec: its description; the training ranges are taken from it.
        model: with its numbers filled in; it stays as it is.
        recorded: states, inputs and steady runs of the logs that fitted it.
        divergence: a velocity beyond this many times its largest training value has run away.
    """
    # a copy: the checks run in float64, and must not round what others hold
    model = copy.deepcopy(model).to(torch.float64).eval()
    threads = torch.get_num_threads()
    # products this small only lose time to a second thread
    torch.set_num_threads(1)
    # the memory of a mean is too large for a Jacobian at each point; free runs show what it does
    mean = "not looked at: the mean of several models, whose free runs are bounded or not"
    straight = "not looked at: the model neither sways nor turns"
    straight = straight if spec.signals.velocities == ("u",) else ""
    unstable = straight or (mean if isinstance(model, MeanOfTrajectories) else "")
    try:
        return [
            check_damping(spec, model, recorded),
            Finding(spec.name, STABILITY, None, unstable)
            if unstable
            else check_stability(spec, model, recorded),
            Finding(spec.name, SYMMETRY, None, straight)
            if straight
            else check_symmetry(spec, model, recorded),
            check_bounded(spec, model, recorded, divergence),
        ]
    finally:
        torch.set_num_threads(threads)


def _found(spec: ModelSpec, check: str, ok: bool, text: str, fault: str) -> Finding:
    said = f"unsound: {fault}. {text}" if fault else text
    return Finding(spec.name, check, ok and not fault, said, fault)


def settled_memory(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return the memory [B, n_state] after ten seconds in states x [B, 3 + n], inputs w [B, m]."""
    steps = max(round(_PAUSE / model.dt), 1) if model.n_state else 0
    return model.warmup(x[:, None].expand(-1, steps, -1), w[:, None].expand(-1, steps, -1))


def acceleration(model: HybridDynamics, x: Tensor, w: Tensor) -> Tensor:
    """Return nu_dot [B, n] of baseline and head together, the head's memory settled.

    To a model that looks for what was predicted wrong, states that are held would tell of a force
    that holds them: it has no past.
    """
    s = model.initial_state(len(x)).to(x) if model.observes else settled_memory(model, x, w)
    return model.acceleration(x, w, s)


def check_damping(spec: ModelSpec, model: HybridDynamics, recorded: Recorded) -> Finding:
    """Check that each velocity decays by itself: d u_dot/du, d v_dot/dv and so on, by autograd.

    None may be positive at more than half of the recorded points, unless it is negligible beside
    what it is elsewhere.
    """
    x, live = recorded.x.clone().requires_grad_(), spec.signals.live
    # a model may depend on no velocity at all
    nu_dot = acceleration(model, x, recorded.w) + 0.0 * velocities_on(x)
    slopes = np.stack(
        [
            torch.autograd.grad(nu_dot[:, i].sum(), x, retain_graph=True)[0][:, SURGE + i].numpy()
            for i in live.learned
        ],
        axis=1,
    )
    middle, size = np.median(slopes, axis=0), np.quantile(np.abs(slopes), 0.9, axis=0)
    said = [
        f"d{name}′/d{name} {middle[i]:+.2g} 1/s, positive at {(slopes[:, i] > 0).mean():.0%} of it"
        for i, name in enumerate(live.velocities)
        if middle[i] > _NEGLIGIBLE * size[i]
    ]
    fault = f"its damping has the wrong sign in most of the data ({'; '.join(said)})"
    values = ", ".join(
        f"d{name}′/d{name} {middle[i]:+.3g}" for i, name in enumerate(live.velocities)
    )
    text = f"medians over the training data: {values} 1/s"
    return _found(spec, DAMPING, True, text, fault if said else "")


@dataclass(frozen=True)
class OperatingPoint:
    """Straight running at a speed: state x [3 + n], inputs w [m], and whether the data reach it."""

    label: str
    speed: float
    x: Tensor
    w: Tensor
    inside: bool

    def __str__(self) -> str:
        name = f"{self.label}, " if self.label else ""
        outside = "" if self.inside else " (outside the training data)"
        return f"{name}u = {number(self.speed)} m/s{outside}"


def operating_points(spec: ModelSpec, model: HybridDynamics) -> list[OperatingPoint]:
    """Return points of straight running from rest to half as fast again as the training data.

    Each is under the drive that nearly holds the speed. Drives are all inputs that do not steer,
    moved together from the low to the high end of their ranges; rudders are amidships and the air
    is calm, as far as the ranges allow.
    """
    columns = spec.signals.columns
    live = spec.signals.live
    low, high = (_ranges(ends)[live.size :].clone() for ends in (spec.low, spec.high))
    partners = partners_of(columns)
    for name, other in partners.items():
        # both sides alike, over the range that they share
        pair = [columns.index(name), columns.index(other)]
        low[pair], high[pair] = low[pair].max(), high[pair].min()
    still = [
        i
        for i, name in enumerate(columns)
        if name in WIND_INPUTS or (name not in partners and channel_parity(name) == -1)
    ]
    drives = low + torch.linspace(0.0, 1.0, 41, dtype=torch.float64)[:, None] * (high - low)
    drives[:, still] = torch.zeros(len(still), dtype=torch.float64).clamp(low[still], high[still])
    out = []
    for fraction in _FRACTIONS if "u" in spec.signals.velocities else _FRACTIONS[:1]:
        speed = fraction * max(spec.high[0], 1e-6)
        x = torch.zeros(len(drives), len(live.states), dtype=torch.float64)
        x[:, SURGE] = speed
        with torch.no_grad():
            best = int(acceleration(model, x, drives)[:, 0].abs().argmin())
        label = {0.0: "rest", _CRUISE: "cruise"}.get(fraction, "")
        inside = spec.low[0] <= speed <= spec.high[0]
        out.append(OperatingPoint(label, speed, x[best], drives[best], inside))
    return out


def _ranges(ends: Sequence[float]) -> Tensor:
    return torch.tensor(ends, dtype=torch.float64)


def check_stability(spec: ModelSpec, model: HybridDynamics, recorded: Recorded) -> Finding:
    """Check how small disturbances of sway, yaw, roll and memory grow in straight running."""
    words = {"v": "sway", "r": "yaw", "p": "roll"}
    moved = " and ".join(words[name] for name in words if name in spec.signals.velocities)
    are = "are" if " " in moved else "is"
    found = [
        (growth_rate(model, point.x, point.w), point) for point in operating_points(spec, model)
    ]
    summary = "; ".join(
        f"{point}: slowest mode "
        + (
            f"halves in {number(-math.log(2) / rate, 2)} s"
            if rate < 0
            else f"has rate {rate:+.2g} 1/s"
        )
        for rate, point in found
        if point.label
    )
    fault = contradiction(model, recorded.steady)
    growing = [one for one in found if one[0] > math.log(2.0) / _DOUBLING]
    if not growing:
        speeds = interval([found[0][1].speed, found[-1][1].speed], digits=2)
        text = (
            f"{moved} {are} stable in straight running at {speeds} m/s (no mode doubles within"
            f" {_DOUBLING:.0f} s). {summary}"
        )
        return _found(spec, STABILITY, True, text, fault)
    inside = [one for one in growing if one[1].inside]
    rate, worst = max(inside or growing, key=lambda one: one[0])
    where = "inside the training data" if inside else "only outside the training data"
    text = (
        f"{moved} unstable in straight running, {where}: worst at {worst}, a disturbance"
        f" doubles in {number(math.log(2) / rate, 2)} s. Some full hulls are so in truth; otherwise"
        f" do not trust long free runs there. {summary}"
    )
    return _found(spec, STABILITY, False, text, fault)


def growth_rate(model: HybridDynamics, x: Tensor, w: Tensor) -> float:
    """Return the largest growth rate [1/s] of a small disturbance of all but surge at a point.

    It is the logarithm of the step map's spectral radius over dt.

    Args:
        model: in float64 and evaluation mode.
        x: state [3 + n].
        w: inputs [m].
    """
    s = settled_memory(model, x[None], w[None])
    start = torch.cat((x[SWAY:], s[0])).detach()
    count, wide = start.numel(), len(x) - SWAY
    z = start.expand(count, count).clone().requires_grad_()
    states = torch.cat((x[:SWAY].expand(count, SWAY), z[:, :wide]), dim=1)
    after, memory = model.step(states, w.expand(count, -1), z[:, wide:])
    # one row of the batch for each output: one backward pass gives the whole Jacobian
    out = torch.cat((after[:, SWAY:], memory), dim=1)
    jacobian = torch.autograd.grad(out.diagonal().sum(), z)[0]
    radius = float(torch.linalg.eigvals(jacobian).abs().max())
    return math.log(max(radius, 1e-12)) / model.dt


def contradiction(model: HybridDynamics, runs: Sequence[SteadyRun]) -> str:
    """Return in a few words how logs contradict an unstable model; empty where they do not.

    A disturbance of the model, linearised about the mean of a steady run, would have grown
    twentyfold over it; the vessel had settled from three times its deviations at the end, and these
    did not even grow threefold. The model itself, begun with the vessel's deviations, ends farther
    than three of them from where the vessel stayed. The twenty longest of such runs are looked at.
    """
    telling = [run for run in runs if run.decay > _DECAYED and run.growth < _STAYED]
    for run in sorted(telling, key=lambda run: -run.seconds)[:_MOST]:
        rate = growth_rate(model, torch.from_numpy(run.x), torch.from_numpy(run.w))
        if rate * run.seconds > math.log(_GROWN) and _departure(model, run) > _STAYED:
            return (
                "it is unstable where the logs are not (a disturbance would double in"
                f" {number(math.log(2.0) / rate, 2)} s; log {run.log} runs steadily for"
                f" {run.seconds:.0f} s)"
            )
    return ""


def _departure(model: HybridDynamics, run: SteadyRun) -> float:
    """How far the model ends from a steady run, in deviations of the vessel; infinite out of range.

    It begins with deviations of the vessel's size; the mean over the last third is looked at.
    """
    scatter = torch.from_numpy(np.maximum(run.scatter, 1e-9))
    begin = torch.from_numpy(run.x).repeat(len(_SIGNS), 1)
    begin[:, LATERAL] += torch.tensor(_SIGNS, dtype=torch.float64) * scatter
    w = torch.from_numpy(run.w).expand(len(begin), -1)
    alone = copy.deepcopy(model)
    alone.positions = False
    steps = max(round(run.seconds / model.dt), 3)
    with torch.no_grad():
        states, _, _ = Rollout(alone)(
            begin, w[:, None].expand(-1, steps, -1), settled_memory(model, begin, w)
        )
    away = states[:, -(steps // 3) :, LATERAL] - torch.from_numpy(run.x)[LATERAL]
    return float(torch.nan_to_num(away.abs() / scatter, nan=math.inf).mean(1).max())


def mirrored_inputs(columns: Sequence[str], w: Tensor) -> Tensor | None:
    """Return inputs w [B, m] as a mirror shows them; None where it is not known how that is.

    Rudders change sign, port and starboard change places, wind comes from the other side.
    """
    partners, known = partners_of(columns), {"wind_speed": 1, "wind_dir": -1}
    out, steers = [], False
    for place, name in enumerate(columns):
        parity = known.get(name, channel_parity(name))
        if name in partners:
            parity, place = pair_parity(name), columns.index(partners[name])
        if parity is None:
            return None
        steers |= name in partners or (parity < 0 and name not in known)
        out.append(parity * w[:, place])
    return torch.stack(out, dim=1) if steers else None


def check_symmetry(spec: ModelSpec, model: HybridDynamics, recorded: Recorded) -> Finding:
    """Check that mirrored states and inputs give the mirrored acceleration, at recorded points."""
    columns, x, w = spec.signals.columns, recorded.x, recorded.w
    other = mirrored_inputs(columns, w)
    if other is None:
        text = (
            f"not checked: nobody said which input steers (inputs {', '.join(spec.signals.inputs)};"
            " delta and *_port/*_stbd pairs are understood)"
        )
        return Finding(spec.name, SYMMETRY, None, text)
    live = spec.signals.live
    parity = torch.tensor(axis_parities(model.signals.names), dtype=x.dtype)
    turned = x * torch.cat((x.new_tensor([1.0, -1.0, -1.0]), parity))
    image = torch.cat((velocities_on(turned), other), dim=1)
    inside = ((image >= _ranges(spec.low)) & (image <= _ranges(spec.high))).all(1)
    if not bool(inside.any()):
        text = "not checked: no recorded state has its mirror image within the training ranges"
        return Finding(spec.name, SYMMETRY, None, text)
    with torch.no_grad():
        plain = acceleration(model, x[inside], w[inside])
        mirrored = acceleration(model, turned[inside], other[inside])
    mirrored = mirrored * parity
    uneven = 0.5 * (plain - mirrored).abs()
    spread = torch.cat((plain, mirrored)).std(0).clamp(min=1e-12)
    typical, largest = uneven.square().mean(0).sqrt() / spread, uneven.amax(0) / spread
    # the torque of a lone propeller heels the vessel to one side
    torque = {"p"} if heeling(model.signals.names) else set()
    judged = [name for name in live.velocities if name not in torque]
    pairs = (100 * torch.stack((typical, largest), dim=1)).tolist()
    shares = dict(zip(live.moving, pairs, strict=True))
    worst = max(shares[name][0] for name in judged)
    ok = worst <= 100 * _ASYMMETRY
    parts = ", ".join(
        "{}′ {:.1f} % (largest {:.1f} %)".format(name, *shares[name]) for name in live.velocities
    )
    parts += "; a propeller's torque heels, so that the roll is not judged" if torque else ""
    reason = (
        "A single screw, an offset of the steering or too few turns one way may be the reason. "
    )
    text = (
        f"port and starboard {'alike' if ok else 'differ'}: the uneven part of the acceleration is"
        f" up to {worst:.0f} % of its spread. {'' if ok else reason}RMS over"
        f" {int(inside.sum())} points of the training data: {parts}"
    )
    return Finding(spec.name, SYMMETRY, ok, text)


def check_bounded(
    spec: ModelSpec, model: HybridDynamics, recorded: Recorded, divergence: float
) -> Finding:
    """Check that the motion stays bounded with held inputs.

    It starts from the recorded points with their inputs, and from rest with inputs at the edges of
    their ranges; each is held for 300 s, or as long as the longest log where that is longer.
    """
    largest = spec.signals.live.largest(np.array(spec.low), np.array(spec.high))
    limit = torch.from_numpy(largest).clamp(min=1e-9)
    low, high = (_ranges(ends)[spec.signals.live.size :] for ends in (spec.low, spec.high))
    count = low.numel()
    if 2**count <= _CORNERS:
        pick = (torch.arange(2**count)[:, None] >> torch.arange(count)) & 1
    else:
        random = torch.Generator().manual_seed(0)
        pick = torch.randint(0, 2, (_CORNERS, count), generator=random)
    corners = low + pick.double() * (high - low)
    known = len(recorded.x)
    x = torch.cat((recorded.x, recorded.x.new_zeros(len(corners), recorded.x.shape[1])))
    w = torch.cat((recorded.w, corners))
    s, before = model.initial_state(len(x)).double(), velocities_on(x)
    pause = max(round(_PAUSE / model.dt), 1)
    # where the vessel is says nothing of how fast it is
    alone = copy.deepcopy(model)
    alone.positions = False
    steps = round(max(_LONG_RUN, recorded.longest) / model.dt)
    run, held = compiled(Rollout(alone), steps), w.unsqueeze(1).expand(-1, pause, -1)
    away = torch.zeros(len(x))
    with torch.no_grad():
        for k in range(pause, steps + 1, pause):
            states, _, s = run(x, held, s)
            x = states[:, -1]
            ratio = torch.nan_to_num(velocities_on(x).abs() / limit, nan=math.inf).amax(1)
            away = torch.where((away == 0.0) & (ratio > divergence), k * model.dt, away)
            moved = ((velocities_on(x) - before).abs() / limit).amax(1)
            before = velocities_on(x)
            if bool((away[:known] > 0.0).any()) or bool(((moved < _SETTLED) | (away > 0)).all()):
                break
    row = int((away > 0.0).double().argmax())
    inputs = ", ".join(
        f"{name} {number(factor * float(value))} {unit}".removesuffix(" -")
        for name, value in zip(spec.signals.columns, w[row], strict=True)
        for unit, factor in [shown_unit(spec.signals.units().get(name, "-"))]
    )
    beyond = f"(more than {divergence:g} times the largest training velocity)"
    if not bool((away > 0.0).any()):
        text = (
            f"{known} runs of {_LONG_RUN:.0f} s or longer from recorded states, and {len(corners)}"
            " from rest with inputs held at their extremes, stay bounded"
        )
        return _found(spec, BOUNDED, True, text, "")
    if row < known:
        fault = (
            f"it runs away within {float(away[row]):.0f} s from a recorded state with recorded"
            f" inputs ({inputs})"
        )
        return _found(spec, BOUNDED, False, beyond.strip("()"), fault)
    text = f"runs away within {float(away[row]):.0f} s with {inputs} held from rest {beyond}"
    return _found(spec, BOUNDED, False, text, "")


def sanity_content(findings: Mapping[str, Sequence[Finding]]) -> dict[str, Any]:
    """Return the contents of sanity.json from the findings of each model."""
    rows = [asdict(finding) for of_model in findings.values() for finding in of_model]
    return {"schema": SCHEMA, "findings": rows}


def read_findings(run: Path) -> list[Finding]:
    """Return the findings in a run folder's sanity.json; none where there is no such file.

    Raises:
        DataError: where the file cannot be read.
    """
    path = run / "sanity.json"
    if not path.is_file():
        return []
    try:
        return [Finding(**row) for row in read_json(path)["findings"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: not readable as the findings of a run ({error}); delete the file"
        ) from None
