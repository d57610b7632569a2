"""Document 002 chapter 4: the ferry flown with a believed model, identified, and flown again with
what was found.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from residnet.control.motion.anticipation import Lag
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.documents.jervan2020.ferry.flights import Flight, MotionNoise
from residnet.documents.jervan2020.residual_model import FerryModel, Record, identify, remaining
from residnet.judge.still_fits import Verdict, still_fits
from residnet.judge.tracking import mse
from residnet.physics.force_model import ForceModel


@dataclass(frozen=True)
class Update:
    """A model on a vessel that has changed.

    Attributes:
        verdict: whether it still fits there.
        before, after: the course there with it, and with what was identified again from that log;
            the same where it still fits.
    """

    verdict: Verdict
    before: Flight
    after: Flight


@dataclass(frozen=True)
class Study:
    """Everything that was flown and fitted.

    Attributes:
        first: the course with the believed model, which identifies.
        unmodelled: MSE of its residual on the test half.
        models: fitted, by name.
        courses, crossings: flights by model, `believed` first.
        alone: the course by model without feedback.
        later: what became of each flown model on the vessel as it is later.
    """

    first: Flight
    unmodelled: list[float]
    models: dict[str, FerryModel]
    courses: dict[str, Flight]
    crossings: dict[str, Flight]
    alone: dict[str, Flight]
    later: dict[str, Update]


def record_of(flight: Flight, interval: float, noise: MotionNoise) -> Record:
    """The log of a course: a fold for each segment, the first half identifies."""
    fold = torch.div(flight.t + 1e-9, interval, rounding_mode="floor").long()
    train = torch.arange(len(flight.t)) < len(flight.t) // 2
    return Record(
        flight.t,
        flight.seen[:, :3],
        flight.seen[:, 3:6],
        flight.seen[:, 6:],
        flight.command,
        flight.averaged,
        fold,
        train,
        noise.spread(),
    )


def study(config: FerrySettings) -> Study:
    """Fly with the believed model, identify, fly with what was found."""
    ferry = config.ferry()
    believed = ForceModel(ferry.believed.hull)
    first = ferry.fly_course(config.course, [(believed, None)])[0]
    record = record_of(first, config.course.interval, config.noise or MotionNoise())
    residual = believed.residual(record.command, record.nu_dot, record.nu, record.pose[:, 2])
    models: dict[str, FerryModel] = {}
    for name, wanted in config.models.items():
        models[name] = identify(wanted, record, models[wanted.on].model if wanted.on else believed)
    flown: dict[str, tuple[ForceModel, Lag | None]] = {
        n: (m.model, m.lag) for n, m in models.items() if config.models[n].fly
    }
    courses, crossings = {"believed": first}, {}
    if flown:
        courses |= dict(
            zip(flown, ferry.fly_course(config.course, list(flown.values())), strict=True)
        )
    everyone: dict[str, tuple[ForceModel, Lag | None]] = {"believed": (believed, None), **flown}
    alone = {}
    if config.feed_forward_alone:
        alone = dict(
            zip(
                everyone,
                ferry.without_feedback().fly_course(config.course, list(everyone.values())),
                strict=True,
            )
        )
    if config.crossing is not None:
        crossings = dict(
            zip(everyone, ferry.fly_crossing(config.crossing, list(everyone.values())), strict=True)
        )
    later = update(config, models, record, believed) if config.later is not None else {}
    return Study(first, mse(residual[~record.train]), models, courses, crossings, alone, later)


def update(
    config: FerrySettings, models: dict[str, FerryModel], record: Record, believed: ForceModel
) -> dict[str, Update]:
    """Fly the changed vessel with each model that flies, judge it on that log, and where it no
    longer fits identify it again from it.
    """
    ferry = config.ferry(config.later)
    known = {name: model for name, model in models.items() if config.models[name].fly}
    flights = ferry.fly_course(
        config.course, [(model.model, model.lag) for model in known.values()]
    )
    out: dict[str, Update] = {}
    for (name, model), flight in zip(known.items(), flights, strict=True):
        log = record_of(flight, config.course.interval, config.noise or MotionNoise())
        then, now = (
            remaining(model.model, model.lag, record)[~record.train],
            remaining(model.model, model.lag, log),
        )
        verdict = still_fits(config.check_fit, then, now, log.command, log.fold)
        out[name] = Update(verdict, flight, flight)
        if not verdict.fits:
            again = identify(config.models[name], log, believed)
            out[name] = Update(
                verdict, flight, ferry.fly_course(config.course, [(again.model, again.lag)])[0]
            )
    return out
