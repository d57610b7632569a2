"""Tables and pictures of the ferry study, the published figure beside each of its own (document 002
chapter 4).
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import torch

from residnet.core.errors import ConfigError, FitError
from residnet.core.frames import wrap
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.documents.jervan2020.ferry.flights import Flight
from residnet.documents.jervan2020.ferry.study import Study, Update
from residnet.documents.jervan2020.forward import (
    as_vessel_lines,
    forward_equations,
    missing_coefficients,
)
from residnet.documents.jervan2020.model_table import coefficients_text, notes_text
from residnet.documents.jervan2020.regressions import SurfaceRegression
from residnet.documents.jervan2020.residual_model import Published
from residnet.export.feed_forward import export_feed_forward
from residnet.report.figures.force import draw_surface, draw_weights
from residnet.report.figures.loop import draw_errors, draw_force_parts
from residnet.runs.folder import RunFolder

_DEG = 180.0 / math.pi


def later_text(later: dict[str, Update]) -> str:
    """What became of the models on the changed vessel."""
    lines = ["The vessel as it is later: position MAE m with the model, and after the update", ""]
    for name, one in later.items():
        lines.append(
            f"- {name}: {one.verdict.text()}; {one.before.tracking.position_mae:.4g} m, then"
            f" {one.after.tracking.position_mae:.4g} m"
        )
    return "\n".join(lines)


def write(config: FerrySettings, found: Study, folder: RunFolder) -> str:
    """Write ferry.json, ferry.md, the models' tables and figures; returns the text of ferry.md."""
    folder.write_json(folder.path / "ferry.json", _content(config, found))
    parts = [config.description or config.name, residuals_text(config, found)]
    parts += [
        tracking_text(config, flights, kind)
        for kind, flights in (("course", found.courses), ("crossing", found.crossings))
        if flights
    ]
    parts += (
        [
            alone_text(config, found.alone),
            tracking_text(config, found.alone, "course without feedback"),
        ]
        if found.alone
        else []
    )
    parts += [later_text(found.later)] if found.later else []
    standing = {
        name: why for name in found.models if (why := keep_model(config, found, name, folder))
    }
    if standing:
        parts.append(
            "Cannot run forward in time:\n\n" + "\n".join(f"- {why}" for why in standing.values())
        )
    text = "\n\n".join(parts) + "\n"
    folder.write(folder.path / "ferry.md", text)
    truth = missing_coefficients(config.true, config.believed)
    for name, model in found.models.items():
        said = config.models[name]
        about = f"Residual force of model {name}"
        table = coefficients_text(
            about,
            said.terms,
            model.fit,
            model.notes,
            truth if not said.on else {},
            said.published.coefficients,
        )
        folder.write(folder.path / "models" / f"{name}.md", table)
    for kind, flights in (
        ("course", found.courses),
        ("crossing", found.crossings),
        ("feed_forward_alone", found.alone),
    ):
        if flights:
            draw_flights(flights, kind, folder)
    return text


def draw_flights(flights: dict[str, Flight], kind: str, folder: RunFolder) -> None:
    """Errors of all models over time, and the forces of the believed one and of the first two
    models beside it.
    """
    t = next(iter(flights.values())).t
    position = {
        name: (flight.desired - flight.pose)[:, :2].norm(dim=-1) for name, flight in flights.items()
    }
    heading = {
        name: wrap((flight.desired - flight.pose)[:, 2]).abs() for name, flight in flights.items()
    }
    draw_errors(t, position, heading, folder.figures / f"errors_{kind}.png")
    if not any(bool(flight.feedback.any()) for flight in flights.values()):
        return
    shown = dict(list(flights.items())[:3])
    parts = (
        {name: flight.command for name, flight in shown.items()},
        {name: flight.feedback for name, flight in shown.items()},
    )
    draw_force_parts(t, *parts, folder.figures / f"forces_{kind}.png")


def keep_model(config: FerrySettings, found: Study, name: str, folder: RunFolder) -> str:
    """Write a model's weights as a picture, its feed-forward as TorchScript, and its equations, or
    return why it cannot run forward.
    """
    model = found.models[name]
    draw_weights(
        config.models[name].terms,
        model.fit.pre,
        f"Weights of the basis functions in {name}",
        folder.figures / f"weights_{name}.png",
    )
    motion = torch.cat((found.first.nu_dot, found.first.nu), dim=-1)
    ranges = list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))
    export_feed_forward(
        model.model, model.notes.get("lag"), ranges, folder.exports / f"{name}_feed_forward.pt"
    )
    if isinstance(config.models[name].fit, SurfaceRegression) and model.fit.surface is not None:
        picks = {
            "chosen": list(zip(model.notes["order"], model.notes["terms"], strict=True)),
            "least": [model.fit.surface.least(a) for a in range(3)],
        }
        draw_surface(
            model.fit.surface.error, found.unmodelled, picks, folder.figures / f"surface_{name}.png"
        )
    try:
        equations = forward_equations(config.believed, model.model, f"model {name}")
    except (ConfigError, FitError) as error:
        return str(error)
    folder.write(
        folder.path / "models" / f"{name}_forward.yaml",
        as_vessel_lines(equations, f"run {config.name}, model {name}"),
    )
    return ""


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
        "feed_forward_alone": {name: flight.tracking.row() for name, flight in found.alone.items()},
        "later": {
            name: {
                "verdict": asdict(one.verdict),
                "before": one.before.tracking.row(),
                "after": one.after.tracking.row(),
            }
            for name, one in found.later.items()
        },
    }


def residuals_text(config: FerrySettings, found: Study) -> str:
    """Table of the residual's MSE on the test half."""
    lines = [
        (
            "Residual force on the unseen half: MSE and share of the un-modelled residual's,"
            " published in brackets"
        ),
        "",
    ]
    lines += [
        "| model | surge N^2 | sway N^2 | yaw (N m)^2 | left % | chosen |",
        "|---|---|---|---|---|---|",
    ]
    base = config.published.mse
    rows = [("believed", found.unmodelled, base, "")]
    rows += [
        (name, model.test_mse, config.models[name].published.mse, notes_text(model.notes))
        for name, model in found.models.items()
    ]
    for name, own, printed, chosen in rows:
        cells = [_beside(own[a], printed[a] if printed else None) for a in range(3)]
        shares = [
            _beside(
                100 * own[a] / found.unmodelled[a],
                100 * printed[a] / base[a] if printed and base else None,
            )
            for a in range(3)
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {' / '.join(shares)} | {chosen} |")
    return "\n".join(lines)


def alone_text(config: FerrySettings, flights: dict[str, Flight]) -> str:
    """Table 4.8: how far the feed-forward alone keeps velocities and accelerations."""
    lines = [
        (
            "Feed-forward alone: MSE against the desired motion in (m/s)^2, (m/s)^2, (rad/s)^2 and"
            " per second squared, published in brackets"
        ),
        "",
    ]
    lines += [
        "| feed-forward | u | v | r | u_dot | v_dot | r_dot |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, flight in flights.items():
        said = config.published if name == "believed" else config.models[name].published
        own = flight.tracking.motion_mse
        cells = (_beside(own[i], said.alone[i] if said.alone else None) for i in range(6))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def tracking_text(config: FerrySettings, flights: dict[str, Flight], kind: str) -> str:
    """Table of a flight's metrics."""
    lines = [f"Closed loop, {kind}: published in brackets", ""]
    titles = [
        "feed-forward",
        "position MAE m",
        "MSE m^2",
        "heading MAE deg",
        "mean |τ| N, N, N m",
        "mean |τ_FB|",
    ]
    titles += ["energy J", "power W", "IAEW position, heading"]
    lines += [f"| {' | '.join(titles)} |"]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for name, flight in flights.items():
        m = flight.tracking
        said = config.published if name == "believed" else config.models[name].published
        p = {
            "course": said.model_copy(update={"crossing_power": None}),
            "crossing": _crossing(said),
        }.get(kind, Published())
        tau = ", ".join(_beside(m.tau[a], p.tau[a] if p.tau else None) for a in range(3))
        feedback = ", ".join(
            _beside(m.feedback[a], p.feedback[a] if p.feedback else None) for a in range(3)
        )
        energy, iaew = (", ".join(f"{value:.4g}" for value in pair) for pair in (m.energy, m.iaew))
        cells = [
            _beside(m.position_mae, p.position_mae),
            _beside(m.position_mse, p.position_mse),
            _beside(m.heading_mae * _DEG, p.heading_mae),
            tau,
            feedback,
            energy,
            ", ".join(
                _beside(m.power[i], p.crossing_power[i] if p.crossing_power else None)
                for i in range(2)
            ),
            iaew,
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines).replace("|τ|", "abs τ").replace("|τ_FB|", "abs τ_FB")


def _crossing(said: Published) -> Published:
    return Published(
        position_mae=said.crossing_position_mae,
        position_mse=said.crossing_position_mse,
        heading_mae=said.crossing_heading_mae,
        crossing_power=said.crossing_power,
    )


def _beside(own: float, printed: float | None) -> str:
    return f"{own:.4g}" if printed is None else f"{own:.4g} ({printed:.4g})"
