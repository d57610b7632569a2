"""Content of the client report of a fit: sections of text, tables and figures.

A report for a client of a model basin has four to eight pages: vessel, tests, derivatives,
validation on held-out manoeuvres, full-scale predictions with intervals, limits of validity. The
content is plain data, so that a template decides on its layout.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from pydantic import JsonValue

from residnet.core.format import DASH, display_unit, format_interval, format_number
from residnet.core.run_records import SummaryFile
from residnet.core.version import __version__
from residnet.evaluation.booklet_records import BookletFile, BookletIndex, BookletRow
from residnet.evaluation.derivatives import DerivativeRow, DerivativesFile
from residnet.evaluation.records import MetricsRow
from residnet.physics.similarity import is_rudder
from residnet.report.run_reader import RunFiles
from residnet.report.run_settings import ModelSettings
from residnet.report.sections.manoeuvres import index_title

_SPLIT_TITLES = {
    "train": "identification",
    "validation": "model selection",
    "test": "validation (held out)",
    "external": "validation (held out)",
}
_IMO_SOURCE = "IMO resolution MSC.137(76), Standards for Ship Manoeuvrability (2002)"
_MAIN_INDICES = {
    "turning_circle": (
        "advance",
        "transfer",
        "tactical_diameter",
        "steady_diameter",
        "steady_speed_ratio",
        "time_90",
        "pull_out_yaw_rate",
    ),
    "zigzag": (
        "initial_turning_distance",
        "initial_turning_time",
        "first_overshoot",
        "second_overshoot",
        "period",
    ),
    "stopping": ("track_reach", "head_reach", "lateral_deviation", "stopping_time"),
}
_COMPARED_INDICES = ("advance", "tactical_diameter", "steady_diameter", "first_overshoot",
                     "second_overshoot", "period")  # fmt: skip
_SHIP_EXPONENTS = {"m": 1.0, "s": 0.5, "m/s": 0.5, "rad/s": -0.5}
"""Exponents of the length ratio by unit, from model scale to the ship at equal Froude number."""
_MAX_DERIVATIVES = 30
"""Largest number of rows of the table of derivatives; further ones are in derivatives.json."""


@dataclass(frozen=True)
class ReportTable:
    """A table of texts.

    Attributes:
        header: titles of the columns.
        rows: texts by row.
        caption: caption of the table.
        weights: relative widths of the columns; equal if empty.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    weights: Sequence[float] = ()

    def to_data(self) -> dict[str, JsonValue]:
        """Return header, rows, caption and column widths for the PDF template."""
        return {
            "kind": "table",
            "header": list(self.header),
            "rows": [list(row) for row in self.rows],
            "caption": self.caption,
            "weights": list(self.weights) or [1.0] * len(self.header),
        }


@dataclass(frozen=True)
class ReportText:
    """Paragraphs, or the points of a list."""

    paragraphs: Sequence[str]
    is_list: bool = False

    def to_data(self) -> dict[str, JsonValue]:
        """Return the paragraphs, as text or list, for the PDF template."""
        return {"kind": "list" if self.is_list else "text", "paragraphs": list(self.paragraphs)}


@dataclass(frozen=True)
class ReportPicture:
    """A vector figure by the name of its file.

    Attributes:
        file: name of the file.
        caption: caption of the figure.
        width: share of the text width.
    """

    file: str
    caption: str
    width: float = 1.0

    def to_data(self) -> dict[str, JsonValue]:
        """Return the figure for a template."""
        return {"kind": "figure", "file": self.file, "caption": self.caption, "width": self.width}


ReportBlock = ReportTable | ReportText | ReportPicture


@dataclass
class ReportSection:
    """A section of the client report; its number comes from its position."""

    title: str
    blocks: list[ReportBlock] = field(default_factory=list)

    def to_data(self) -> dict[str, JsonValue]:
        """Return title and blocks for the PDF template."""
        return {"title": self.title, "blocks": [block.to_data() for block in self.blocks]}


def build_sections(run: RunFiles, figures: Mapping[str, str]) -> list[ReportSection]:
    """Return the sections of the client report.

    Args:
        run: the run folder of a fit.
        figures: caption by file name of the figures that were drawn.
    """
    booklet = run.read_record(BookletFile, "booklet.json")
    derivatives = run.read_record(DerivativesFile, "derivatives.json")
    sections = [
        _summary_section(run, booklet),
        _vessel_section(run, booklet, derivatives),
    ]
    if derivatives is not None:
        sections.append(_derivatives_section(run, derivatives, figures))
    sections.append(_validation_section(run, booklet, figures))
    if booklet is not None:
        sections.append(_prediction_section(booklet, figures))
    sections.append(_limits_section(run, booklet, derivatives))
    return sections


def _summary_section(run: RunFiles, booklet: BookletFile | None) -> ReportSection:
    """Return the main results: the verdict on the prediction and the comparison with IMO."""
    section = ReportSection("Summary")
    n_logs = len({entry.log for entry in run.quality})
    n_training_logs = len({entry.log for entry in run.quality if entry.split == "train"})
    logs_text = f"{n_training_logs} of " if 0 < n_training_logs < n_logs else ""
    kinds = sorted({(entry.manoeuvre or "unknown").replace("_", " ") for entry in run.quality})
    sentences = [
        f"A manoeuvring model was identified from {logs_text}{n_logs} records of tests"
        f" ({', '.join(kinds)}) and validated by free runs, in which the model receives the"
        " measured inputs only."
    ]
    row = run.find_row(run.main_model, run.report_split, run.main_protocol)
    reference = run.find_row("constant_velocity", run.report_split, run.main_protocol)
    if row is not None:
        position = _find_position_error(run, row)
        text = f"On held-out records the mean normalised error of the model is {row.mean_nrmse:.3f}"
        if reference is not None:
            text += f" (constant velocity: {reference.mean_nrmse:.3f})"
        if position is not None:
            text += f"; the position error {run.horizon_text} is {format_number(position, 2)} m"
        sentences.append(f"{text}.")
    section.blocks.append(ReportText(sentences))
    if booklet is not None:
        rows = list(_imo_rows(booklet))
        if rows:
            section.blocks.append(
                ReportTable(
                    ("manoeuvre", "criterion", "prediction", "interval", "IMO limit", "met"),
                    rows,
                    f"Full-scale predictions compared with {_IMO_SOURCE}. Intervals:"
                    f" {100 * booklet.level:.0f} %, from {booklet.draws} draws of the parameters"
                    " and the deviations of repeated tests. Met: probability of meeting the"
                    " limit.",
                    (1.5, 2.0, 1.1, 1.5, 1.0, 0.9),
                )
            )
    return section


def _find_position_error(run: RunFiles, row: MetricsRow) -> float | None:
    """Return the position error of a model at the main horizon in m; None if it is unknown."""
    if run.main_horizon is not None and row.model in run.main_horizon.models:
        return run.main_horizon.models[row.model].position
    return row.final_pose_errors.get("position")


def _imo_rows(booklet: BookletFile) -> Iterator[tuple[str, ...]]:
    """Yield a row for each index with a limit of IMO, at full scale."""
    for page in booklet.pages:
        if page.split:
            continue
        for name, entry in page.indices.items():
            if entry.limit is None:
                continue
            unit, factor = display_unit(booklet.units.get(name, "-"))
            share = entry.kept_share
            yield (
                page.name.replace("_", " "),
                index_title(name),
                f"{format_number(factor * entry.ship, 3)} {unit}",
                _ship_interval(booklet, name, entry),
                f"{format_number(factor * entry.limit, 3)} {unit}",
                ("yes" if entry.kept else "no")
                + ("" if share is None else f" ({100 * share:.0f} %)"),
            )


def _ship_interval(booklet: BookletFile, name: str, entry: BookletIndex) -> str:
    """Return the interval of an index at full scale, in its displayed unit."""
    unit = booklet.units.get(name, "-")
    factor = display_unit(unit)[1] * booklet.scale ** _SHIP_EXPONENTS.get(unit, 0.0)
    return format_interval(entry.interval, factor)


def _vessel_section(
    run: RunFiles, booklet: BookletFile | None, derivatives: DerivativesFile | None
) -> ReportSection:
    """Build the section with main particulars of the vessel and a table of its logs."""
    section = ReportSection("Vessel and tests")
    rows: list[tuple[str, ...]] = []
    scale = booklet.scale if booklet is not None else 1.0
    if derivatives is not None:
        exponents = {"length": 1.0, "beam": 1.0, "draught": 1.0, "mass": 3.0, "speed": 0.5}
        units = {"length": "m", "beam": "m", "draught": "m", "mass": "kg", "speed": "m/s"}
        for name, exponent in exponents.items():
            value = derivatives.particulars.get(name)
            if value is None:
                continue
            ship = format_number(value * scale**exponent, 4)
            rows.append((name, f"{format_number(value, 4)} {units[name]}", f"{ship} {units[name]}"))
        rows.append(
            ("Froude number", format_number(derivatives.froude_number, 3),
             format_number(derivatives.froude_number, 3))
        )  # fmt: skip
    elif booklet is not None:
        rows.append(
            ("length", f"{format_number(booklet.length, 4)} m",
             f"{format_number(booklet.length * scale, 4)} m")
        )  # fmt: skip
    if rows:
        caption = "Main particulars"
        caption += (
            f"; full scale by Froude's law with ratio {format_number(scale)}" if scale != 1 else ""
        )
        section.blocks.append(
            ReportTable(("particular", "tests", "ship"), rows, f"{caption}.", (1.4, 1, 1))
        )
    inputs = ", ".join(run.fit_settings.signals.inputs)
    gear = _describe_gear(run)
    section.blocks.append(
        ReportText(
            [
                f"Inputs of the model: {inputs}."
                + (f" Steering gear in the predicted manoeuvres: {gear}." if gear else "")
            ]
        )
    )
    section.blocks.append(
        ReportTable(
            ("record", "manoeuvre", "used for", "duration", "largest yaw rate"),
            [
                (
                    entry.log,
                    (entry.manoeuvre or "unknown").replace("_", " "),
                    _SPLIT_TITLES.get(entry.split, entry.split),
                    f"{entry.seconds:.0f} s",
                    f"{math.degrees(entry.largest['r']):.2f} deg/s"
                    if "r" in entry.largest
                    else DASH,
                )
                for entry in run.quality
            ],
            "Test records and their use. Records that are held out are part of no fit.",
            (2.0, 1.3, 1.6, 0.8, 1.2),
        )
    )
    return section


def _describe_gear(run: RunFiles) -> str:
    """Return the steering gear of the manoeuvring booklet as text; empty without one."""
    booklet = run.fit_settings.booklet
    parts = []
    for share in booklet.inputs.values() if booklet is not None else ():
        if not share.steer:
            continue
        if isinstance(share.rate, float):
            parts.append(f"rate {math.degrees(share.rate):.3g} deg/s")
        elif share.rate:
            parts.append(f"rate {share.rate}")
        if share.lag:
            parts.append(f"time constant {share.lag:.3g} s")
        if share.delay:
            parts.append(f"dead time {share.delay:.3g} s")
    return ", ".join(parts)


def _derivatives_section(
    run: RunFiles, content: DerivativesFile, figures: Mapping[str, str]
) -> ReportSection:
    """Return the table of derivatives with their intervals."""
    ship = run.read_record(DerivativesFile, "derivatives_ship.json")
    ship_rows = {} if ship is None else {row.name: row for row in ship.rows}
    section = ReportSection("Hydrodynamic derivatives")
    published = content.published or {}
    header = ["derivative", "SI (tests)", "unit", "prime I x 1e5", "95 % interval"]
    weights = [1.0, 1.1, 1.3, 1.1, 1.7]
    if ship_rows:
        header.append("SI (ship)")
        weights.append(1.1)
    if published:
        header.append("Clarke 1983")
        weights.append(1.0)
    rows = [_derivative_cells(row, ship_rows, published) for row in content.rows[:_MAX_DERIVATIVES]]
    caption = (
        f"Derivatives of the {content.quantity}s about straight-ahead motion at the speed of the"
        " tests; Taylor coefficients without factorials. Standard errors follow from the covariance"
        " of the identified parameters by the delta method."
    )
    section.blocks.append(ReportTable(header, rows, caption, weights))
    if len(content.rows) > _MAX_DERIVATIVES:
        section.blocks.append(
            ReportText([f"{len(content.rows) - _MAX_DERIVATIVES} more are in derivatives.json."])
        )
    if "derivatives.svg" in figures:
        section.blocks.append(ReportPicture("derivatives.svg", figures["derivatives.svg"]))
    if content.remarks:
        section.blocks.append(ReportText(content.remarks, is_list=True))
    return section


def _derivative_cells(
    row: DerivativeRow,
    ship_rows: Mapping[str, DerivativeRow],
    published: Mapping[str, float],
) -> list[str]:
    """Return the cells of one derivative: value, prime system, interval, ship, and published.

    Args:
        row: the derivative at the scale of the tests.
        ship_rows: derivatives at full scale by name; empty without scaling.
        published: values by regressions from main particulars, prime I system, by name.
    """
    error = row.prime_i_error
    bounds = (
        None
        if error is None or row.prime_i is None
        else (row.prime_i - 1.96 * error, row.prime_i + 1.96 * error)
    )
    cells = [
        row.name,
        format_number(row.value, 4),
        row.unit,
        DASH if row.prime_i is None else format_number(1e5 * row.prime_i, 4),
        format_interval(bounds, 1e5),
    ]
    if ship_rows:
        ship_row = ship_rows.get(row.name)
        cells.append(DASH if ship_row is None else format_number(ship_row.value, 4))
    if published:
        value = published.get(row.name)
        cells.append(DASH if value is None else format_number(1e5 * value, 4))
    return cells


def _validation_section(
    run: RunFiles, booklet: BookletFile | None, figures: Mapping[str, str]
) -> ReportSection:
    """Return errors of free runs on held-out records, and repeated manoeuvres."""
    section = ReportSection("Validation on held-out manoeuvres")
    split = run.report_split
    protocol = run.main_protocol
    rows = []
    for model in run.model_kinds:
        row = run.find_row(model, split, protocol)
        if row is None:
            continue
        rows.append(
            (
                run.model_label(model),
                f"{row.mean_nrmse:.4f}",
                format_number(row.rmse.get("u"), 3),
                format_number(row.rmse.get("v"), 3),
                format_number(
                    None if row.rmse.get("r") is None else math.degrees(row.rmse["r"]), 3
                ),
                format_number(_find_position_error(run, row), 3),
            )
        )
    section.blocks.append(
        ReportTable(
            (
                "model",
                "NRMSE",
                "u [m/s]",
                "v [m/s]",
                "r [deg/s]",
                f"position {run.horizon_text} [m]",
            ),
            rows,
            f"Root mean square errors of free runs on the {_SPLIT_TITLES.get(split, split)}"
            " records; the model receives the measured inputs and the initial state only.",
            (2.0, 0.9, 1.0, 1.0, 1.0, 1.7),
        )
    )
    for file, width in (
        ("track.svg", 1.0),
        ("booklet_zigzags_1.svg", 1.0),
        ("repeated_indices.svg", 1.0),
    ):
        if file in figures:
            section.blocks.append(ReportPicture(file, figures[file], width))
    if booklet is not None:
        repeated = list(_repeated_rows(booklet))
        if repeated:
            section.blocks.append(
                ReportTable(
                    ("record", "use", "index", "measured", "predicted", "interval"),
                    repeated,
                    "Measured manoeuvres, repeated by the model with the rudder angles and"
                    " reversals of the test, in the scale of the tests.",
                    (1.8, 1.5, 1.5, 1.0, 1.0, 1.4),
                )
            )
    return section


def _repeated_rows(booklet: BookletFile) -> Iterator[tuple[str, ...]]:
    """Yield measured and predicted indices of repeated trials, held-out records first."""
    pages = [page for page in booklet.pages if page.split]
    for page in sorted(pages, key=lambda page: page.split == "train"):
        for name in _COMPARED_INDICES:
            entry = page.indices.get(name)
            if entry is None or entry.measured is None:
                continue
            unit, factor = display_unit(booklet.units.get(name, "-"))
            yield (
                page.name,
                _SPLIT_TITLES.get(page.split, page.split),
                index_title(name),
                f"{format_number(factor * entry.measured, 3)} {unit}",
                f"{format_number(factor * entry.value, 3)} {unit}",
                format_interval(entry.interval, factor),
            )


def _prediction_section(booklet: BookletFile, figures: Mapping[str, str]) -> ReportSection:
    """Return the indices of all standard manoeuvres at full scale."""
    is_scaled = booklet.scale != 1.0
    section = ReportSection("Full-scale predictions" if is_scaled else "Predictions")
    if "booklet_circles.svg" in figures:
        section.blocks.append(ReportPicture("booklet_circles.svg", figures["booklet_circles.svg"]))
    rows = []
    for page in booklet.pages:
        if page.split:
            continue
        is_first = True
        for name in _MAIN_INDICES.get(page.manoeuvre, tuple(page.indices)):
            entry = page.indices.get(name)
            if entry is None:
                continue
            unit, factor = display_unit(booklet.units.get(name, "-"))
            rows.append(
                (
                    _manoeuvre_title(page) if is_first else "",
                    index_title(name),
                    f"{format_number(factor * entry.value, 3)} {unit}".removesuffix(" -"),
                    f"{format_number(factor * entry.ship, 3)} {unit}".removesuffix(" -"),
                    _ship_interval(booklet, name, entry),
                    DASH if entry.lengths is None else f"{entry.lengths:.2f} L",
                )
            )
            is_first = False
    section.blocks.append(
        ReportTable(
            ("manoeuvre", "index", "tests", "ship", "interval (ship)", "lengths"),
            rows,
            f"Predicted indices with {100 * booklet.level:.0f} % intervals from {booklet.draws}"
            " draws of the parameters from their uncertainty after the tests, and from the"
            " deviations of repeated tests.",
            (1.7, 2.0, 1.1, 1.1, 1.5, 0.8),
        )
    )
    if booklet.remarks:
        section.blocks.append(
            ReportText([f"Left out: {remark}." for remark in booklet.remarks], is_list=True)
        )
    return section


def _manoeuvre_title(page: BookletRow) -> str:
    title = page.name.replace("_", " ")
    return f"{title} ({page.faults} draws did not end)" if page.faults else title


def _describe_extrapolation(
    booklet: BookletFile | None, model_settings: ModelSettings
) -> list[str]:
    """Return a sentence on standard manoeuvres whose rudder angle the tests do not contain."""
    signals = model_settings.signals
    rudder = next((name for name in signals.inputs if is_rudder(name)), None)
    if booklet is None or rudder is None:
        return []
    index = len(signals.velocities) + signals.inputs.index(rudder)
    low = model_settings.low[index]
    high = model_settings.high[index]
    # measured angles differ from the ordered ones by noise and offsets
    margin = 0.05 * (high - low)
    beyond = [
        f"{page.name.replace('_', ' ')} ({math.degrees(angle):.3g} deg)"
        for page in booklet.pages
        if not page.split
        and isinstance(angle := page.demand.get("rudder"), int | float)
        and not (
            low - margin <= angle <= high + margin
            and (page.manoeuvre != "zigzag" or low - margin <= -angle <= high + margin)
        )
    ]
    if not beyond:
        return []
    return [
        f"Extrapolated beyond the tested rudder angles ({math.degrees(low):.3g} to"
        f" {math.degrees(high):.3g} deg): {', '.join(beyond)}."
    ]


def _limits_section(
    run: RunFiles, booklet: BookletFile | None, derivatives: DerivativesFile | None
) -> ReportSection:
    """Return the range of the tests, and what the predictions do not contain."""
    section = ReportSection("Limits of validity")
    model = booklet.model if booklet is not None else run.selected
    settings = run.model_settings(model)
    names = [*settings.signals.velocities, *settings.signals.inputs]
    scale = booklet.scale if booklet is not None else 1.0
    rows = []
    for name, low, high in zip(names, settings.low, settings.high, strict=False):
        si = run.si_unit(name)
        unit, factor = display_unit(si)
        ship = scale ** {"1/s": -0.5, **_SHIP_EXPONENTS}.get(si, 0.0)
        row = (
            f"{name} [{unit}]",
            format_interval((low, high), factor),
            format_interval((low, high), factor * ship),
        )
        # without a scale both ranges are the same
        rows.append(row if scale != 1.0 else row[:2])
    if rows:
        section.blocks.append(
            ReportTable(
                ("quantity", "range of the tests", "range at full scale")[: len(rows[0])],
                rows,
                "The model is valid within these ranges; outside, predictions are extrapolations.",
                (1, 1.5, 1.5)[: len(rows[0])],
            )
        )
    statements = [
        "Intervals contain the uncertainty of the identified parameters. They assume that the form"
        " of the model is correct.",
    ]
    if scale != 1.0:
        statements.append(
            "Full-scale values follow Froude's law of similarity. Viscous scale effects on"
            " resistance, propeller and rudder are not part of them unless a factor is stated."
        )
    notes = run.fit_notes(model)
    scaling = None if notes is None else (notes.model_extra or {}).get("scaling")
    effects = scaling.get("effects") if isinstance(scaling, dict) else None
    if isinstance(effects, dict):
        statements.append(
            f"Scale effects: resistance {effects['resistance']:.3g}, propeller"
            f" {effects['propeller']:.3g}, rudder {effects['rudder']:.3g} ({effects['source']})."
        )
    statements += _describe_extrapolation(booklet, settings)
    statements.append("Calm, deep and unrestricted water, and the loading condition of the tests.")
    if derivatives is not None and derivatives.masses == "unknown":
        statements.append(
            "Motion alone determines accelerations: derivatives marked /m are forces divided by"
            " mass and added mass."
        )
    statements += [
        finding.text
        for log, finding in (run.inspection.named_findings if run.inspection is not None else ())
        if finding.level == "will mislead"
    ]
    section.blocks.append(ReportText(statements, is_list=True))
    summary = run.read_record(SummaryFile, "summary.json")
    provenance = run.provenance
    lines = []
    if summary is not None and summary.level:
        lines.append(f"Verdict of the run: {summary.level}. {' '.join(summary.verdict[:2])}")
    lines.append(
        f"Computed by residnet {__version__}"
        + ("" if provenance is None else f" on {provenance.started[:10]}, seed {provenance.seed}")
        + f"; run {run.title}. Inputs and checksums are in provenance.json of the run folder."
    )
    section.blocks.append(ReportText(lines))
    return section
