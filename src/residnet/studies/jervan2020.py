"""Document 002 chapter 4: tables of the ferry study, the published figure beside each of its own."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch

from residnet.control.anticipation import Lag
from residnet.core.errors import FitError
from residnet.evaluation.figures_force import draw_surface, draw_weights
from residnet.evaluation.still_fits import Verdict, still_fits
from residnet.evaluation.tracking import mse
from residnet.export.feed_forward import export_feed_forward
from residnet.heads.regressions import SurfaceRegression
from residnet.physics.force_model import ForceModel
from residnet.run_folder import RunFolder
from residnet.studies.ferry_config import FerrySettings
from residnet.studies.ferry_fit import FerryModel, Published, Record, identify, remaining
from residnet.studies.ferry_forward import as_vessel_lines, forward_equations
from residnet.studies.ferry_runs import Flight, MotionNoise
from residnet.studies.ferry_text import coefficients_text, notes_text

_DEG = 180.0 / math.pi
AXES = ("surge", "sway", "yaw")


@dataclass(frozen=True)
class Update:
    """A model on a vessel that has changed.

    Attributes:
        verdict: whether it still fits there.
        before, after: the course there with it, and with what was identified again from that log; the same where it still fits.
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
        later: what became of each flown model on the vessel as it is later.
    """

    first: Flight
    unmodelled: list[float]
    models: dict[str, FerryModel]
    courses: dict[str, Flight]
    crossings: dict[str, Flight]
    later: dict[str, Update]


def record_of(flight: Flight, interval: float, noise: MotionNoise) -> Record:
    """The log of a course: a fold for each segment, the first half identifies."""
    fold = torch.div(flight.t + 1e-9, interval, rounding_mode="floor").long()
    train = torch.arange(len(flight.t)) < len(flight.t) // 2
    return Record(flight.t, flight.seen[:, :3], flight.seen[:, 3:6], flight.seen[:, 6:], flight.command, flight.averaged, fold, train, noise.spread())


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
    flown: dict[str, tuple[ForceModel, Lag | None]] = {n: (m.model, m.lag) for n, m in models.items() if config.models[n].fly}
    courses, crossings = {"believed": first}, {}
    if flown:
        courses |= dict(zip(flown, ferry.fly_course(config.course, list(flown.values())), strict=True))
    if config.crossing is not None:
        everyone = {"believed": (believed, None), **flown}
        crossings = dict(zip(everyone, ferry.fly_crossing(config.crossing, list(everyone.values())), strict=True))
    later = update(config, models, record, believed) if config.later is not None else {}
    return Study(first, mse(residual[~record.train]), models, courses, crossings, later)


def update(config: FerrySettings, models: dict[str, FerryModel], record: Record, believed: ForceModel) -> dict[str, Update]:
    """Fly the changed vessel with each model that flies, judge it on that log, and where it no longer fits identify it again from it."""
    ferry = config.ferry(config.later)
    known = {name: model for name, model in models.items() if config.models[name].fly}
    flights = ferry.fly_course(config.course, [(model.model, model.lag) for model in known.values()])
    out: dict[str, Update] = {}
    for (name, model), flight in zip(known.items(), flights, strict=True):
        log = record_of(flight, config.course.interval, config.noise or MotionNoise())
        then, now = remaining(model.model, model.lag, record)[~record.train], remaining(model.model, model.lag, log)
        verdict = still_fits(config.check_fit, then, now, log.command, log.fold)
        out[name] = Update(verdict, flight, flight)
        if not verdict.fits:
            again = identify(config.models[name], log, believed)
            out[name] = Update(verdict, flight, ferry.fly_course(config.course, [(again.model, again.lag)])[0])
    return out


def later_text(later: dict[str, Update]) -> str:
    """What became of the models on the changed vessel."""
    lines = ["The vessel as it is later: position MAE m with the model, and after the update", ""]
    for name, one in later.items():
        lines.append(f"- {name}: {one.verdict.text()}; {one.before.tracking.position_mae:.4g} m, then {one.after.tracking.position_mae:.4g} m")
    return "\n".join(lines)


def write(config: FerrySettings, found: Study, folder: RunFolder) -> str:
    """Write ferry.json, ferry.md, the models' tables and figures; returns the text of ferry.md."""
    folder.write_json(folder.path / "ferry.json", _content(config, found))
    parts = [config.description or config.name, residuals_text(config, found)]
    parts += [tracking_text(config, flights, kind) for kind, flights in (("course", found.courses), ("crossing", found.crossings)) if flights]
    parts += [later_text(found.later)] if found.later else []
    text = "\n\n".join(parts) + "\n"
    folder.write(folder.path / "ferry.md", text)
    for name, model in found.models.items():
        keep_model(config, found, name, folder)
        folder.write(
            folder.path / "models" / f"{name}.md",
            coefficients_text(f"Residual force of model {name}", config.models[name].terms, model.fit, model.notes),
        )
    return text


def keep_model(config: FerrySettings, found: Study, name: str, folder: RunFolder) -> None:
    """Write a model's weights as a picture, its feed-forward as TorchScript, and where it can run forward its equations."""
    model = found.models[name]
    draw_weights(config.models[name].terms, model.fit.pre, f"Weights of the basis functions in {name}", folder.figures / f"weights_{name}.png")
    motion = torch.cat((found.first.nu_dot, found.first.nu), dim=-1)
    ranges = list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))
    export_feed_forward(model.model, model.notes.get("lag"), ranges, folder.exports / f"{name}_feed_forward.pt")
    try:
        lines = as_vessel_lines(forward_equations(config.believed, model.model, f"model {name}"), f"run {config.name}, model {name}")
    except FitError as error:
        lines = f"# {error}\n"
    folder.write(folder.path / "models" / f"{name}_forward.yaml", lines)
    if isinstance(config.models[name].fit, SurfaceRegression) and model.fit.surface is not None:
        picks = {
            "chosen": list(zip(model.notes["order"], model.notes["terms"], strict=True)),
            "least": [model.fit.surface.least(a) for a in range(3)],
        }
        draw_surface(model.fit.surface.error, found.unmodelled, picks, folder.figures / f"surface_{name}.png")


def _content(config: FerrySettings, found: Study) -> dict[str, Any]:
    rows = {
        name: {
            "test_mse": model.test_mse,
            "share_left": [a / b for a, b in zip(model.test_mse, found.unmodelled, strict=True)],
            "notes": model.notes,
            "terms": list(config.models[name].terms),
            "coefficients": model.fit.coefficients.tolist(),
            "intercept": model.fit.intercept.tolist(),
        }
        for name, model in found.models.items()
    }
    return {
        "schema": "residnet.ferry/1",
        "run": config.name,
        "unmodelled_test_mse": found.unmodelled,
        "models": rows,
        "course": {name: flight.tracking.row() for name, flight in found.courses.items()},
        "crossing": {name: flight.tracking.row() for name, flight in found.crossings.items()},
        "later": {
            name: {"verdict": asdict(one.verdict), "before": one.before.tracking.row(), "after": one.after.tracking.row()}
            for name, one in found.later.items()
        },
    }


def residuals_text(config: FerrySettings, found: Study) -> str:
    """Table of the residual's MSE on the test half."""
    lines = ["Residual force on the unseen half: MSE and share of the un-modelled residual's, published in brackets", ""]
    lines += ["| model | surge N^2 | sway N^2 | yaw (N m)^2 | left % | chosen |", "|---|---|---|---|---|---|"]
    base = config.published.mse
    rows = [("believed", found.unmodelled, base, "")]
    rows += [(name, model.test_mse, config.models[name].published.mse, notes_text(model.notes)) for name, model in found.models.items()]
    for name, own, printed, chosen in rows:
        cells = [_beside(own[a], printed[a] if printed else None) for a in range(3)]
        shares = [_beside(100 * own[a] / found.unmodelled[a], 100 * printed[a] / base[a] if printed and base else None) for a in range(3)]
        lines.append(f"| {name} | {' | '.join(cells)} | {' / '.join(shares)} | {chosen} |")
    return "\n".join(lines)


def tracking_text(config: FerrySettings, flights: dict[str, Flight], kind: str) -> str:
    """Table of a flight's metrics."""
    lines = [f"Closed loop, {kind}: published in brackets", ""]
    lines += ["| feed-forward | position MAE m | MSE m^2 | heading MAE deg | mean |τ| N, N, N m | mean |τ_FB| | energy J | IAEW position, heading |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for name, flight in flights.items():
        m = flight.tracking
        said = config.published if name == "believed" else config.models[name].published
        p = said if kind == "course" else _crossing(said)
        tau = ", ".join(_beside(m.tau[a], p.tau[a] if p.tau else None) for a in range(3))
        feedback = ", ".join(_beside(m.feedback[a], p.feedback[a] if p.feedback else None) for a in range(3))
        energy, iaew = (", ".join(f"{value:.4g}" for value in pair) for pair in (m.energy, m.iaew))
        cells = [
            _beside(m.position_mae, p.position_mae),
            _beside(m.position_mse, p.position_mse),
            _beside(m.heading_mae * _DEG, p.heading_mae),
            tau,
            feedback,
            energy,
            iaew,
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines).replace("|τ|", "abs τ").replace("|τ_FB|", "abs τ_FB")


def _crossing(said: Published) -> Published:
    return Published(position_mae=said.crossing_position_mae, position_mse=said.crossing_position_mse, heading_mae=said.crossing_heading_mae)


def _beside(own: float, printed: float | None) -> str:
    return f"{own:.4g}" if printed is None else f"{own:.4g} ({printed:.4g})"
