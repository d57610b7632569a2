"""The standard recipe: a portfolio of models whose settings follow from logs and protocols."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.baselines.sets import HULL, ROLL, WIND, Roles, submerged
from residnet.core.layout import ALIVE, Live
from residnet.core.log import Log
from residnet.core.names import BOW_WIND, CHANNEL_UNITS, WIND_INPUTS, thrusters_that_turn
from residnet.core.samples import Samples
from residnet.core.stretches import stretches
from residnet.data.motion import without_pauses
from residnet.data.prepare import PrepareConfig, Prepared, prepare
from residnet.dynamics.base import Integrator
from residnet.judge.protocol import EvaluationConfig, Windows, longest_stretch
from residnet.physics.signals import FORCE_CHANNELS, WIND_CHANNELS
from residnet.physics.symmetry import live_of, mirrored_channels, wrong_parity

_STILL = 1e-3
"""Spread of a channel, as a share of its size, below which it tells nothing."""
_ASTERN = 0.01
"""Share of the samples from which a propeller that turns astern counts."""
_ROOM = 0.6
"""Share of a usual stretch that a free run may take, so that it can start at several places."""
_USUAL = 60.0
"""Length of a free run in s where no log says how long it is."""


@dataclass(frozen=True)
class Facts:
    """What the portfolio of a fit depends on.

    Attributes:
        names: channels that models see.
        moving: inputs, forces and wind channels that vary in the training logs.
        astern: inputs that take both signs there.
        step: of the grid, s.
        length: of the free runs that choose between models, s.
        history: measured past that a free run may look back on, s.
        stretch: half of the training samples lie in uninterrupted stretches at least so long, s.
        samples: of the training logs.
        rolling: time in s in which a roll turns by a radian of its period; infinite without one.
    """

    names: tuple[str, ...]
    moving: tuple[str, ...]
    astern: tuple[str, ...]
    step: float
    length: float
    history: float
    stretch: float
    samples: int
    rolling: float = math.inf

    @classmethod
    def supposed(cls, names: tuple[str, ...]) -> Facts:
        """Return facts before any log is read: every channel moves, ahead only, for long."""
        return cls(names, _acting(names), (), 0.1, _USUAL, 0.1 * _USUAL, math.inf, 20_000)

    @classmethod
    def of(
        cls, samples: Samples, logs: Sequence[Prepared], evaluation: EvaluationConfig, step: float
    ) -> Facts:
        """Return what training logs and the protocol that chooses say.

        Args:
            step: of the grid, s.
        """
        z, names = samples.z, samples.names
        spread, size = z.std(0, correction=0), z.abs().amax(0)
        moving = [
            name
            for name in _acting(names)
            if spread[names.index(name)] > _STILL * size[names.index(name)]
        ]
        astern = []
        for name in moving:
            column = z[:, names.index(name)]
            shares = [float(side.double().mean()) for side in (column > 0, column < 0)]
            astern += [name] if min(shares) > _ASTERN else []
        length, history = _free_run(logs, evaluation, step)
        lengths = np.concatenate(
            [np.diff(np.stack(stretches(log.piece)), axis=0).flatten() for log in logs]
        )
        falling = np.sort(lengths)[::-1]
        half = falling[np.searchsorted(np.cumsum(falling), 0.5 * falling.sum())]
        stretch, rolling = float(half) * step, math.inf
        if "p" in names:
            angle, rate = (float(spread[names.index(name)]) for name in ("phi", "p"))
            rolling = angle / max(rate, 1e-9)
        return cls(
            names, tuple(moving), tuple(astern), step, length, history, stretch, len(samples),
            rolling,
        )  # fmt: skip

    @property
    def longest(self) -> float:
        """Length of the longest free runs that there is a use and enough room for, s."""
        return min(self.length, _ROOM * self.stretch)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that drive the vessel and vary; forces where the model makes them."""
        return tuple(name for name in self.moving if name not in WIND_CHANNELS)

    @property
    def wind(self) -> bool:
        """Whether the true wind is known."""
        return any(name in WIND_CHANNELS for name in self.moving)


def _acting(names: Sequence[str]) -> tuple[str, ...]:
    forces = "tau_x" in names
    return tuple(
        name
        for name in names
        if name not in live_of(names).moving
        and (not forces or name in FORCE_CHANNELS or name in WIND_CHANNELS)
    )


def _free_run(
    logs: Sequence[Prepared], evaluation: EvaluationConfig, step: float
) -> tuple[float, float]:
    """Return how long the free runs are that choose between models, and their measured past, s."""
    protocol = evaluation.protocols[evaluation.selection]
    if isinstance(protocol, Windows):
        return protocol.length, protocol.history
    found = [
        window.stop - window.start
        for number, log in enumerate(logs)
        for window in protocol.windows(log, number, step)
    ]
    return (float(np.median(found)) * step if found else _USUAL), protocol.initial


_FURTHER = ("u^2 v", "u^2 r", "v^2", "r^2")
"""Terms that only long logs determine."""
LONG = 1200.0
"""Length of the training logs in s from which they are taken in."""
_MANY = 3
"""Propellers from which a rudder is not told by the race of each."""


def hull_terms(facts: Facts) -> list[str] | dict[str, list[str]]:
    """Return the terms of a manoeuvring model: hull, propellers, rudders and wind.

    A rudder is known by its name. Every other input is taken for a propeller: a force that is
    linear and quadratic in it and falls with the inflow. Forces act as they are.

    Short logs give each axis the terms that a mirror-symmetric vessel has there, and what a lone
    propeller adds to them: half as many coefficients as all terms in all axes.
    """
    terms = _terms(facts)
    if long(facts):
        return terms
    kept = ("1", *(f"{name}|{name}|" for name in facts.inputs))
    return {
        axis: [t for t in terms if t in kept or not wrong_parity(t, number, facts.names)]
        for number, axis in enumerate(live_of(facts.names).layout.velocities)
    }


def full_hull_terms(facts: Facts) -> list[str]:
    """Return the terms of a hull with all that long logs determine."""
    _, turning, driving = _acting_terms(facts)
    more = ["wind_mag r", "wind_u r"] if facts.wind else []
    more += [*_FURTHER, *(term for n in driving for term in (f"{n} v", f"{n} r"))]
    return [*_terms(facts), *more, *(t for n in turning for t in _large_angles(n, driving))]


def long(facts: Facts) -> bool:
    """Return whether the training logs are long enough for a hull of many terms."""
    return facts.samples * facts.step >= LONG


def _acting_terms(facts: Facts) -> tuple[list[str], list[str], list[str]]:
    """Return the inputs that are forces, that turn the flow, and that drive."""
    forces = [name for name in facts.inputs if name in FORCE_CHANNELS]
    turned = thrusters_that_turn(facts.inputs)
    acting = [n for n in facts.inputs if n not in (*forces, *turned, *turned.values())]
    turning = [name for name in acting if _turns(name)]
    return forces, turning, [name for name in acting if name not in turning]


def _terms(facts: Facts) -> list[str]:
    """Return the terms of all axes together.

    A thruster that turns pushes along and across; its thrust falls with the inflow.
    """
    forces, turning, driving = _acting_terms(facts)
    turned, live = thrusters_that_turn(facts.inputs), live_of(facts.names)
    moving = live.moving
    if live.spatial:
        return submerged(Roles(live.channels, (*forces, *driving), tuple(turning), (), False))
    return [
        *("1", *moving, *HULL, *(ROLL if "p" in moving else ()), *forces),
        *(
            f"{flow} {way}({angle})"
            for angle, n in turned.items()
            for flow in (f"{n}|{n}|", f"u |{n}|")[: 1 + ("u" in moving)]
            for way in ("cos", "sin")
        ),
        *(term for name in driving for term in _propeller(name, name in facts.astern)),
        *(term for name in turning for term in _rudder(name, driving, facts)),
        *(WIND if facts.wind else ()),
    ]


def _turns(name: str) -> bool:
    plain = name.removeprefix("cmd_")
    return plain.startswith(("delta", "rudder", "azimuth"))


def _propeller(name: str, astern: bool) -> list[str]:
    """Return the thrust of a propeller; one that turns astern differs from one ahead."""
    back = [f"{name}^2", f"{name} u"] if astern else []
    return [name, f"{name}|{name}|", f"|{name}| u", *back]


def _rudder(name: str, driving: Sequence[str], facts: Facts) -> list[str]:
    """Return the lift of a rudder in the inflow from speed and propellers.

    Where no log tells the speed it is that of a usual one.
    """
    if "u" in live_of(facts.names).dead:
        return [name, f"{name}|{name}|", *(f"{n}|{n}| {name}" for n in driving)]
    if len(driving) >= _MANY:
        return [name, f"u|u| {name}"]
    race = [f"{n}|{n}| {name}" for n in driving] + [f"u {n} {name}" for n in driving]
    return [f"u|u| {name}", *race, *(f"{n}^2 {name}" for n in driving if n in facts.astern)]


def _large_angles(name: str, driving: Sequence[str]) -> list[str]:
    """Return how the lift of a rudder flattens, and its drag."""
    if len(driving) != 1:
        return [name, f"u|u| {name}|{name}|", f"u|u| |{name}|"]
    race = (f"{driving[0]}|{driving[0]}|", f"u {driving[0]}")
    return [
        name,
        *(f"{flow} {name}|{name}|" for flow in race),
        *(f"{flow} |{name}|" for flow in race),
    ]


_THROUGH = 100
"""Steps of the networks in a free run of the protocol's length."""
_OF_ROLL = 0.5
"""Steps of the networks in radians of a roll."""
_REFIT = 200
"""Steps of the free runs of a refit, where its share of the protocol's length is less."""
_BATCH = 32
"""Windows in a batch for each network."""
_STEPS, _STEPS_LONG = 15, 40
"""Batches in each of twenty epochs, for short logs and for long ones."""


def refit_settings(facts: Facts) -> dict[str, Any]:
    """Return the refit of a baseline: its prior weak where logs are long."""
    horizon = min(facts.longest, max(0.2 * facts.length, _REFIT * facts.step))
    return {
        "horizon": readable(horizon),
        "every": readable(0.5 * horizon),
        "prior": 1e-2 if long(facts) or live_of(facts.names).spatial else 1.0,
        "asymmetric": 0.05,
    }


def training_settings(facts: Facts, effort: float) -> dict[str, Any]:
    """Return the training of networks in free run, over growing horizons and of a fixed length."""
    stages = [
        {
            "horizon": readable(max(share * facts.longest, 2.0 * coarse_step(facts))),
            "epochs": epochs,
            "batch": _BATCH * members(facts),
            "learning_rate": rate,
            "final": final,
        }
        # one cosine over all stages, down to a fiftieth
        for share, epochs, rate, final in (
            (0.3, 5, 3.0e-3, 0.854),
            (0.6, 5, 2.56e-3, 0.586),
            (1.0, 10, 1.5e-3, 0.04),
        )
    ]
    return {
        "history": readable(facts.history),
        "one_step": {"epochs": 0},
        "multi_step": stages,
        "steps": max(1, round((_STEPS_LONG if long(facts) else _STEPS) * effort)),
        "start_noise": 0.03,
        "weight_decay": 0.001,
        "robust": 0.05,
        "mirror": mirrored_channels(facts.names) is not None,
        # the length is fixed: the last weights are kept
        "validate_every": 20,
    }


def readable(value: float) -> float:
    """Return a number of at most three digits."""
    return float(f"{value:.3g}")


def coarse_step(facts: Facts) -> float:
    """Return the step of the networks in s: a free run is trained through in so many.

    A roll takes at least twelve a period, or what it does between them is lost.
    """
    steps = min(facts.length / _THROUGH, _OF_ROLL * facts.rolling) / facts.step
    return facts.step * max(1, round(steps))


def members(facts: Facts) -> int:
    """Return the number of networks in an ensemble."""
    return 4 if long(facts) else 6


PARTS = (
    "baseline", "baselines", "refit", "heads", "base_of", "ensembles", "means", "training",
)  # fmt: skip
"""Keys of a fit that the recipe stands in place of."""
SINGLE = "hull"
"""Name of the model that is taken where one single is needed."""
_BASES = {"hull_network": SINGLE, "network": "zero"}
"""What the networks stand on."""
MEAN = "mean"
"""Name of the mean of unlike models, which is reported first."""


def portfolio(facts: Facts, effort: float = 1.0) -> dict[str, Any]:
    """Return baselines, refits, heads and trainings by the names that the recipe gives them.

    `baseline` is linear and `hull` nonlinear in velocities and inputs, both refitted; long logs
    determine a hull of more terms. Several networks stand on the hull, and as many alone where logs
    are long. The mean of the trajectories of hull and networks is the predictor.

    Args:
        facts: of the logs; `Facts.supposed` before they are read.
        effort: how long networks are trained, 1 for usual.
    """
    network = {
        "kind": "recurrent",
        "members": members(facts),
        "hidden_size": 48 if long(facts) else 32,
        "step": readable(coarse_step(facts)),
        "restoring": True,
        "margin": 0.0,
    }
    heads = {"hull_network": network} | ({"network": network} if long(facts) else {})
    terms = full_hull_terms(facts) if long(facts) else hull_terms(facts)
    ridge = 1e-6 if live_of(facts.names).spatial else 1e-4
    wind = ["wind_u", "wind_v"] if facts.wind else []
    moving = [name for name in live_of(facts.names).moving if name != "z"]
    return {
        "baseline": _regressors(1e-6, ["1", *moving, *facts.inputs, *wind]),
        "baselines": {SINGLE: _regressors(ridge, terms)},
        "refit": dict.fromkeys(("baseline", SINGLE), refit_settings(facts)),
        "heads": heads,
        "base_of": {name: base for name, base in _BASES.items() if name in heads},
        "ensembles": {},
        "means": {MEAN: (SINGLE, *heads)},
        "training": dict.fromkeys(heads, training_settings(facts, effort)),
    }


def _regressors(ridge: float, terms: list[str] | dict[str, list[str]]) -> dict[str, Any]:
    """Return a model of regressors that neither feeds itself energy nor runs away."""
    sound = {"dissipative": True, "bounded": True}
    return {"kind": "regressors", "ridge": ridge, "terms": terms, **sound}


_WINDOWS = (100.0, 60.0, 40.0, 30.0, 20.0, 10.0, 5.0, 2.0, 1.0)
_ROOMY = 1.15
"""Times of a free run that a log lasts so that it starts somewhere in it."""
_PART = 40_000
"""First samples of a long log that mostly tell how long its stretches are."""


@dataclass(frozen=True)
class Preparation:
    """How logs are prepared for a fit, by what they hold.

    Attributes:
        interval: usual step of the logs, s.
        memory: time after which `rate` is another, s.
        step: of the grid, s.
        window: of the derivative, s.
        held: inputs that rest at one value most of the time, as commands do.
        hold: whether an input over a step is the sample at its `start` or the `mean` of its ends.
        exogenous: channels of the true wind, where every log holds them.
        rate: what the memory is that of: the yaw rate, or the speed where no log tells that.
        swings: whether the vessel rolls.
    """

    interval: float
    memory: float
    step: float
    window: float
    held: tuple[str, ...]
    hold: str
    exogenous: tuple[str, ...]
    rate: str = "yaw rate"
    swings: bool = False

    @classmethod
    def of(cls, logs: Sequence[Log], inputs: Sequence[str], live: Live = ALIVE) -> Preparation:
        """Return how logs that hold velocities are prepared for models with these inputs."""
        interval = float(np.median([np.median(np.diff(log.t)) for log in logs]))
        memories = [_memory(log) for log in logs]
        memory = float(np.median([m for m in memories if np.isfinite(m)] or [20.0 * interval]))
        # a roll is quicker than the yaw
        rolls = [_memory(log, ("phi",)) for log in logs] if live.rolls else []
        quick = min(memory, float(np.median([m for m in rolls if np.isfinite(m)] or [memory])))
        step = float(f"{interval * max(1, int(quick / 40.0 / interval)):.4g}")
        samples = min(max(5, 2 * round(0.5 * quick / 5.0 / step) + 1), 41)
        held = tuple(name for name in inputs if _rests(logs, name))
        # a true wind acts from where the vessel points, and one from the bow tells it by itself
        wind = not live.dead and all(
            {*WIND_INPUTS} <= {*log.channels}
            and ("psi" not in log.meta.get("integrated", ()) or {*BOW_WIND} & {*log.channels})
            for log in logs
        )
        return cls(
            interval,
            memory,
            step,
            float(f"{samples * step:.6g}"),
            held,
            "start" if len(held) == len(inputs) else "mean",
            WIND_INPUTS if wind else (),
            "yaw rate" if live.turns else "speed",
            live.rolls,
        )

    @property
    def reason(self) -> str:
        """What the numbers of time follow from."""
        return (
            f"logs have a sample each {self.interval:.3g} s, and a {self.rate} that stays alike"
            f" for {self.memory:.3g} s"
        )

    def content(self) -> dict[str, Any]:
        """Return `prepare` as a config has it.

        Angles that swing are set against means, as a smoothed rate is one itself.
        """
        grid: dict[str, Any] = {"step": f"{self.step:g} s"}
        grid |= {"held": list(self.held)} if self.held else {}
        window = f"{self.window:g} s"
        derivative = {"kind": "savitzky_golay", "window": window, "order": 2}
        beside = {"beside": "means"} if self.swings else {}
        return {"grid": grid, "derivative": derivative, "hold": self.hold, **beside}


def _rests(logs: Sequence[Log], name: str) -> bool:
    resting = [float(np.mean(np.diff(log[name]) == 0.0)) for log in logs if len(log) > 1]
    return bool(resting) and float(np.median(resting)) > 0.9


def integrator(live: Live) -> Integrator:
    """Return how a drafted model steps.

    A vessel in six degrees of freedom swings in few steps of its logs, which a scheme of first
    order takes for a damping of its own: the hull of a BlueROV2 erred 2.0 to 2.8 times as much as
    the vessel itself with `semi_implicit_euler`, and 1.1 to 1.4 times with `rk4`.
    """
    return "rk4" if live.spatial else "semi_implicit_euler"


def longest_time(log: Log, columns: Sequence[str], config: PrepareConfig, live: Live) -> float:
    """Return the longest time in s without a gap that preparing leaves of a log.

    It is 0 where nothing is left to learn from. Of a long log its first part tells, unless that
    holds no free run of the longest kind.

    Args:
        log: as its reader gives it.
        columns: inputs of the model.

    Raises:
        DataError: where no sample is usable.
    """
    longest = 0.0
    for part in (log.rows(slice(_PART)), log)[: 1 + (len(log) > _PART)]:
        prepared = prepare(part, "train", columns, config, live)
        if prepared.good.any():
            longest = longest_stretch(prepared) * config.grid.step
        if longest >= _ROOMY * _WINDOWS[0]:
            break
    return longest


def judging(
    splits: Mapping[str, Sequence[Log]],
    lasting: Mapping[str, Sequence[float]],
    memory: float,
    live: Live = ALIVE,
) -> dict[str, Any]:
    """Return protocols, selection and scales of a config, for logs by split.

    The test logs take part in no choice: where they are shorter than the free runs that choose,
    they are judged over shorter ones besides.

    Args:
        splits: `train`, `validation` and `test`.
        lasting: the longest time in s without a gap that preparing leaves of each of their logs.
        memory: how long the vessel remembers, s.
    """
    length = window_length(lasting["validation"] or lasting["train"], memory)
    laid = protocols(length)
    both = [*splits["train"], *splits["validation"]]
    out = {"selection": next(iter(laid)), "scales": scales(both, live)}
    if lasting["test"] and (shorter := window_length(lasting["test"], memory)) < length:
        laid |= {name: one for name, one in protocols(shorter).items() if name not in laid}
    return {"protocols": laid, **out}


def _memory(log: Log, names: Sequence[str] = ("r", "u", "v")) -> float:
    """Return the time in s after which the yaw rate is correlated by 1/e only.

    Where it holds noise alone that of the speed is taken; so with other names, the first that
    remembers a sample.
    """
    for name in names:
        values = log[name] if name in log.channels else log.t[:0]
        known = np.isfinite(values)
        if known.sum() < 50:
            continue
        t, x = log.t[known], values[known] - values[known].mean()
        step = float(np.median(np.diff(t)))
        gone = without_pauses(t)
        even = np.interp(np.arange(0.0, gone[-1], step), gone, x)[:20_000]
        power = np.abs(np.fft.rfft(even, 2 * even.size)) ** 2
        correlation = np.fft.irfft(power)[: even.size]
        below = np.flatnonzero(correlation < correlation[0] / np.e)
        if below.size and below[0] > 1:
            return float(below[0] * step)
    return float("nan")


def window_length(lasting: Sequence[float], memory: float) -> float:
    """Return the length in s of free runs that most of the logs hold.

    Args:
        lasting: the longest time in s without a gap of each log to be judged on; none ask for half
            a second.
        memory: how long the vessel remembers, s.
    """
    lengths = sorted(lasting) or [1.0]
    usual = lengths[int(0.25 * (len(lengths) - 1))]
    room = [length for length in _WINDOWS if _ROOMY * length <= usual] or [0.5 * usual]
    return next((length for length in room if length <= 15.0 * memory), room[-1])


def protocols(length: float) -> dict[str, Any]:
    """Return two protocols: free runs of a length and of a third of it."""
    short = max((w for w in _WINDOWS if w <= 0.4 * length), default=0.5 * length)
    first = min(5.0, 0.1 * length)
    return {
        f"T{seconds:g}".replace(".", "_"): {
            "kind": "windows",
            "length": f"{seconds:g} s",
            "first": f"{first:g} s",
            "history": f"{first:g} s",
        }
        for seconds in (length, short)
    }


def scales(logs: Sequence[Log], live: Live = ALIVE) -> dict[str, Any]:
    """Return the standard deviations of what lives of the motion, in units that read well."""
    least, out = 1e-4, {}
    for name in live.channels:
        spread = max(float(np.nanstd(np.concatenate([log[name] for log in logs]))), least)
        unit = CHANNEL_UNITS[name]
        shown = np.degrees(spread) if unit.startswith("rad") else spread
        out[name] = f"{shown:.3g} {unit.replace('rad', 'deg')}"
    return out
