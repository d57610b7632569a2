"""Task `force_residual`: residual models of measured forces (document 002, chapter 5).

Every model is cross-validated and judged beside two others: no force at all, and the believed hull
alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.errors import ConfigError, FitError
from residnet.core.format import fixed, interval, listed, number, plural, signed
from residnet.core.layout import HEADING
from residnet.core.stretches import stretches
from residnet.data.prepare import PrepareConfig
from residnet.documents.jervan2020.force_logs import (
    FoldsConfig,
    ForceChannels,
    ForceLogs,
    Measured,
    compare_forces,
    read_measured,
)
from residnet.documents.jervan2020.residual import (
    AXES,
    Fit,
    ResidualModelConfig,
    fit_as_json,
    fit_model,
    forward_equations,
    model_figures,
    model_sections,
)
from residnet.documents.study import Results, Study, compared, histories, notes_text, pictures
from residnet.judge.metrics import intervals
from residnet.physics.force_model import ForceModel
from residnet.physics.hull import HullConfig
from residnet.physics.plant import Hull, HullPlant
from residnet.physics.vessel import load_vessel
from residnet.report.blocks import Bullets, Cell, Section, Table, Text, table_of
from residnet.report.figure import (
    BLUE,
    DASHED,
    GREY,
    MASKED,
    SOLID,
    ZERO,
    Case,
    Figure,
    Look,
    Panel,
    names_of,
    whiskers,
)
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, PartName

_NULLS = {"zero": "no force at all", "believed": "the believed model alone"}
"""What needs no regression."""
_FORCE_UNITS = tuple((label, 1.0) for label in ("surge [N]", "sway [N]", "yaw [N m]"))
_ACCELERATION_UNITS = tuple(
    (label, 1.0) for label in ("surge [m/s²]", "sway [m/s²]", "yaw [rad/s²]")
)


class MeasuredModelConfig(ResidualModelConfig):
    """One regression of the residual of measured forces.

    Attributes:
        lag: as there, but never searched: an actual force has none.
        force: force that the model explains: the actual or the commanded one.
        published: mean square of the residual on the document's own test half, without and with
            this model, in N^2, N^2, (N m)^2; from other trials, with the ferry as it was then.
    """

    lag: bool = False
    force: Literal["actual", "commanded"] = "actual"
    published: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    @property
    def judged_on(self) -> Literal["actual", "commanded"]:
        """The force that judges the model.

        A lag alone could make the residual of a command small: a model with lag is judged on the
        actual force.
        """
        return "actual" if self.lag else self.force

    @model_validator(mode="after")
    def _combination(self) -> MeasuredModelConfig:
        if self.lag and self.force != "commanded":
            raise ValueError(
                "lag: forces lag behind commands; set force to 'commanded', or leave lag out"
            )
        if self.fit.choose == "test":
            raise ValueError(
                "fit.choose: 'test' lets the samples that judge a model choose it; take simplest or"
                " least"
            )
        return self


@final
class ForceResidualConfig(Study, ComputingTask):
    """Regressions of the residual force of a believed hull on measured logs, cross-validated.

    Attributes:
        task: `force_residual`.
        believed: vessel whose hull is the known part, by name or file.
        data: the measured logs.
        prepare: time grid, masks, and how velocities are smoothed and differentiated.
        channels: names of the channels of force and acceleration.
        validation: how the models are cross-validated.
        models: regressions by name.
    """

    results_file: ClassVar[str] = "force_residual.json"

    task: Literal["force_residual"]
    believed: str
    data: ForceLogs
    prepare: PrepareConfig
    channels: ForceChannels
    validation: FoldsConfig = FoldsConfig()
    models: dict[PartName, MeasuredModelConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _combination(self) -> ForceResidualConfig:
        if taken := sorted(set(_NULLS) & set(self.models)):
            raise ValueError(f"'{taken[0]}' cannot name a model: it stands beside all of them")
        if self.prepare.hold != "start":
            raise ValueError("prepare.hold: nothing runs forward here, leave it out")
        if (
            self.validation.gap < self.prepare.grid.step
            or self.validation.segment < 10 * self.prepare.grid.step
        ):
            raise ValueError(
                "validation: gap holds at least one step of the grid, segment at least ten"
            )
        try:
            self.hull()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def hull(self) -> Hull:
        """Return the known hull.

        Raises:
            ConfigError: where the vessel is no hull by matrices.
        """
        config = load_vessel(self.believed)
        vessel = config.build() if isinstance(config, HullConfig) else None
        if not isinstance(vessel, HullPlant):
            raise ConfigError(
                f"believed: '{self.believed}' is of kind '{config.kind}'; a believed hull needs one"
                " of kind fossen or mass_matrix"
            )
        return vessel.hull

    def check(self) -> None:
        measured = self.measured()
        for part in measured.part.unique().tolist():
            measured.split(part, self.validation.gap)

    def input_files(self) -> Sequence[Path]:
        return self.data.files()

    def measured(self) -> Measured:
        """Return what the logs hold."""
        return read_measured(self.data, self.channels, self.prepare, self.validation)

    def results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        return force_study(self)

    def main_figures(self, results: Results) -> dict[str, MainFigure]:
        figures: dict[str, MainFigure] = {}
        for force, rows in _groups(results).items():
            best = min(rows.values(), key=lambda row: sum(row["of_zero"]))
            for row in (rows["believed"], best):
                name = f"share of the {force} force left by {row['model']}"
                figures[name] = MainFigure(sum(row["of_zero"]) / 3)
        return figures

    def verdict(self, results: Results) -> list[str]:
        """Return the sentences that say for each force whether a regression gained anything."""
        sentences: list[str] = []
        for force, rows in _groups(results).items():
            if results["intervals"] is None:
                sentences.append(
                    f"{force.capitalize()} force: there are too few segments to say whether one"
                    " model is better than another."
                )
                continue
            believed = rows["believed"]
            bounds = believed["minus_zero"]["ci95"][:3]
            worse = [axis for axis, limits in zip(AXES, bounds, strict=True) if limits[0] > 0]
            sentences.append(
                f"{force.capitalize()} force: the believed model is better than no force"
                f" {_where(better(believed, 'zero'))}"
                + (f", and worse than no force in {listed(worse)}." if worse else ".")
            )
            sentences += _gains([row for name, row in rows.items() if name not in _NULLS])
        thrusters = results["forces"]["lag"]
        lags = {name: model["all"].get("lag") for name, model in results["models"].items()}
        each = [
            f"{number(lag['frequency'])} rad/s and {number(lag['delay'], 2)} s for {name}"
            for name, lag in lags.items()
            if lag
        ]
        if each and not isinstance(thrusters, str):
            sentences.append(
                f"The lag fitted together with the residual is {listed(each)}; the actual forces"
                f" follow the commands with {number(thrusters['frequency'])} rad/s and"
                f" {number(thrusters['delay'], 2)} s."
            )
        return sentences

    def sections(self, results: Results, run: Path) -> list[Section]:
        drawn = [one.part() for one in pictures(run, "scores")]
        first = next(iter(_groups(results).values()))
        out = [
            Section("", [*drawn, _models(self, results, first).part(3, 6)]),
            _data(self, results),
            _forces(results, run),
        ]
        if results["acceleration"]:
            out.append(_accelerations(results, run))
        for force, rows in _groups(results).items():
            out.append(Section(f"Residual of the {force} force", [_models(self, results, rows)]))
        out.append(Section("Errors and residuals", pictures(run, "scores", "residual_")))
        if results["failed"]:
            causes = list(results["failed"].values())
            out.append(Section("Not determined by these logs", [Bullets(causes)]))
        title = "Coefficients of models fitted to all samples"
        return out + model_sections(title, results["models"], run, "all", {})


class Model(NamedTuple):
    """A model that the logs determine.

    Attributes:
        error: residual [N, 3] in N, N, N m that remains on folds that were left out of the fit; NaN
            where a sample is not used.
        folds: what the estimator chose in each fold.
        fit: coefficients fitted to all good samples, to be read and not to be judged.
        not_forward: why it cannot run forward in time; empty where it can.
    """

    error: Tensor
    folds: list[dict[str, Any]]
    fit: Fit
    not_forward: str


def force_study(config: ForceResidualConfig) -> tuple[dict[str, Any], list[Figure]]:
    """Read the logs, fit and judge every model; return what force_residual.json holds, and figures.

    A model that the logs do not determine is set aside with the reason.

    Raises:
        ResidnetError: where a log cannot be used or no model is determined.
    """
    measured, believed = config.measured(), ForceModel(config.hull())
    models, failed = dict[str, Model](), dict[str, str]()
    for name, of_model in config.models.items():
        try:
            models[name] = _judged(config, name, of_model, measured, believed)
        except FitError as error:
            failed[name] = f"model {name}: {error}"
    if not models:
        raise FitError(next(iter(failed.values())))
    record, parts = measured.record, measured.blocks()
    motion = record.nu_dot, record.nu, record.pose[:, HEADING]
    unmodelled = {
        which: believed.residual(force, *motion) for which, force in measured.forces.items()
    }
    rows = _rows(config, measured, models, unmodelled)
    content = {
        "schema": "residnet.force_residual/1",
        "run": config.name,
        "logs": [
            {"name": name, "samples": count, "seconds": count * record.dt}
            for name, count in zip(measured.names, record.runs, strict=True)
        ],
        "samples": len(measured.good),
        "used": int(measured.good.sum()),
        "masked": measured.masked,
        "folds": {"of": measured.parts, "count": int(measured.part.max()) + 1},
        "intervals": None if parts is None else parts.row(),
        "forces": compare_forces(measured),
        "acceleration": measured.acceleration,
        "rows": rows,
        "failed": failed,
        "models": {
            name: {
                "folds": model.folds,
                "all": model.fit.notes,
                "runs_forward": not model.not_forward,
                "not_forward": model.not_forward,
                **fit_as_json(config.models[name].terms, model.fit),
            }
            for name, model in models.items()
        },
    }
    signals = [
        ("forces", "Commanded and actual force", measured.forces, _FORCE_UNITS),
        (
            "accelerations",
            "Measured acceleration and derivative of velocity",
            measured.accelerations,
            _ACCELERATION_UNITS,
        ),
    ]
    # of the models of the actual force, the one with the least cross-validated error
    of_actual = {
        row["model"]: row["minus_believed"]["mean"][3]
        for row in rows
        if row["force"] == "actual" and row["model"] in models
    }
    if of_actual:
        best, residual = min(of_actual, key=of_actual.__getitem__), unmodelled["actual"]
        both = {"residual of the believed model": residual}
        both[f"predicted by {best}"] = residual - models[best].error
        title = f"Residual of the believed model and what {best} predicts on left-out folds"
        signals.append(("residual", title, both, _FORCE_UNITS))
    figures, start = [_scores(rows)], 0
    for name, length in zip(measured.names, record.runs, strict=True):
        inside = slice(start, start + length)
        figures += [_pair(measured, name, inside, *pair) for pair in signals if pair[2]]
        start += length
    before = {row["force"]: row["mse"] for row in rows if row["model"] == "believed"}
    for name, model in models.items():
        of_model = config.models[name]
        figures += model_figures(name, of_model, model.fit, before[of_model.judged_on])
    return content, figures


def _judged(
    config: ForceResidualConfig,
    name: str,
    of_model: MeasuredModelConfig,
    measured: Measured,
    believed: ForceModel,
) -> Model:
    """Fit a model for each fold on the samples outside and away from it, and to all of them.

    Raises:
        FitError: where the training samples do not determine the model.
    """
    target, command = measured.forces[of_model.judged_on], measured.forces[of_model.force]
    error, folds = torch.full_like(target, torch.nan), []
    for part in range(int(measured.part.max()) + 1):
        record, test = measured.split(part, config.validation.gap)
        model = fit_model(of_model, replace(record, command=command), believed)
        motion = record.nu_dot[test], record.nu[test], record.pose[test, HEADING]
        error[test] = model.force.residual(target[test], *motion)
        folds.append(model.fit.notes)
    model = fit_model(of_model, replace(measured.record, command=command), believed)
    not_forward = ""
    try:
        forward_equations(config.believed, model.force, f"model {name}")
    except (ConfigError, FitError) as refusal:
        not_forward = str(refusal)
    return Model(error, folds, model.fit, not_forward)


def _rows(
    config: ForceResidualConfig,
    measured: Measured,
    models: Mapping[str, Model],
    unmodelled: Mapping[str, Tensor],
) -> list[dict[str, Any]]:
    """Return the rows of all models, grouped by the force that judges them.

    Every group begins with `zero` (no force at all) and `believed` on the same samples. `reference`
    is the better of the two on each axis: a believed model may be worse than no force, and what is
    better than it is then no gain yet.
    """
    groups: dict[str, list[str]] = {}
    for name in models:
        groups.setdefault(config.models[name].judged_on, []).append(name)
    segments, parts = measured.segments(), measured.blocks()
    rows: list[dict[str, Any]] = []
    for force, names in groups.items():
        left = {"zero": measured.forces[force], "believed": unmodelled[force]}
        left |= {name: models[name].error for name in names}
        errors = {
            name: np.stack([error[segment].square().mean(0).numpy() for segment in segments])
            for name, error in left.items()
        }
        choice = [min(_NULLS, key=lambda name: float(errors[name][:, a].mean())) for a in range(3)]
        others = {name: errors[name] for name in _NULLS}
        others["reference"] = np.stack(
            [errors[name][:, a] for a, name in enumerate(choice)], axis=1
        )
        level = np.maximum(errors["zero"].mean(0), 1e-300)
        for name, error in errors.items():
            row = {
                "force": force,
                "model": name,
                "mse": error.mean(0).tolist(),
                "of_zero": (error.mean(0) / level).tolist(),
                "segments": len(segments),
                "reference": choice,
            }
            for other, theirs in others.items():
                if other != name:
                    # by axis, and for their mean
                    apart = (error - theirs) / level
                    columns = np.concatenate((apart, apart.mean(1, keepdims=True)), axis=1)
                    row[f"minus_{other}"] = {
                        "mean": columns.mean(0).tolist(),
                        "ci95": intervals(columns, parts),
                        "segments_below": (columns < 0).mean(0).tolist(),
                    }
            rows.append(row)
    return rows


def better(row: Mapping[str, Any], than: str) -> list[bool]:
    """Return whether a model's error lies below another's with 95 % confidence.

    Args:
        than: `zero`, `believed`, or `reference`, the better of the two on each axis.

    Returns:
        One flag each for surge, sway, yaw and the mean over the axes.
    """
    return [interval is not None and interval[1] < 0 for interval in row[f"minus_{than}"]["ci95"]]


def _pair(
    measured: Measured,
    log: str,
    inside: slice,
    kind: str,
    title: str,
    signals: Mapping[str, Tensor],
    units: Sequence[tuple[str, float]],
) -> Figure:
    """Return two signals along one log, masked stretches in grey."""
    t = (measured.record.t[inside] - measured.record.t[inside.start]).numpy()
    starts, stops = stretches(~measured.good[inside].numpy())
    first, second = signals
    looks = {"masked": MASKED, first: DASHED, second: SOLID}
    for label in signals:
        looks[label] = replace(looks[label], label=label, width=1.1)
    words = (f"{title}, log {log}", f"{title}, log {log}; {first} (dashed) and {second} (solid).")
    paths = {label: signal[inside].numpy() for label, signal in signals.items()}
    masked = {"masked": (t[starts], t[stops - 1])}
    return histories(f"{kind}_{log}", words, looks, t, paths, units, shared=masked)


def _scores(rows: Sequence[Results]) -> Figure:
    """Return every model's error less that of the believed model, with intervals.

    There is a panel for each force; errors are in % of its mean square.
    """
    looks = {
        "zero": replace(ZERO, kind="upright"),
        "better interval": Look("", BLUE),
        "better": Look("better than the believed model", BLUE, kind="points", size=4.5),
        "other interval": Look("", GREY),
        "other": Look("no better", GREY, kind="points", marker="s", size=4.5),
    }
    panels, shown = [], []
    for force in dict.fromkeys(row["force"] for row in rows):
        members = [row for row in rows if row["force"] == force and row["model"] != "believed"][
            ::-1
        ]
        points: dict[str, list[tuple[float, ...]]] = {"better": [], "other": []}
        for place, row in enumerate(members):
            mean, within = row["minus_believed"]["mean"][3], row["minus_believed"]["ci95"][3]
            ends = (np.nan, np.nan) if within is None else within
            kind = "better" if within is not None and within[1] < 0 else "other"
            points[kind].append((place, 100 * mean, 100 * ends[0], 100 * ends[1]))
        curves = {"zero": (np.zeros(1), np.zeros(1))}
        for kind, found in points.items():
            if found:
                at, mean, low, high = np.array(found).T
                curves[kind] = (mean, at)
                curves[f"{kind} interval"] = whiskers(at, low, high)[::-1]
        shown.append(curves)
        panels.append(
            Panel(
                "",
                "squared error less the believed model's, mean over axes [% of the mean square]",
                f"{force} force",
                height=50 + 31 * len(members),
                y_names=names_of(row["model"] for row in members),
            )
        )
    return Figure(
        "scores",
        "Errors beside the believed model",
        "Squared error of each model less that of the believed model where neither saw the"
        " data, with 95 % intervals.",
        looks,
        panels,
        [Case("", shown)],
    )


def _where(flags: Sequence[bool]) -> str:
    names = [name for name, yes in zip((*AXES, "the mean over axes"), flags, strict=False) if yes]
    return f"in {listed(names)}" if names else "on no axis"


def _gains(fits: Sequence[Results]) -> list[str]:
    """Return what the regressions of one force gain, and what to use on each axis.

    A regression is recommended where it is reliably better on that axis; of several, the one with
    the least error. Otherwise it is the better of no force and the believed model.
    """
    best = "the better of no force and the believed model on each axis"
    sure = {row["model"]: better(row, "reference") for row in fits}
    winners = [row for row in fits if sure[row["model"]][3]]
    if not winners:
        sentences = [
            f"None of the {len(fits)} regressions is better than {best}: every interval of the mean"
            " over the axes reaches zero."
        ]
    else:
        gain = -100 * min(row["minus_reference"]["mean"][3] for row in winners)
        sentences = [
            f"Of {len(fits)} regressions, these are better than {best} in the mean over the axes:"
            f" {listed([row['model'] for row in winners])}. The largest gain is {fixed(gain, 1)} %"
            " of the force's mean square."
        ]
    single = [f"{name} ({_where(flags[:3])})" for name, flags in sure.items() if any(flags[:3])]
    if single:
        sentences.append(
            f"Better on single axes: {listed(single)}; of {3 * len(fits)} such comparisons, one in"
            " forty comes out so by chance."
        )
    worse = [row["model"] for row in fits if row["minus_reference"]["ci95"][3][0] > 0]
    if worse:
        sentences.append(f"Worse than that: {listed(worse)}.")
    chosen: dict[str, list[str]] = {}
    for axis, name in enumerate(AXES):
        able = [row for row in fits if sure[row["model"]][axis]]
        use = _NULLS[fits[0]["reference"][axis]]
        if able:
            use = min(able, key=lambda row: float(row["mse"][axis]))["model"]
        chosen.setdefault(use, []).append(name)
    parts = [f"{use} in {listed(axes)}" for use, axes in chosen.items()]
    return [*sentences, f"Recommended: {', '.join(parts)}."]


def _groups(results: Results) -> dict[str, dict[str, Results]]:
    """Return the rows by force and model."""
    out: dict[str, dict[str, Results]] = {}
    for row in results["rows"]:
        out.setdefault(row["force"], {})[row["model"]] = row
    return out


def _data(config: ForceResidualConfig, results: Results) -> Section:
    lengths = [f"{log['name']} ({log['seconds']:.0f} s)" for log in results["logs"]]
    masks = [
        f"{100 * share:.1f} % of {log} by {reason}"
        for log, reasons in results["masked"].items()
        for reason, share in reasons.items()
    ]
    folds, validation, blocks = results["folds"], config.validation, results["intervals"]
    each = (
        "each consists of whole logs"
        if folds["of"] == "logs"
        else "each is a stretch of time of every log"
    )
    paragraphs = [
        f"Logs: {', '.join(lengths)}. Masked: {', '.join(masks) or 'nothing'}; {results['used']} of"
        f" {results['samples']} samples are used.",
        f"There are {folds['count']} folds; {each}. No model is fitted to data within"
        f" {validation.gap:g} s of what it predicts. Orders and penalties are chosen inside the"
        f" training part, on left-out segments of {validation.segment:g} s. Errors are means over"
        " segments.",
        "There are no intervals, because there are fewer than five segments."
        if blocks is None
        else f"Intervals (95 %) come from resampling {plural(blocks['count'], blocks['of'][:-1])}."
        + (
            ""
            if blocks["of"] == "logs"
            else " With so few logs they speak for these logs and not for another day."
        ),
        "The model zero predicts no force at all; believed predicts the force of the believed hull,"
        " which is a residual of zero.",
    ]
    return Section("Data and cross-validation", [Text(paragraphs)])


def _forces(results: Results, run: Path) -> Section:
    lag = results["forces"]["lag"]
    text = (
        f"The thrusters' lag is not determined: {lag}."
        if isinstance(lag, str)
        else f"The actual force follows the command with a lag of {number(lag['frequency'])} rad/s,"
        f" a damping ratio of {number(lag['damping'])} and a delay of {number(lag['delay'])} s."
    )
    table = table_of(
        [{"axis": axis, **results["forces"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("rms commanded", "rms_commanded", lambda value: number(value, 4)),
            ("rms actual", "rms_actual", lambda value: number(value, 4)),
            ("explained by the command %", "explained", 1, 100),
            ("explained through the lag %", "explained_with_lag", 1, 100),
            ("gain through the lag", "gain_with_lag", 3),
        ],
        caption="Forces in N, N and N m; a share is of the variance of the actual force.",
    )
    return Section("Commanded and actual force", [Text(text), table, *pictures(run, "forces_")])


def _accelerations(results: Results, run: Path) -> Section:
    table = table_of(
        [{"axis": axis, **results["acceleration"][axis]} for axis in AXES],
        [
            ("axis", "axis"),
            ("offset", "offset", lambda value: number(value, 2)),
            ("95 % interval", "offset_ci95", lambda value: interval(value, digits=2)),
            ("rms difference", "rms_without_offset", number),
            ("rms of the derivative", "rms", number),
            ("correlation", "correlation", 4),
        ],
        caption="In m/s^2, m/s^2 and rad/s^2; the models use the derivative of the velocity.",
    )
    title = "Measured accelerations and derivatives of velocity"
    return Section(title, [table, *pictures(run, "accelerations_")])


def _models(config: ForceResidualConfig, results: Results, group: Mapping[str, Results]) -> Table:
    """Return the table of the models that are judged on one force (Tables 5.1, 5.2, 5.4, 5.5)."""
    base, rows = group["believed"]["mse"], []
    for name, row in group.items():
        of_model, printed, notes = config.models.get(name), None, ""
        if of_model is not None:
            notes = notes_text(results["models"][name]["all"])
            if of_model.published is not None:
                printed = [
                    100 * after / before for before, after in zip(*of_model.published, strict=True)
                ]
        left = [100 * a / b for a, b in zip(row["mse"], base, strict=True)]
        rows.append({**row, "left": left, "published": {"left": printed}, "notes": notes})

    def apart(other: str) -> list[Any]:
        def cell(row: Any) -> Cell:
            bounds = row[other]["ci95"][3] if other in row else None
            return Cell(" to ".join(signed(100 * bound, 1) for bound in bounds or ()))

        def mean(row: Any) -> Cell:
            return Cell(signed(100 * row[other]["mean"][3], 1) if other in row else "")

        def below(row: Any) -> Cell:
            return Cell(fixed(100 * row[other]["segments_below"][3], 0) if other in row else "")

        return [("mean", mean), ("95 % interval", cell), ("segments better %", below)]

    def each(key: str, titles: Sequence[str], text: Any) -> list[Any]:
        return [(title, lambda row, i=i: Cell(text(row[key][i]))) for i, title in enumerate(titles)]

    return table_of(
        rows,
        [
            ("model", "model"),
            *each("mse", ("surge N^2", "sway N^2", "yaw (N m)^2"), lambda value: number(value, 4)),
            *each("of_zero", AXES, lambda value: fixed(100 * value, 0)),
            *compared("left", AXES, 3),
            *apart("minus_believed"),
            *apart("minus_reference"),
            ("chosen by the estimator", "notes"),
        ],
        caption="Published: the share that the document's model of that kind left of its believed"
        " model's residual, in other trials.",
        groups=[
            ("mean square error", 3),
            ("% of zero", 3),
            ("% of the believed model's", 3),
            ("mean over axes less believed, % of zero", 3),
            ("the same less the better of zero and believed on each axis", 3),
        ],
        selected=lambda row: row["model"] == _recommended(rows),
    )


def _recommended(rows: Sequence[Any]) -> str:
    """Return the best of the models surely better than no regression, else of these."""
    sure = [row for row in rows if row["model"] not in _NULLS and better(row, "reference")[3]]
    nulls = [row for row in rows if row["model"] in _NULLS]
    best = min(sure or nulls or rows, key=lambda row: sum(row["of_zero"]))
    return str(best["model"])
