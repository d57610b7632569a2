"""The report page of a ferry study, from its results, with the document's figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.documents.cells import beside_published, joined, notes_text, pictures
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.documents.jervan2020.published import Published
from residnet.documents.jervan2020.residual_model import AXES
from residnet.documents.jervan2020.residual_pages import (
    ABOUT_COEFFICIENTS,
    MODEL_PICTURES,
    coefficients_section,
)
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.format import DEG, number

Results = Mapping[str, Any]
_BELIEVED = "believed"


def verdict(results: Results) -> list[str]:
    """Return the sentences that sum a ferry study up."""
    models = results["models"]
    best = _best_model(results)
    left = joined([100 * share for share in models[best]["share_left"]])
    sentences = [
        f"Of {len(models)} residual models, {best} leaves the least of the residual force on the"
        f" unseen half of the course: {left} % of its mean square in surge, sway and yaw."
    ]
    for kind in ("course", "crossing"):
        flights = results[kind]
        flown = [name for name in flights if name != _BELIEVED]
        if flown:
            nearest = min(flown, key=lambda name: float(flights[name]["position_mae"]))
            before, after = (flights[name]["position_mae"] for name in (_BELIEVED, nearest))
            moves = "falls" if after < before else "does NOT fall: it goes"
            sentences.append(
                f"With {nearest} as feed-forward, the mean position error in the {kind} {moves}"
                f" from {number(before)} m to {number(after)} m."
            )
    for name, update in results["later"].items():
        sentences.append(f"On the vessel as it is later, {name} {update['text']}.")
    return sentences


def main_figures(results: Results) -> dict[str, tuple[float, str]]:
    """Return the numbers that sum a ferry study up, with their units."""
    best = _best_model(results)
    figures = {
        f"residual left by {best}, {axis}": (share, "-")
        for axis, share in zip(AXES, results["models"][best]["share_left"], strict=True)
    }
    return figures | {
        f"mean position error on the course with {name}": (flight["position_mae"], "m")
        for name, flight in results["course"].items()
    }


def _best_model(results: Results) -> str:
    """Return the model that leaves the least share of the residual, mean over the axes."""
    models: Results = results["models"]
    return min(models, key=lambda name: float(sum(models[name]["share_left"])))


def sections(config: FerrySettings, results: Results, run: Path) -> list[Section]:
    """Return the sections of the report.

    Args:
        config: the study.
        results: contents of ferry.json.
        run: run folder, which holds the figures.
    """
    models = results["models"]
    blocks: list[Block]
    out = [Section("Residual force on the unseen half", [_residuals(config, results)])]
    for kind, title in (("course", "Course in closed loop"), ("crossing", "Operational crossing")):
        if results[kind]:
            blocks = [
                *_tracking(config, results[kind], kind),
                *pictures(run, f"errors_{kind}", f"forces_{kind}"),
            ]
            out.append(Section(title, blocks))
    if results["feed_forward_alone"]:
        flights = results["feed_forward_alone"]
        blocks = [
            _alone(config, flights),
            *_tracking(config, flights, "alone"),
            *pictures(run, "errors_feed_forward_alone"),
        ]
        out.append(Section("Feed-forward without feedback", blocks))
    if results["later"]:
        out.append(Section("The vessel as it is later", [_later(results["later"])]))
    out.append(Section("Forward in time", [_forward(results["forward"])]))
    if causes := [model["not_forward"] for model in models.values() if model["not_forward"]]:
        out.append(Section("Models that cannot run forward in time", [Bullets(causes)]))
    out.append(Section("Coefficients", [Text(ABOUT_COEFFICIENTS), *_coefficients(config, results)]))
    return [*out, Section("Orders, weights and surfaces", pictures(run, *MODEL_PICTURES), True)]


def _coefficients(config: FerrySettings, results: Results) -> list[Section]:
    """Return a folded section for each model (Table 4.11)."""
    out = []
    for name, model in results["models"].items():
        model_config = config.models[name]
        others = {
            "true": {} if model_config.on else results["true_coefficients"],
            "published": model_config.published.coefficients,
        }
        out.append(coefficients_section(name, model, model["notes"], others))
    return out


def _residuals(config: FerrySettings, results: Results) -> Table:
    """Return the table of the remaining residual (Tables 4.2, 4.5, 4.7 and 4.15)."""
    unmodelled, base = results["unmodelled_test_mse"], config.published.mse
    table = Table(
        ["model", *("surge N^2", "sway N^2", "yaw (N m)^2"), *AXES, "chosen by the estimator"],
        caption="Mean square of the residual, and what is left of the believed model's.",
        groups=[("mean square", 3), ("left %", 3), ("", 1)],
    )
    rows = [(_BELIEVED, unmodelled, base, "")]
    rows += [
        (name, model["test_mse"], config.models[name].published.mse, notes_text(model["notes"]))
        for name, model in results["models"].items()
    ]
    for name, mse, published, chosen in rows:
        cells = [beside_published(mse[a], published[a] if published else None) for a in range(3)]
        for axis in range(3):
            left = 100 * published[axis] / base[axis] if published and base else None
            cells.append(beside_published(100 * mse[axis] / unmodelled[axis], left, 3))
        table.add(name, [*cells, Cell(chosen, mark="text")])
    return table


def _published(config: FerrySettings, name: str) -> Published:
    return config.published if name == _BELIEVED else config.models[name].published


def _tracking(config: FerrySettings, flights: Mapping[str, Results], kind: str) -> list[Table]:
    """Return how well a course is followed and with which forces.

    Tables 4.4, 4.10, 4.12 and 4.13 of the document; Tables 4.3 and 4.9.

    Args:
        config: the study, with published figures.
        flights: metrics by model.
        kind: `course`, `crossing` or `alone`, for which the document prints different figures.
    """
    errors = Table(
        [
            "feed-forward",
            *("mean position error m", "mean square m^2", "mean heading error deg"),
            *("power, position W", "power, heading W"),
            *("IAEW, position m s J", "IAEW, heading rad s J"),
        ],
        caption="IAEW is the integral of the error times the work (3.18).",
    )
    forces = Table(
        ["feed-forward", *("surge N", "sway N", "yaw N m") * 2],
        groups=[("mean absolute force", 3), ("mean absolute feedback", 3)],
    )
    for name, metrics in flights.items():
        printed = _of_kind(_published(config, name), kind)
        errors.add(
            name,
            [
                beside_published(metrics["position_mae"], printed.position_mae),
                beside_published(metrics["position_mse"], printed.position_mse),
                beside_published(metrics["heading_mae"] * DEG, printed.heading_mae),
                *_each(metrics["power"], printed.crossing_power),
                *_each(metrics["iaew"], None),
            ],
        )
        tau = _each(metrics["tau"], printed.tau)
        forces.add(name, [*tau, *_each(metrics["feedback"], printed.feedback)])
    return [errors, forces]


def _each(values: Sequence[float], published: Sequence[float] | None) -> list[Cell]:
    printed = [None] * len(values) if published is None else published
    return [beside_published(a, b) for a, b in zip(values, printed, strict=True)]


def _of_kind(published: Published, kind: str) -> Published:
    """Return the published figures of one kind of flight under the names of a course."""
    if kind == "course":
        return published.model_copy(update={"crossing_power": None})
    if kind == "crossing":
        return Published(
            position_mae=published.crossing_position_mae,
            position_mse=published.crossing_position_mse,
            heading_mae=published.crossing_heading_mae,
            crossing_power=published.crossing_power,
        )
    return Published()


def _alone(config: FerrySettings, flights: Mapping[str, Results]) -> Table:
    """Return the table of velocities and accelerations without feedback (Table 4.8)."""
    table = Table(
        ["feed-forward", "u", "v", "r", "u_dot", "v_dot", "r_dot"],
        caption="Mean square error against the desired motion without feedback, in (m/s)^2,"
        " (m/s)^2, (rad/s)^2, and the same per second squared.",
    )
    for name, metrics in flights.items():
        table.add(name, _each(metrics["motion_mse"], _published(config, name).alone))
    return table


def _forward(rows: Mapping[str, Results]) -> Table:
    """Return the table of free runs beside manoeuvres of the true ferry (3.22)."""
    table = Table(
        ["model", "u m/s", "v m/s", "r deg/s", "diverged"],
        caption="Root mean square errors of free runs from the commanded forces, over the runs that"
        " did not diverge. A model that explains the force may still be no model of motion.",
    )
    for name, row in rows.items():
        factors = (1.0, 1.0, DEG)
        errors = (
            ["-"] * 3
            if row["rmse"] is None
            else [number(e * f) for e, f in zip(row["rmse"], factors, strict=True)]
        )
        table.add(name, [*errors, f"{row['diverged']} of {row['runs']}"])
    return table


def _later(later: Mapping[str, Results]) -> Table:
    """Return the table of models on the changed vessel (section 3.7)."""
    table = Table(
        ["model", "mean position error m", "after the update m", "on the new log"],
        caption="A model that no longer fits is identified again from the log of one course.",
    )
    for name, update in later.items():
        errors = [number(update[when]["position_mae"], 4) for when in ("before", "after")]
        table.add(name, [*errors, Cell(update["text"], mark="text")])
    return table
