"""Report of force residuals on measured logs: what the data are, what every model leaves, and
whether any beats no force and no residual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.documents.jervan2020.measured.config import ForceSettings
from residnet.documents.jervan2020.measured.data import AXES
from residnet.documents.jervan2020.measured.study import ForceStudy, better, judge, unmodelled
from residnet.documents.jervan2020.model_table import coefficients_text, notes_text
from residnet.documents.jervan2020.regressions import SurfaceRegression
from residnet.physics.force_model import ForceModel
from residnet.report.figures.force import draw_surface, draw_weights
from residnet.report.figures.measured import ACCELERATION_UNITS, FORCE_UNITS, draw_pair, draw_scores
from residnet.runs.folder import RunFolder

_SCOPE = (*AXES, "their mean")


def write(config: ForceSettings, found: ForceStudy, folder: RunFolder) -> str:
    """Write force_residual.json, force_residual.md, the models' tables and figures; returns the
    text of force_residual.md.
    """
    folder.write_json(folder.path / "force_residual.json", _content(config, found))
    parts = [config.description or config.name, data_text(config, found), forces_text(found.forces)]
    parts += (
        [acceleration_text(config, found.measured.acceleration)]
        if found.measured.acceleration
        else []
    )
    groups = list(dict.fromkeys(row["force"] for row in found.rows))
    parts += [
        group_text(config, found, [row for row in found.rows if row["force"] == group])
        for group in groups
    ]
    parts.append(_verdict(found, groups))
    if found.failed:
        parts.append(
            "Not determined by these logs:\n\n"
            + "\n".join(f"- {why}" for why in found.failed.values())
        )
    text = "\n\n".join(parts) + "\n"
    folder.write(folder.path / "force_residual.md", text)
    for name, model in found.final.items():
        about = f"Residual force of model {name}, fitted on all samples"
        folder.write(
            folder.path / "models" / f"{name}.md",
            coefficients_text(about, config.models[name].terms, model.fit, model.notes),
        )
    draw(config, found, folder)
    return text


def data_text(config: ForceSettings, found: ForceStudy) -> str:
    """What was read, and how models are judged."""
    measured, wanted = found.measured, config.validation
    lengths = [
        f"{name} ({count * measured.record.dt:.0f} s)"
        for name, count in zip(measured.names, measured.record.runs, strict=True)
    ]
    masks = [
        f"{reason} {share:.1%} of {name}"
        for name, found in measured.masked.items()
        for reason, share in found.items()
    ]
    folds = int(measured.part.max()) + 1
    what = (
        "each some whole logs"
        if measured.parts == "logs"
        else "each a stretch of time of every log"
    )
    blocks = found.blocks
    of = (
        "no intervals: fewer than five segments"
        if blocks is None
        else f"95 % intervals by resampling {blocks.count} {blocks.of}"
    )
    scope = (
        "; with so few logs they speak for these logs, not for another day"
        if blocks is not None and blocks.of != "logs"
        else ""
    )
    return (
        f"Logs: {', '.join(lengths)}. Masked: {', '.join(masks) or 'nothing'};"
        f" {int(measured.good.sum())} of {len(measured.good)} samples are used.\nJudged by"
        f" cross-validation: {folds} folds, {what}, nothing learned within {wanted.gap:g} s of what"
        " is predicted; orders and penalties are chosen inside the training part, by left-out"
        f" segments of {wanted.segment:g} s. Mean over segments; {of}{scope}.\n`zero` predicts no"
        " force at all, `believed` the force of the believed hull, that is a residual of zero."
    )


def forces_text(forces: Mapping[str, Any]) -> str:
    """Commanded against actual force."""
    lag = forces["lag"]
    said = (
        lag
        if isinstance(lag, str)
        else (
            f"frequency {lag['frequency']:.3g} rad/s, damping {lag['damping']:.3g}, delay"
            f" {lag['delay']:.3g} s"
        )
    )
    lines = [f"Commanded against actual force; lag of the thrusters: {said}", ""]
    lines += [
        "| axis | rms commanded | rms actual | explained by the command % | through the lag % |"
        " gain through the lag |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    for axis in AXES:
        f = forces[axis]
        shares = f"{100 * f['explained']:.1f} | {100 * f['explained_with_lag']:.1f}"
        lines.append(
            f"| {axis} | {f['rms_commanded']:.4g} | {f['rms_actual']:.4g} | {shares} |"
            f" {f['gain_with_lag']:.3f} |"
        )
    return "\n".join(lines)


def acceleration_text(config: ForceSettings, found: Mapping[str, Any]) -> str:
    """Measured accelerations against derivatives of velocity."""
    used = (
        "the derivative of velocity"
        if config.acceleration == "velocity"
        else "the measured accelerations less their offset"
    )
    lines = [
        (
            f"Measured accelerations against the derivative of velocity (used below: {used}), m/s^2"
            " and rad/s^2"
        ),
        "",
    ]
    lines += [
        "| axis | offset [95 %] | rms apart without it | rms of the derivative | correlation |",
        "|---|---|---|---|---|",
    ]
    for axis in AXES:
        f = found[axis]
        within = "" if f["offset_ci95"] is None else " [{:.2g}, {:.2g}]".format(*f["offset_ci95"])
        lines.append(
            f"| {axis} | {f['offset']:.2g}{within} | {f['rms_without_offset']:.3g} | {f['rms']:.3g}"
            f" | {f['correlation']:.4f} |"
        )
    return "\n".join(lines)


def group_text(config: ForceSettings, found: ForceStudy, rows: Sequence[Mapping[str, Any]]) -> str:
    """Table of the models that are judged on one force."""
    lines = [
        (
            f"Residual of the {rows[0]['force']} force; in brackets the share that the document's"
            " model of that kind left, in other trials"
        ),
        "",
    ]
    titles = [
        "model",
        "MSE N^2, N^2, (N m)^2",
        "% of zero",
        "% of the believed model's",
        "mean over axes less believed, % of zero [95 %]",
    ]
    lines += [
        f"| {' | '.join([*titles, 'segments below believed %', 'chosen'])} |",
        "|---|---|---|---|---|---|---|",
    ]
    base = next(row for row in rows if row["model"] == "believed")["mse"]
    for row in rows:
        wanted = config.models.get(row["model"])
        left = []
        for axis in range(3):
            own = f"{100 * row['mse'][axis] / base[axis]:.0f}"
            published = None if wanted is None else wanted.published
            left.append(
                own
                if published is None
                else f"{own} ({100 * published[1][axis] / published[0][axis]:.0f})"
            )
        mse, zero = (
            " / ".join(f"{v:.4g}" for v in row["mse"]),
            " / ".join(f"{100 * v:.0f}" for v in row["of_zero"]),
        )
        apart = "" if "minus_believed" not in row else _interval(row["minus_believed"])
        below = (
            ""
            if "minus_believed" not in row
            else f"{100 * row['minus_believed']['segments_below'][3]:.0f}"
        )
        notes = "" if wanted is None else notes_text(found.final[row["model"]].notes)
        lines.append(
            f"| {row['model']} | {mse} | {zero} | {' / '.join(left)} | {apart} | {below} |"
            f" {notes} |"
        )
    return "\n".join(lines)


def _interval(apart: Mapping[str, Any]) -> str:
    mean, within = 100 * apart["mean"][3], apart["ci95"][3]
    return (
        f"{mean:+.1f}"
        if within is None
        else f"{mean:+.1f} [{100 * within[0]:+.1f}, {100 * within[1]:+.1f}]"
    )


def _verdict(found: ForceStudy, groups: Sequence[str]) -> str:
    """Plain words on whether anything was gained."""
    lines = ["Verdict", ""]
    for group in groups:
        known, *fits = [row for row in found.rows if row["force"] == group][1:]
        if found.blocks is None:
            lines.append(
                f"- {group} force: too few segments to say whether anything beats anything"
            )
            continue
        lines.append(
            f"- {group} force: the believed model beats no force on {_where(better(known, 'zero'))}"
        )
        winners = {
            row["model"]: better(row, "believed") for row in fits if any(better(row, "believed"))
        }
        whole = [name for name, where in winners.items() if where[3]]
        gains = [row["minus_believed"]["mean"][3] for row in fits if row["model"] in whole]
        most = f"; the most by {-100 * min(gains):.1f} % of zero's mean square" if gains else ""
        if not whole:
            lines.append(
                f"  - NONE of the {len(fits)} regressions beats a residual of zero: every interval"
                " of the mean over axes reaches to zero or above"
            )
        else:
            lines.append(
                f"  - {len(whole)} of {len(fits)} regressions beat a residual of zero in the mean"
                f" over axes: {', '.join(whole)}{most}"
            )
        single = [
            f"{name} ({_where(where[:3])})" for name, where in winners.items() if any(where[:3])
        ]
        if single:
            lines.append(
                f"  - axis by axis: {', '.join(single)}; of these {3 * len(fits)} comparisons one"
                " in forty would come out so by chance"
            )
        worse = [row["model"] for row in fits if row["minus_believed"]["ci95"][3][0] > 0]
        if worse:
            lines.append(f"  - worse than a residual of zero: {', '.join(worse)}")
    lines += _lags(found)
    standing = {name: model.forward for name, model in found.final.items() if model.forward}
    if standing:
        lines += ["", "Cannot run forward in time:", "", *(f"- {why}" for why in standing.values())]
    return "\n".join(lines)


def _lags(found: ForceStudy) -> list[str]:
    """How the lags that were fitted together with a residual compare with the thrusters' own."""
    own = found.forces["lag"]
    fitted = {
        name: model.notes["lag"] for name, model in found.final.items() if "lag" in model.notes
    }
    if isinstance(own, str) or not fitted:
        return []
    said = ", ".join(
        f"{name} {lag['frequency']:.3g} rad/s and {lag['delay']:.2g} s"
        for name, lag in fitted.items()
    )
    return [
        "",
        (
            f"Lag fitted with the residual: {said}; actual forces follow with"
            f" {own['frequency']:.3g} rad/s and {own['delay']:.2g} s."
        ),
    ]


def _where(flags: Sequence[bool]) -> str:
    return ", ".join(name for name, yes in zip(_SCOPE, flags, strict=False) if yes) or "no axis"


def draw(config: ForceSettings, found: ForceStudy, folder: RunFolder) -> None:
    """All figures."""
    measured, start = found.measured, 0
    for name, length in zip(measured.names, measured.record.runs, strict=True):
        _draw_log(config, found, name, slice(start, start + length), folder)
        start += length
    draw_scores(found.rows, folder.figures / "scores.png")
    for name, model in found.final.items():
        draw_weights(
            config.models[name].terms,
            model.fit.pre,
            f"Weights of the basis functions in {name}",
            folder.figures / f"weights_{name}.png",
        )
        if isinstance(config.models[name].fit, SurfaceRegression) and model.fit.surface is not None:
            base = next(
                row["mse"]
                for row in found.rows
                if row["model"] == "believed" and row["force"] == judge(config.models[name])
            )
            least = [model.fit.surface.least(axis) for axis in range(3)]
            picks = {
                "chosen": list(zip(model.notes["order"], model.notes["terms"], strict=True)),
                "least": least,
            }
            draw_surface(
                model.fit.surface.error, base, picks, folder.figures / f"surface_{name}.png"
            )


def _draw_log(
    config: ForceSettings, found: ForceStudy, name: str, inside: slice, folder: RunFolder
) -> None:
    """Forces, accelerations and residual of one log over time."""
    measured = found.measured
    t = measured.record.t[inside] - measured.record.t[inside.start]
    good = measured.good[inside]
    pair = measured.record.command[inside], measured.actual[inside]
    title = f"Commanded and actual force, log {name}"
    draw_pair(
        t,
        *pair,
        good,
        FORCE_UNITS,
        title,
        folder.figures / f"forces_{name}.png",
        ("commanded", "actual"),
    )
    if measured.sensed is not None:
        pair, title = (
            (
                measured.sensed[inside],
                measured.derived[inside],
            ),
            f"Measured acceleration and derivative of velocity, log {name}",
        )
        labels = ("measured acceleration", "derivative of velocity")
        draw_pair(
            t,
            *pair,
            good,
            ACCELERATION_UNITS,
            title,
            folder.figures / f"accelerations_{name}.png",
            labels,
        )
    # of the models of the actual force, the one with the least error where it saw nothing
    of_actual = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in found.rows
        if row["force"] == "actual" and row["model"] in found.judged
    }
    if of_actual:
        shown = min(of_actual, key=lambda one: of_actual[one])
        residual = unmodelled(measured, ForceModel(config.hull()), "actual")
        pair = residual[inside], (residual - found.judged[shown].error)[inside]
        title = (
            f"Residual of the believed model and what {shown} says of it where it saw nothing, log"
            f" {name}"
        )
        draw_pair(
            t,
            *pair,
            good,
            FORCE_UNITS,
            title,
            folder.figures / f"residual_{name}.png",
            ("residual of the believed model", f"said by {shown}"),
        )


def _content(config: ForceSettings, found: ForceStudy) -> dict[str, Any]:
    measured = found.measured
    return {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count}
            for name, count in zip(measured.names, measured.record.runs, strict=True)
        ],
        "used": int(measured.good.sum()),
        "masked": measured.masked,
        "folds": {"of": measured.parts, "count": int(measured.part.max()) + 1},
        "intervals": None if found.blocks is None else found.blocks.row(),
        "forces": found.forces,
        "acceleration": measured.acceleration,
        "rows": found.rows,
        "failed": found.failed,
        "models": {
            name: {
                "folds": found.judged[name].notes,
                "all": model.notes,
                "runs_forward": not model.forward,
                "terms": list(config.models[name].terms),
                "coefficients": model.fit.coefficients.tolist(),
                "intercept": model.fit.intercept.tolist(),
            }
            for name, model in found.final.items()
        },
    }
