"""The manoeuvring booklet of a fit: standard manoeuvres of the identified model, with intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import ConfigError, DataError
from residnet.core.layout import ROLL
from residnet.core.log import Log
from residnet.core.names import STATE, nearest
from residnet.data.prepare import Prepared
from residnet.data.simulated import Craft, Disturbance, Flight, Sea, SensorNoise, fly, source_of
from residnet.dynamics.actuated import ActuatedDynamics, GivenActuators, InputShare
from residnet.dynamics.ensemble import SampledDynamics
from residnet.identification.fitter import FittedModel
from residnet.judge.booklet import BookletConfig, Page, contents
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.indices import steered_zigzag
from residnet.runs.folder import RunFolder

_PARAMETER = "model.baseline.theta"


def write_booklet(
    folder: RunFolder,
    config: BookletConfig,
    fitted: FittedModel,
    logs: Mapping[str, Sequence[Prepared]],
    limit: np.ndarray,
) -> str:
    """Fly, and write booklet.json and booklet.parquet; returns a line for the log.

    Args:
        config: what to fly.
        limit: [n] of what moves beyond which a free run has diverged.

    Raises:
        ResidnetError: where the model cannot fly the manoeuvres, or no interval can be had.
    """
    import pandas as pd

    craft, rudder = _craft(config, fitted, config.inputs), config.rudder()
    pages = [
        _page(craft, config, flights, limit)
        for flights in _flown(craft, config, fitted, config.manoeuvres)
    ]
    repeated = [
        (prepared.log, split)
        for split in config.repeat
        for prepared in logs.get(split, ())
        if prepared.log.manoeuvre == "zigzag"
        and np.isfinite(prepared.log.stack(("psi", rudder))).all()
    ]
    if repeated:
        shares = _shares(config, [log for log, _ in repeated])
        craft = _craft(config, fitted, shares)
        craft = replace(craft, start=torch.cat([_began(craft, log) for log, _ in repeated]))
        zigzags = [_zigzags(log, rudder, shares, craft.dynamics.dt) for log, _ in repeated]
        flown = _flown(craft, config, fitted, [acted for _, acted in zigzags])
        for measured, (zigzag, _), flights in zip(repeated, zigzags, flown, strict=True):
            named = [replace(flight, manoeuvre=zigzag) for flight in flights]
            pages.append(_page(craft, config, named, limit, *measured))
    folder.write_json(
        folder.booklet,
        contents(config.model, config.length, config.scale, config.draws, config.level, pages),
    )
    parts = []
    for page in pages:
        motions = [(-1, page.measured)] if page.measured is not None else []
        motions += [(i, f.motion) for i, f in enumerate(page.flights) if page.indices[i]]
        for draw, log in motions:
            # of drawn flights every half second or so
            every = max(round(0.5 / float(log.t[1] - log.t[0])), 1) if draw > 0 else 1
            columns = {name: log[name][::every] for name in STATE}
            angle = log[rudder] if rudder in log.channels else log[f"cmd_{rudder}"]
            about = {"page": page.name, "draw": draw, "t": log.t[::every] - log.t[0]}
            parts.append(pd.DataFrame({**about, **columns, "rudder": angle[::every]}))
    folder.write_table(folder.booklet.with_suffix(".parquet"), pd.concat(parts))
    return (
        f"booklet: {len(config.manoeuvres)} manoeuvres, {len(repeated)} measured zigzags repeated,"
        f" {config.draws} draws each"
    )


def require_flyable(config: BookletConfig, fitted: FittedModel) -> None:
    """Check that a model can be steered through the booklet's manoeuvres; nothing is flown.

    Raises:
        ConfigError: where an input or a state is not the model's.
        UsageError: where the model lacks what a manoeuvre needs.
    """
    craft = _craft(config, fitted, config.inputs)
    source_of(config.manoeuvres, craft.helm, torch.arange(2, dtype=torch.float64) * fitted.spec.dt)
    for manoeuvre in config.manoeuvres:
        manoeuvre.begin(craft.start[0], craft.helm.state)


def _craft(config: BookletConfig, fitted: FittedModel, inputs: Mapping[str, InputShare]) -> Craft:
    """Return the model behind the gear of its inputs; its rows are draws."""
    spec, model = fitted.spec, fitted.model.double()
    gear = GivenActuators(inputs, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.columns, spec.hold, gear)
    start = actuated.approach(1)
    for name, value in config.initial.items():
        if name not in actuated.state:
            raise ConfigError(
                f"booklet.initial: '{config.model}' has no state"
                f" '{name}'{nearest(name, actuated.state)}"
            )
        start[:, actuated.state.index(name)] = float(value)
    helm = Helm(gear.demand, actuated.state, gear.inputs)
    return Craft(config.model, actuated, helm, gear.commands, start)


def _flown(
    craft: Craft, config: BookletConfig, fitted: FittedModel, manoeuvres: Sequence[Manoeuvre]
) -> Iterator[list[Flight]]:
    """Yield the flights of each manoeuvre: fitted parameters first, then the drawn ones."""
    theta = drawn(fitted, config.draws, config.seed)
    rows = [manoeuvre for manoeuvre in manoeuvres for _ in range(len(theta))]
    start = craft.start.repeat_interleave(len(theta), 0) if len(craft.start) > 1 else craft.start
    many = replace(craft, dynamics=SampledDynamics(craft.dynamics, _PARAMETER, theta), start=start)
    sea = Sea(None, Disturbance(), SensorNoise(), config.seed)
    flights = fly(many, rows, sea, config.duration, craft.dynamics.dt)
    for place in range(0, len(flights), len(theta)):
        yield flights[place : place + len(theta)]


def _began(craft: Craft, log: Log) -> torch.Tensor:
    """State [1, nx] that a log began with, as far as it holds the states of a craft."""
    x = craft.start[:1].clone()
    for column, name in enumerate(craft.helm.state):
        if name in log.channels and np.isfinite(log[name][0]):
            x[0, column] = float(log[name][0])
    return x


def drawn(fitted: FittedModel, draws: int, seed: int) -> torch.Tensor:
    """Parameters of a refitted baseline: as fitted, then `draws` times from their normal
    distribution, [1 + draws, ...].
    """
    baseline = fitted.model.baseline
    assert isinstance(baseline, ParametricBaseline), "the configuration was validated"
    assert fitted.covariance is not None, "the configuration was validated"
    values, vectors = torch.linalg.eigh(fitted.covariance)
    random = torch.from_numpy(
        np.random.default_rng([seed, 7]).standard_normal((draws, len(values)))
    )
    theta = baseline.theta.detach().double().flatten().repeat(1 + draws, 1)
    theta[1:, baseline.free_indices()] += random * values.clamp(min=0.0).sqrt() @ vectors.T
    return theta.reshape(1 + draws, *baseline.theta.shape)


def _shares(config: BookletConfig, logs: Sequence[Log]) -> dict[str, InputShare]:
    """Return the shares of the inputs; full drive and steer are the most that the logs have."""
    rudder = config.rudder()
    steer = max(steered_zigzag(log, rudder).angle for log in logs)
    return {
        name: share.model_copy(
            update={"steer": steer, "limit": steer}
            if name == rudder
            else {"drive": max(float(log[name].mean()) for log in logs), "limit": None}
        )
        for name, share in config.inputs.items()
    }


def _zigzags(
    log: Log, rudder: str, shares: Mapping[str, InputShare], step: float
) -> tuple[Zigzag, Zigzag]:
    """Return the zigzag of a log, and the same with reversals where its rudder left its side.

    The gear of a model moves at once, the trial's did after its order took effect. A bound on the
    heading is seen at the next step, on average half a step of `step` seconds late.
    """
    steered = steered_zigzag(log, rudder)
    drives = [
        float(log[name].mean()) / float(share.drive)
        for name, share in shares.items()
        if name != rudder
    ]
    zigzag = Zigzag(
        name=log.name,
        drive=min(drives[0], 1.0) if drives else 0.0,
        steer=steered.angle / float(shares[rudder].steer),
        heading=steered.heading,
        first="starboard" if steered.side > 0 else "port",
        start=steered.start,
        duration=float(log.t[-1] - log.t[0]),
    )
    heading = steered.leaves - 0.5 * step * steered.turning
    return zigzag, zigzag.model_copy(update={"heading": heading})


def sound(flight: Flight, limit: np.ndarray) -> bool:
    """Whether a flight ended as it should, with what moves within the limit [n] beyond which a free
    run has diverged.
    """
    moving = np.abs(flight.motion.stack(ROLL.moving[: len(limit)]))
    return flight.fault is None and bool((moving <= limit).all())


def _page(
    craft: Craft,
    config: BookletConfig,
    flights: Sequence[Flight],
    limit: np.ndarray,
    log: Log | None = None,
    split: str = "",
) -> Page:
    """One manoeuvre with its indices by flight, beside those of the log that it repeats.

    Raises:
        DataError: where the fitted model itself does not end the manoeuvre, or diverges.
    """
    manoeuvre, name = flights[0].manoeuvre, flights[0].motion.name
    if flights[0].fault:
        raise DataError(
            f"booklet: {config.model}, {name}: {flights[0].fault}; give more"
            " duration, or another model"
        )
    if not sound(flights[0], limit):
        raise DataError(
            f"booklet: {config.model}, {name}: the model leaves the range of its training data as"
            " far as a free run that diverges; ask for less rudder or drive, or add logs that"
            " cover them"
        )
    indices = [
        manoeuvre.indices(flight.motion, None) if sound(flight, limit) else {} for flight in flights
    ]
    speed = indices[0].get("approach_speed", 0.0) * config.scale**0.5
    limits = manoeuvre.limits(craft.helm, config.length * config.scale, speed)
    found = {} if log is None else manoeuvre.indices(log.replace(t=log.t - log.t[0]), None)
    return Page(name, manoeuvre, flights, indices, limits, log, split, found)
