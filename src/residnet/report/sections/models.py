"""Section on the models: coefficients, equations, training and goodness of fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from residnet.core.errors import ConfigError
from residnet.core.format import (
    DASH,
    format_exponents,
    format_fixed,
    format_integer,
    format_interval,
    format_number,
)
from residnet.core.names import CHANNEL_UNITS
from residnet.evaluation.records import GoodnessFile, GoodnessRow
from residnet.evaluation.verdict import describe_divergence
from residnet.identification.records import (
    CoefficientRow,
    FitNotes,
    Hyperparameter,
    describe_exclusions,
)
from residnet.physics.terms import parse_term
from residnet.report.blocks import Block, Cell, CellMark, Code, Section, Table, Text, build_table
from residnet.report.figure import BLUE, Case, Curve, Figure, GlyphStyle, Panel, style_family
from residnet.report.run_reader import RunFiles
from residnet.report.run_settings import HeadSettings, ModelSettings
from residnet.report.sections.runs import AXES, model_styles, short_label

_EXTRA_UNITS = {"wind_u": "m/s", "wind_v": "m/s", "wind_mag": "m/s"}
"""Units of the factors of terms that are not channels of a log."""
_MAX_LISTED = 8
"""Maximum number of listed names."""
_MAX_PLOTTED_TERMS = 6
"""Maximum number of terms with a curve of their own in a panel, the largest ones; the others are
added to one curve.
"""
_SPLITS = ("train", "validation")
_RING_STYLE = GlyphStyle("", kind="points", size=7, is_hollow=True, z_order=5)
"""Style of the rings that mark the selected point of a curve."""
_MIN_WHITE_NOISE_P = 0.05
"""Smallest p-value at which residuals count as white noise."""


def models_section(run: RunFiles) -> Section | None:
    """Return the section on identified and learned models."""
    candidate_sections = [_baseline_section(run), _head_section(run)]
    candidate_sections += [
        _equation_section(model, notes)
        for model in run.heads
        if (notes := run.fit_notes(model)) is not None and notes.equations
    ]
    present_sections = [section for section in candidate_sections if section is not None]
    return Section("Models", present_sections) if present_sections else None


def _baseline_section(run: RunFiles) -> Section | None:
    """Return the coefficient tables, with the first baseline expanded; None without tables."""
    blocks: list[Block] = [
        Text(
            "Each acceleration (du/dt, dv/dt, dr/dt) is the sum of its terms. A value below twice"
            " its standard error (grey) is not significantly different from 0.",
            is_secondary=True,
        )
    ]
    further_baselines = [model for model, kind in run.model_kinds.items() if kind == "further"]
    for model in (run.baseline or "baseline", *further_baselines):
        notes = run.fit_notes(model)
        if notes is None or not notes.coefficients:
            continue
        baseline_blocks: list[Block] = [_coefficient_table(notes)]
        title = f"Parameters of {model}"
        if notes.refit is not None:
            baseline_blocks.insert(0, Text(_refit_text(model, notes), is_secondary=True))
            title += ", refitted through rollouts"
        blocks += (
            baseline_blocks
            if len(blocks) == 1
            else [Section(title, baseline_blocks, is_folded=True)]
        )
    return Section("Baseline parameters", blocks) if len(blocks) > 1 else None


def _refit_text(model: str, notes: FitNotes) -> str:
    fixed_terms, unidentifiable_terms = (
        ", ".join(f"{term} in d{axis.replace('_dot', '')}/dt" for axis, term in parameters)
        for parameters in (notes.energy_generating_terms, notes.undetermined_parameters)
    )
    text = (
        f"{model}: values and standard errors are those after the refit through rollouts. The"
        " ratios of value to error use the error of the least-squares fit before it."
    )
    if fixed_terms:
        text += f" Omitted, because their sign would add energy: {fixed_terms}."
    if unidentifiable_terms:
        text += (
            f" Not identifiable from these data, held near 0 by the prior: {unidentifiable_terms}."
        )
    return text


def _coefficient_table(notes: FitNotes) -> Table:
    """Return coefficients with their standard errors, to two digits of these, and units."""

    def format_value(row: CoefficientRow) -> str:
        error = row.standard_error
        decimals = max(1 - math.floor(math.log10(error)), 0) if error > 0 else 7
        # an exact coefficient has no standard error that determines its digits
        return format_fixed(row.value, decimals) if decimals <= 6 else format_number(row.value, 4)

    def t_statistic_cell(row: CoefficientRow) -> Cell:
        value = abs(row.value)
        error = row.standard_error
        if error <= 1e-9 * value:
            return Cell("exact")
        return Cell(format_number(value / error, 2), mark="weak" if value < 2 * error else "")

    return build_table(
        notes.coefficients,
        [
            ("term", lambda row: f"d{row.axis.replace('_dot', '')}/dt: {row.term}"),
            ("value", format_value, str),
            ("standard error", lambda row: format_number(row.standard_error, 2), str),
            ("value / error", t_statistic_cell),
            ("unit", lambda row: term_unit(row.axis, row.term), str),
        ],
    )


def term_unit(axis: str, term: str) -> str:
    """Return the unit of a coefficient: the unit of the acceleration divided by the unit of its
    term.

    Empty if the unit of a factor is unknown.
    """
    units = CHANNEL_UNITS | _EXTRA_UNITS
    try:
        factors = parse_term(term, [name for name in units if name != "t"], functions=False)
    except ConfigError:
        return ""
    exponents: dict[str, int] = {}
    for unit, sign in [
        (units.get(axis, "-"), 1),
        *((units[factor.name], -factor.power) for factor in factors),
    ]:
        for index, unit_part in enumerate(unit.split("/")):
            for factor_text in unit_part.split():
                name, _, exponent = factor_text.partition("^")
                if name not in ("1", "-"):
                    power = (sign if index == 0 else -sign) * int(exponent or 1)
                    exponents[name] = exponents.get(name, 0) + power
    numerator, denominator = (
        "·".join(
            format_exponents(f"{n}^{s * p}".removesuffix("^1"))
            for n, p in exponents.items()
            if s * p > 0
        )
        for s in (1, -1)
    )
    if not denominator:
        return numerator or "-"
    return (
        f"{numerator or '1'}/({denominator})"
        if "·" in denominator
        else f"{numerator or '1'}/{denominator}"
    )


def _head_section(run: RunFiles) -> Section | None:
    """Return the table of learned heads: kind, complexity, parameters, time and selection error.

    None if the folder holds no notes on any fit.
    """
    notes_by_model = {model: run.fit_notes(model) for model in run.heads}
    if not any(notes_by_model.values()):
        return None
    # a model without a file has empty notes
    notes_or_defaults = {model: notes or FitNotes() for model, notes in notes_by_model.items()}

    def parameter_count(model: str) -> str:
        notes = notes_or_defaults[model]
        n_parameters = notes.parameters
        if not n_parameters and isinstance(notes.n_terms, float):
            # closed forms have a coefficient for each term and an offset, on each of three axes
            n_parameters = 3 * (notes.n_terms + 1)
        return format_integer(n_parameters) if n_parameters else DASH

    def error_cell(model: str) -> Cell:
        row = run.find_row(model, "validation", run.selection_protocol)
        value = notes_or_defaults[model].validation_error if row is None else row.mean_nrmse
        has_diverged = row is not None and row.diverged > 0
        note = describe_divergence(row) if row else ""
        mark: CellMark = "best" if model == run.selected else "bad" if has_diverged else ""
        return Cell(format_number(value), note, mark)

    def head_kind(model: str) -> str:
        settings = run.model_settings(model)
        head_name = "" if settings.head is None else settings.head.kind
        return head_name or settings.role or DASH

    def epochs_text(model: str) -> str:
        epochs = notes_or_defaults[model].epochs
        return DASH if epochs is None else str(epochs)

    table = build_table(
        run.heads,
        [
            ("head", run.model_label),
            ("kind", head_kind, str),
            (
                "complexity",
                lambda model: _complexity_text(run.model_settings(model), notes_or_defaults[model]),
            ),
            ("parameters", parameter_count, str),
            (
                "inputs; baseline below",
                lambda model: _inputs_text(run.model_settings(model), notes_or_defaults[model]),
            ),
            ("fit [s]", lambda model: format_number(notes_or_defaults[model].seconds, 2), str),
            ("epochs", epochs_text, str),
            ("validation NRMSE [-]", error_cell),
        ],
        is_selected=lambda model: model == run.selected,
    )
    introduction = (
        "A head adds its residual to the accelerations of a baseline. Further baselines and"
        " ensembles have no baseline."
    )
    remarks = [
        f"{run.model_label(model)}: {sentence}."
        for model, notes in notes_or_defaults.items()
        for sentence in describe_excluded_members(notes)
    ]
    return Section(
        "Residual heads and further models",
        [Text(introduction, is_secondary=True), table, *([Text(remarks)] if remarks else [])],
    )


def describe_excluded_members(notes: FitNotes) -> list[str]:
    """Return sentences on models that an ensemble does not use, or not for all velocities."""
    sentences = describe_exclusions(notes.exclusions)
    evidence_names = {row.member for row in notes.exclusions}
    sentences += [
        f"{member} is not a member: it diverged on validation logs"
        for member in notes.excluded_members
        if member not in evidence_names
    ]
    return sentences


def _inputs_text(settings: ModelSettings, notes: FitNotes) -> str:
    """Return the inputs and the baseline of a head, or the members of an ensemble."""
    if notes.members:
        texts = []
        for name in notes.members:
            velocities = [row.velocity for row in notes.exclusions if row.member == name]
            texts.append(f"{name} (not for {', '.join(velocities)})" if velocities else name)
        return "mean of " + ", ".join(texts)
    if settings.head is None:
        return "refitted through rollouts" if notes.refit is not None else "least squares"
    inputs = ", ".join(settings.head.features or ()) or "all channels"
    return inputs if notes.baseline == "baseline" else f"{inputs}; {notes.baseline}"


def _complexity_text(settings: ModelSettings, notes: FitNotes) -> str:
    """Return the selected settings of a head and the size of its network."""
    head = settings.head or HeadSettings()
    formats: dict[str, Hyperparameter | None] = {
        "{} basis functions": notes.n_terms,
        "order {} (latent variables)": notes.order,
        "penalty {}": notes.penalty,
        "layers of {}": head.hidden,
        "{} hidden units": head.hidden_size,
    }
    texts = []
    for text_format, value in formats.items():
        if value is not None:
            values = value if isinstance(value, tuple) else (value,)
            numbers = [text if isinstance(text, str) else f"{text:g}" for text in values]
            texts.append(text_format.format(", ".join(numbers)))
    return ("; ".join(texts) or DASH) + (" for each axis" if head.per_axis else "")


def _equation_section(model: str, notes: FitNotes) -> Section:
    """Return the equations of a model with their uncertainty and non-identifiable terms."""
    introduction = "SI units. The head adds these accelerations to its baseline."
    if notes.delay is not None:
        introduction += f" Delayed inputs act {notes.delay.seconds:g} s after they are given."
    return Section(
        f"Equations of {model}",
        [
            Text(introduction, is_secondary=True),
            Code(
                "\n".join(equation.text for equation in notes.equations.values()),
                wraps_lines=True,
            ),
            _coefficient_table(notes),
            Text(equation_remarks(notes), is_secondary=True),
        ],
    )


def equation_remarks(notes: FitNotes) -> list[str]:
    """Return sentences on non-identifiable combinations of terms."""
    sentences = []
    equal_terms: dict[str, dict[str, float]] = {}
    for name, equation in notes.equations.items():
        equal_terms |= equation.linear_dependencies
        sentences.append(
            f"{name}: {equation.candidates} candidate terms are linearly independent on these"
            f" data (condition number {equation.condition:.1e}). The RMS residual is"
            f" {100 * equation.error_share:.2g} % of the RMS of the target."
        )
        for term, alternatives in equation.indistinguishable_terms.items():
            sentences.append(
                f"{name}: {term} is not distinguishable on these data from"
                f" {_join_truncated(alternatives)}."
            )
        if equation.max_omitted_share:
            terms = [
                f"{term} ({100 * share:.0f} %)"
                for term, share in equation.max_omitted_share.items()
            ]
            sentences.append(
                f"{name}: these terms were not selected, but their share of the target may be up to"
                f" the stated one (two standard errors): {_join_truncated(terms)}."
            )
        for channels, share in equation.lack_of_fit.items():
            sentences.append(
                f"{name}: no candidate explains {100 * share:.0f} % of the mean square of the"
                f" residual, which functions of {channels} predict in cross-validation. Add terms"
                " of these channels to `candidates: {extra: [...]}` of the head."
            )
    if notes.unexcited:
        sentences.append(
            "These terms are 0 in all samples, so that their coefficients are not identifiable:"
            f" {_join_truncated(notes.unexcited)}."
        )
    if equal_terms:
        texts = [
            f"{term} = "
            + " + ".join(
                f"{value:.4g} ({simpler_term})" for simpler_term, value in combination.items()
            )
            for term, combination in equal_terms.items()
        ]
        sentences.append(
            "These terms are linear combinations of simpler ones on these data and were replaced by"
            " them:"
            f" {_join_truncated(texts)}."
        )
    return sentences


def _join_truncated(names: Sequence[str]) -> str:
    remainder = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return ", ".join(names[:_MAX_LISTED]) + remainder


def term_figures(run: RunFiles) -> Iterator[Figure]:
    """Draw the equation of every model along a log, term by term (Halvorsen 2019, 6.4.2)."""
    frame = run.read_parquet("terms.parquet")
    if frame is None:
        return
    for model, rows in frame.groupby("model", sort=False):
        panel_curves: list[dict[str, Curve]] = []
        axes = [axis for axis in AXES if (rows["axis"] == axis).any()]
        for axis in axes:
            axis_rows = rows[rows["axis"] == axis]
            terms_over_time = axis_rows.pivot_table(
                index="t", columns="term", values="value", sort=False
            )
            terms_over_time *= AXES[axis][2]
            time = terms_over_time.index.to_numpy()
            target = terms_over_time.pop("target")
            order = (terms_over_time**2).mean().sort_values(ascending=False, kind="stable").index
            curves_by_name = {"target": target} | {
                str(term): terms_over_time[term] for term in order[:_MAX_PLOTTED_TERMS]
            }
            if len(order) > _MAX_PLOTTED_TERMS:
                curves_by_name["smaller terms"] = terms_over_time[order[_MAX_PLOTTED_TERMS:]].sum(
                    axis=1
                )
            curves_by_name["sum"] = terms_over_time.sum(axis=1)
            panel_curves.append(
                {
                    name: (time, curve_values.to_numpy())
                    for name, curve_values in curves_by_name.items()
                }
            )
        names = {name for panel in panel_curves for name in panel} - {
            "target",
            "smaller terms",
            "sum",
        }
        styles = {
            "target": GlyphStyle("target", "#BFBFBF", width=2.2),
            **style_family(sorted(names), width=1.0),
            "smaller terms": GlyphStyle("sum of smaller terms", "#7F7F7F", "dotted", 1.0),
            "sum": GlyphStyle("sum", width=0.8, z_order=4),
        }
        styles = {
            name: replace(style, label=format_exponents(style.label))
            for name, style in styles.items()
        }
        yield Figure(
            f"terms_{model}",
            f"Equation of {model}, term by term",
            f"Contribution of each term to the acceleration along {rows['log'].iloc[0]}, their sum"
            " (black) and the target (grey), which is the residual of the baseline. Two large terms"
            " that cancel each other are hardly distinguishable on these data. A term without"
            " variation is not needed.",
            styles,
            [
                Panel(
                    "{} [{}]".format(*AXES[axis]),
                    "time [s]" if axis == axes[-1] else "",
                    height=230,
                )
                for axis in axes
            ],
            [Case("", panel_curves)],
        )


def evolution_figures(run: RunFiles) -> Iterator[Figure]:
    """Draw the smallest error of each generation of genetic programming.

    Source: Halvorsen 2019, Figures 6.2 and 6.3.
    """
    for model in run.heads:
        notes = run.fit_notes(model)
        equations = {} if notes is None else notes.equations
        panel_curves: list[dict[str, Curve]] = []
        panels: list[Panel] = []
        for axis, equation in equations.items():
            if not equation.history:
                continue
            generations = np.arange(len(equation.history))
            validation = np.array([row.validation_error for row in equation.history])
            selected_generation = [equation.generation]
            panel_curves.append(
                {
                    "train": (
                        generations,
                        np.array([row.training_error for row in equation.history]),
                    ),
                    "validation": (generations, validation),
                    "kept": (generations[selected_generation], validation[selected_generation]),
                }
            )
            label = "" if panels else "share of the mean square [-]"
            panels.append(
                Panel(label, "generation", AXES[axis][0], height=230, y_log=True, group=axis)
            )
        if panels:
            yield Figure(
                f"breeding_{model}",
                f"Search of {model}, generation by generation",
                "Mean square error of the best individual over the target's mean square, on"
                " training and validation samples. A ring marks the selected generation, with the"
                " smallest validation error. If a curve still decreases at its end, more"
                " generations can reduce the error.",
                style_family(_SPLITS) | {"kept": replace(_RING_STYLE, label="selected")},
                panels,
                [Case("", panel_curves)],
                columns=len(panels),
            )


def learning_figure(run: RunFiles) -> Figure | None:
    """Draw loss and free-run error on validation data by epoch, a case for each trained head."""
    head_cases = []
    reference = run.find_row(run.baseline, "validation", run.selection_protocol)
    for model in run.heads:
        notes = run.fit_notes(model)
        if notes is None or not notes.training_history:
            continue
        points = [
            (row.epoch + 1, row.stage, row.loss, row.validation_error)
            for row in notes.training_history
        ]
        # a missing number becomes NaN, which is not drawn
        epoch, stage, loss, validation = np.array(points, dtype=float).T
        # each stage has a different loss
        stage_starts = np.flatnonzero(np.diff(stage)) + 1
        loss_curves: dict[str, Curve] = {
            "loss": (np.insert(epoch, stage_starts, np.nan), np.insert(loss, stage_starts, np.nan))
        }
        has_validation = np.isfinite(validation)
        error_curves: dict[str, Curve] = {
            "validation": (epoch[has_validation], validation[has_validation])
        }
        if reference is not None:
            error_curves["baseline"] = (epoch[:1], np.array([reference.mean_nrmse]))
        if has_validation.any():
            best_index = [int(np.nanargmin(validation))]
            error_curves["best"] = (epoch[best_index], validation[best_index])
        if len(stage_starts):
            loss_curves["stage"] = error_curves["stage"] = (
                epoch[stage_starts] - 0.5,
                np.zeros(len(stage_starts)),
            )
        # runs of earlier versions have the settings in their config only
        settings = run.fit_settings.training.get(model)
        horizons: list[float] = []
        if notes.training is not None:
            horizons = [stage.horizon for stage in notes.training.simulation_stages]
        elif settings is not None:
            horizons = [stage.horizon for stage in settings.multi_step]
        stage_labels = {0: "one-step"} | {
            k + 1: f"{horizon:g} s" for k, horizon in enumerate(horizons)
        }
        texts = [
            (
                0,
                float(epoch[stage == k].mean()),
                math.nan,
                stage_labels.get(int(k), f"stage {k:.0f}"),
            )
            for k in np.unique(stage)
        ]
        head_cases.append(Case(short_label(run, model), [loss_curves, error_curves], texts=texts))
    if not head_cases:
        return None
    baseline = model_styles(run)[run.baseline] if run.baseline else GlyphStyle("")
    return Figure(
        "learning",
        "Learning curves",
        "Each stage (one-step, then free runs of the stated length) has a different loss, so that"
        " losses are comparable within a stage only. The lower panels show the validation error;"
        " the weights of the circled epoch are used. If a curve still falls at its end, more epochs"
        " reduce the error.",
        {
            "loss": GlyphStyle("training loss", BLUE),
            "validation": GlyphStyle("validation", BLUE),
            "baseline": replace(baseline, kind="hline"),
            "best": replace(_RING_STYLE, label="best epoch"),
            "stage": GlyphStyle("next stage", "#7F7F7F", width=0.8, kind="vline", z_order=1),
        },
        [
            Panel("training loss [-]", height=200, y_log=True),
            Panel("free-run error on\nvalidation, NRMSE [-]", "epoch", height=200),
        ],
        head_cases,
        "Head",
    )


def goodness_section(run: RunFiles) -> Section | None:
    """Return the section on goodness of fit; None if the run has no goodness.json.

    It uses the split of the report, or another split if that has no samples.
    """
    goodness = run.read_record(GoodnessFile, "goodness.json")
    splits = {} if goodness is None else goodness.splits
    split = next((name for name in (run.report_split, *splits) if splits.get(name)), "")
    axis_sections: list[Block] = []
    for axis, (title, *_) in AXES.items():
        axis_rows = [row for row in splits.get(split, ()) if row.axis == axis]
        if axis_rows:
            name = axis.removesuffix("_dot")
            unit, factor = run.display_unit(name)
            unit = f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
            axis_sections.append(
                Section(
                    f"{title} d{name}/dt [{unit}], {split} data",
                    [
                        *_goodness_tables(axis_rows, factor),
                        Text(" ".join(_goodness_sentences(axis_rows))),
                    ],
                    is_folded=bool(axis_sections),
                )
            )
    if not axis_sections:
        return None
    introduction = (
        "These are one-step residuals: measured minus predicted acceleration at the measured"
        " states. A model with small residuals may still have a large free-run error, and vice"
        " versa."
    )
    explanations = [
        "C_p, AIC and BIC use the noise variance of the model with the least residual. The"
        " parameters of a kernel model are the trace of its smoother, those of a network"
        " all its weights.",
        "95 %, blocks: moving-block bootstrap with a block length chosen from the data. 95"
        " %, independent: Student's t for independent samples, far too narrow for"
        " correlated residuals. White: test of Ljung and Box, which counts every sample.",
        "Difference: of the mean |residual| from that of the named model at the same"
        " samples, with its interval by blocks. Negative is better; a bold one excludes"
        " zero.",
    ]
    return Section(
        "Goodness of fit",
        [Text(introduction), *axis_sections, Text(explanations, is_secondary=True)],
    )


def _goodness_tables(rows: Sequence[GoodnessRow], factor: float) -> list[Table]:
    """Return tables of the goodness of fit on one axis, and of statistics of the residuals."""

    def whiteness_cell(row: GoodnessRow) -> Cell:
        p = row.white_p
        return Cell(
            "< 0.001" if p < 1e-3 else format_number(p, 2),
            mark="" if p > _MIN_WHITE_NOISE_P else "weak",
        )

    def difference_cell(row: GoodnessRow) -> Cell:
        paired = row.difference
        if paired is None:
            return Cell(DASH)
        text = f"{format_number(factor * paired.mae)} ({format_interval(paired.ci95, factor)})"
        return Cell(text, f"to {paired.to}", "best" if paired.excludes_zero else "")

    return [
        build_table(
            rows,
            [
                ("model", lambda row: row.model),
                ("parameters", lambda row: row.parameters, format_number),
                ("RMSE", lambda row: row.rmse, format_number, factor),
                ("R²", lambda row: row.r2, format_number),
                ("adjusted R²", lambda row: row.r2_adjusted, format_number),
                ("C_p", lambda row: row.cp, format_number, factor**2),
                ("AIC", lambda row: format_number(row.aic, 4), str),
                ("BIC", lambda row: format_number(row.bic, 4), str),
            ],
        ),
        build_table(
            rows,
            [
                ("model", lambda row: row.model),
                ("mean |residual|", lambda row: row.mae, format_number, factor),
                ("95 %, blocks", lambda row: format_interval(row.mae_ci95, factor), str),
                (
                    "95 %, independent",
                    lambda row: Cell(
                        format_interval(row.mae_ci95_independent, factor), mark="weak"
                    ),
                ),
                ("block [s]", lambda row: format_number(row.block_seconds, 2), str),
                (
                    "independent samples",
                    lambda row: f"{row.effective:.0f} of {row.samples}",
                    str,
                ),
                ("correlation at lag 1", lambda row: format_number(row.autocorrelation[0]), str),
                ("white, p", whiteness_cell),
                ("difference", difference_cell),
            ],
        ),
    ]


def _goodness_sentences(rows: Sequence[GoodnessRow]) -> list[str]:
    """Return the correction of confidence intervals for autocorrelation and the whiteness of
    residuals.
    """
    width_ratios = [
        np.ptp(row.mae_ci95) / np.ptp(row.mae_ci95_independent)
        for row in rows
        if row.mae_ci95 and row.mae_ci95_independent and np.ptp(row.mae_ci95_independent) > 0
    ]
    sentences = []
    if width_ratios:
        sentences.append(
            "The interval that takes the samples for independent is"
            f" {min(width_ratios):.1f} to {max(width_ratios):.1f} times too narrow."
        )
    white_models = [row.model for row in rows if row.white_p > _MIN_WHITE_NOISE_P]
    sentences.append(
        f"The residuals of {', '.join(white_models)} pass for white noise."
        if white_models
        else "No model leaves white residuals."
    )
    return sentences
