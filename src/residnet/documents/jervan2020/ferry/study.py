"""The ferry study: fly, identify a residual, and fly again (document 002, chapter 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from residnet.control.motion.anticipation import Lag
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, VELOCITIES
from residnet.documents.jervan2020.ferry.config import FerrySettings, Half
from residnet.documents.jervan2020.ferry.flights import Flight, MotionNoise
from residnet.documents.jervan2020.ferry.identification import FerryModel, identify
from residnet.documents.jervan2020.residual_model import Record, remaining
from residnet.judge.still_fits import Verdict, still_fits
from residnet.judge.tracking import mse
from residnet.physics.force_model import ForceModel


@dataclass(frozen=True)
class Update:
    """A model on a vessel that has changed since it was identified.

    Attributes:
        verdict: whether the model still fits.
        before: the course of the changed vessel with the model.
        after: the course with the model that was identified again from that log; the same flight
            where the model still fits.
    """

    verdict: Verdict
    before: Flight
    after: Flight


@dataclass(frozen=True)
class Study:
    """Everything that was flown and fitted.

    Attributes:
        first: the course with the believed model, from which the models are identified.
        record: its log, of which one half identifies the models and the other tests them.
        unmodelled: mean square of the believed model's residual on the test half, by axis in N^2,
            N^2, (N m)^2.
        models: fitted models by name.
        courses: the course by model, `believed` first.
        crossings: the crossing by model, `believed` first.
        alone: the course without feedback, by model.
        later: each model that flies, on the vessel as it is later.
    """

    first: Flight
    record: Record
    unmodelled: list[float]
    models: dict[str, FerryModel]
    courses: dict[str, Flight]
    crossings: dict[str, Flight]
    alone: dict[str, Flight]
    later: dict[str, Update]


def record_of(flight: Flight, interval: float, noise: MotionNoise, half: Half = "first") -> Record:
    """Return the log of a course with a fold for each segment; one half identifies.

    Args:
        flight: the course as it was flown.
        interval: time from one waypoint to the next in s.
        noise: what is known of the sensors.
        half: of the course, which identifies.
    """
    fold = torch.div(flight.t + 1e-9, interval, rounding_mode="floor").long()
    train = torch.arange(len(flight.t)) < len(flight.t) // 2
    train = train if half == "first" else ~train
    return Record(
        flight.t,
        flight.measured[:, POSE],
        flight.measured[:, VELOCITIES],
        flight.measured[:, ACCELERATIONS],
        flight.command,
        flight.averaged,
        fold,
        train,
        noise.spread(),
    )


def study(config: FerrySettings) -> Study:
    """Fly with the believed model, identify residual models, and fly with these.

    Raises:
        ResidnetError: where a model cannot be identified or flown.
    """
    ferry = config.ferry()
    believed = ForceModel(ferry.believed.hull)
    first = ferry.fly_course(config.course, [(believed, None)])[0]
    noise = config.noise or MotionNoise()
    record = record_of(first, config.course.interval, noise, config.identify)
    residual = believed.residual(record.command, record.nu_dot, record.nu, record.pose[:, HEADING])
    models: dict[str, FerryModel] = {}
    for name, model_config in config.models.items():
        base = models[model_config.on].model if model_config.on else believed
        models[name] = identify(model_config, record, base)
    flown: dict[str, tuple[ForceModel, Lag | None]] = {
        name: (fitted.model, fitted.lag)
        for name, fitted in models.items()
        if config.models[name].fly
    }
    courses, crossings = {"believed": first}, {}
    if flown:
        courses |= dict(
            zip(flown, ferry.fly_course(config.course, list(flown.values())), strict=True)
        )
    feed_forwards: dict[str, tuple[ForceModel, Lag | None]] = {
        "believed": (believed, None),
        **flown,
    }
    alone = {}
    if config.feed_forward_alone:
        alone = dict(
            zip(
                feed_forwards,
                ferry.without_feedback().fly_course(config.course, list(feed_forwards.values())),
                strict=True,
            )
        )
    if config.crossing is not None:
        crossings = dict(
            zip(
                feed_forwards,
                ferry.fly_crossing(config.crossing, list(feed_forwards.values())),
                strict=True,
            )
        )
    later = update(config, models, record, believed) if config.later is not None else {}
    return Study(
        first, record, mse(residual[~record.train]), models, courses, crossings, alone, later
    )


def update(
    config: FerrySettings, models: dict[str, FerryModel], record: Record, believed: ForceModel
) -> dict[str, Update]:
    """Fly the changed vessel with each model, and identify again those that no longer fit.

    Args:
        config: the study, which names the changed vessel.
        models: fitted models; those that fly are taken.
        record: the log that they were identified from.
        believed: the model of the controller.
    """
    ferry = config.ferry(config.later)
    known = {name: model for name, model in models.items() if config.models[name].fly}
    flights = ferry.fly_course(
        config.course, [(model.model, model.lag) for model in known.values()]
    )
    out: dict[str, Update] = {}
    for (name, model), flight in zip(known.items(), flights, strict=True):
        noise = config.noise or MotionNoise()
        log = record_of(flight, config.course.interval, noise, config.identify)
        before = remaining(model.model, model.lag, record)[~record.train]
        now = remaining(model.model, model.lag, log)
        verdict = still_fits(config.check_fit, before, now, log.command, log.fold)
        out[name] = Update(verdict, flight, flight)
        if not verdict.fits:
            again = identify(config.models[name], log, believed)
            out[name] = Update(
                verdict, flight, ferry.fly_course(config.course, [(again.model, again.lag)])[0]
            )
    return out
