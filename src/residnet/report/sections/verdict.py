"""The verdict on a fit, and what a reader must know before using its selected model."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.format import (
    DASH,
    channel_title,
    format_count,
    format_minus_signs,
    format_number,
    format_percent_change,
)
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.evaluation.soundness import CHECKS, SanityFinding
from residnet.evaluation.verdict import UNSEEN_SPLITS, VerdictEvidence, describe_divergence
from residnet.evaluation.verdict import rate_model as judged_level
from residnet.evaluation.verdict import write_verdict as judged
from residnet.quality import summarize_inspection
from residnet.report.blocks import Bullets, Cell, Facts, Section, Text, build_table
from residnet.report.figure import Figure
from residnet.report.run_reader import JsonObject, RunFiles
from residnet.report.sections.free_runs import distinct_manoeuvres


def verdict_sentences(run: RunFiles) -> list[str]:
    """Return how good the selected model is, sentence by sentence.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    main_model = run.main_model
    if run.find_row(main_model, run.report_split, run.protocols[0]) is None:
        return [
            f"The run holds no free runs of its selected model on {run.report_split} data; see"
            f" the tables."
        ]
    return judged(collect_evidence(run, main_model))


_MEASUREMENT_ROW = "measurements"
"""Row of the position error that remains when the measured velocities are integrated."""
_NO_POSE_TEXT = (
    "The logs hold no {}: judge the model by its velocities, for errors of position and heading are"
    " those of integrated velocities."
)


def collect_evidence(run: RunFiles, selected: str) -> VerdictEvidence:
    """Read the evidence for the verdict on the selected model from the run folder."""
    protocol = run.protocols[0]
    split = run.report_split
    rows = {
        model: row for model in run.model_kinds if (row := run.find_row(model, split, protocol))
    }
    quality_report = run.read_json("doctor.json")
    quality_summary = (
        summarize_inspection(quality_report).tally if quality_report.get("logs") else ""
    )
    dof_text = run.dof.description
    if integrated_channels := next(
        (log["integrated"] for log in run.quality if log.get("integrated")), None
    ):
        quality_summary = (
            f"{_NO_POSE_TEXT.format(', '.join(integrated_channels))} {quality_summary}".strip()
            if not dof_text
            else quality_summary
        )
        dof_text += (
            "; no heading was measured"
            if dof_text and run.dof.has_heading and "psi" in integrated_channels
            else ""
        )
    quality_summary = (
        f"{dof_text[0].upper()}{dof_text[1:]}. {quality_summary}".strip()
        if dof_text
        else quality_summary
    )
    one_sided_findings = (
        finding for finding in quality_report.get("together") or [] if finding["code"] == "one_side"
    )
    return VerdictEvidence(
        selected,
        split,
        rows,
        run.baseline or "",
        run.read_json("selection.json"),
        (run.limits.get("splits") or {}).get(split, {}),
        quality_summary,
        protocol,
        next((finding["text"] for finding in one_sided_findings if finding["level"] != "note"), ""),
        run.read_json("excitation.json"),
    )


def verdict_level(run: RunFiles) -> str:
    """Return the level of the verdict on the selected model, empty where it has no free runs."""
    return judged_level(collect_evidence(run, run.main_model))


def opening_section(run: RunFiles, figures: Sequence[Figure]) -> Section | None:
    """Return the first screen below the verdict: the median free run and the errors of the models.

    Row order: predictor, selected model, baseline, constant velocity, noise floor of the
    measurements, then the other models by increasing error. None if there is no free run.
    """
    rows = {
        model_name: row
        for model_name in run.model_kinds
        if (row := run.find_row(model_name, run.report_split, run.main_protocol))
    }
    if run.main_model not in rows or not run.pose_errors:
        return None
    selection_by_model = {
        entry["model"]: entry for entry in run.read_json("selection.json").get("models") or []
    }
    limits = (run.limits.get("splits") or {}).get(run.report_split, {}).get(run.main_protocol, {})
    leading_models = [run.main_model, run.selected, run.baseline, CONSTANT_VELOCITY]
    table: list[JsonObject] = [
        rows[model_name] for model_name in dict.fromkeys(leading_models) if model_name in rows
    ]
    kinematic_floor = limits.get("kinematics") or {}
    end_errors = {
        f"{pose_error}_error_end": kinematic_floor[f"{pose_error}_mean"]
        for pose_error in run.pose_errors
        if kinematic_floor
    }
    # a pose that was integrated from the velocities has no floor but rounding
    if measured := any(end_error > 1e-9 for end_error in end_errors.values()):
        table.append({"model": _MEASUREMENT_ROW, "diverged": 0, **end_errors})
    table += sorted(
        (row for model_name, row in rows.items() if model_name not in leading_models),
        key=lambda row: float(row[f"{run.pose_errors[0]}_error_end"]),
    )

    def error_cell(row: JsonObject, key: str, factor: float) -> Cell:
        confidence_interval = row.get(f"{key}_ci95")
        minimum = min(rows[name][key] for name in rows if name != run.plant)
        note = (
            "–".join(format_number(factor * bound, 2) for bound in confidence_interval)
            if confidence_interval
            else ""
        )
        return Cell(
            format_number(factor * row[key], 2), note, "best" if row[key] == minimum else ""
        )

    def fault_text(row: JsonObject) -> str:
        return next(iter((selection_by_model.get(row["model"]) or {}).get("faults") or []), "")

    def soundness_cell(row: JsonObject) -> Cell:
        if fault_text(row) or describe_divergence(row):
            return Cell("✗", describe_divergence(row), "text")
        return Cell("✓" if row["model"] in selection_by_model else DASH, mark="text")

    is_other_protocol = run.main_protocol != run.protocols[0]
    notes = [
        f"Mean of {format_count(rows[run.main_model]['windows'], 'free run')} on"
        f" {run.report_split} data"
        f" ({run.main_protocol}"
        + f", which start elsewhere than those of {run.protocols[0]} above" * is_other_protocol
        + ")"
        + (
            "; small: 95 % interval of this mean (above: of as many new runs)."
            if rows[run.main_model].get(f"{run.pose_errors[0]}_error_end_ci95")
            else "."
        ),
        "" if run.report_split in UNSEEN_SPLITS else "These data are not unseen: read with care.",
        "constant_velocity: the initial velocities are held." if CONSTANT_VELOCITY in rows else "",
        "Measurements: where the measured velocities themselves lead." if measured else "",
        *(
            f"✗ {run.model_label(row['model'])}: {reason}."
            for row in table
            if (reason := fault_text(row))
        ),
    ]
    error_table = build_table(
        table,
        [
            (
                "model",
                lambda row: (
                    _MEASUREMENT_ROW
                    if row["model"] == _MEASUREMENT_ROW
                    else run.model_label(row["model"])
                ),
            ),
            *(
                (
                    f"{name} [{unit}]",
                    lambda row, of=pose_error, f=f: error_cell(row, f"{of}_error_end", f),
                )
                for pose_error, (name, unit, f) in (
                    (pose_error, run.pose_error_unit(pose_error)) for pose_error in run.pose_errors
                )
            ),
            ("sound", soundness_cell),
        ],
        groups=[(f"error {run.horizon_text}", len(run.pose_errors))],
        is_selected=lambda row: row["model"] == run.main_model,
    )
    return Section(
        "", [*figures, error_table, Text(" ".join(filter(None, notes)), is_secondary=True)]
    )


def cautions_section(run: RunFiles, findings: Sequence[SanityFinding]) -> Section | None:
    """Return the objections to using the main model; None if there are none."""
    sentences = []
    main_model = run.predictor
    for protocol in run.protocols:
        row = run.find_row(main_model, run.report_split, protocol)
        baseline_row = run.find_row(run.baseline, run.report_split, protocol)
        training_row = run.find_row(main_model, "train", protocol)
        if row is None:
            continue
        worse_channels = [
            channel_title(c)
            for c in run.channels
            if baseline_row is not None
            and main_model != run.baseline
            and row["rmse"][c] > 1.005 * baseline_row["rmse"][c]
        ]
        if worse_channels:
            sentences.append(
                f"Protocol {protocol}: {main_model} is worse than the baseline in"
                f" {', '.join(worse_channels)}."
            )
        if (
            training_row is not None
            and training_row is not row
            and row["nrmse"]["mean"] > 1.5 * training_row["nrmse"]["mean"]
        ):
            ratio_text = (
                f"{row['nrmse']['mean'] / training_row['nrmse']['mean']:.1f} times its"
                f" training error"
            )
            sentences.append(
                f"Protocol {protocol}: the {run.report_split} error of {main_model} is"
                f" {ratio_text}; it may be"
                f" overfitted, or the {run.report_split} data differ."
            )
    sentences += [
        text
        for text in (worse_than_reference_sentence(run, protocol) for protocol in run.protocols)
        if text
    ]
    # the first sentence; the figures stand in the section on sanity
    failed_findings = [
        finding for finding in findings if finding.ok is False and finding.model == main_model
    ]
    sentences += [
        f"{finding.model}, {finding.check}: {finding.text.partition('. ')[0].rstrip('.')}."
        for finding in failed_findings
    ]
    blocks = [Bullets([format_minus_signs(text) for text in sentences], is_warning=True)]
    return Section("Before you use it", blocks) if sentences else None


def worse_than_reference_sentence(run: RunFiles, protocol: str) -> str:
    """Return which heads and ensembles are worse than their reference by more than 5 %, and where.

    The sentence names the kinds of manoeuvre; it is empty where no model is worse.
    """
    model_texts = []
    for model in run.heads:
        rows = [
            row
            for manoeuvre_kind in distinct_manoeuvres(run, run.report_split, protocol)
            if (row := run.find_row(model, run.report_split, protocol, manoeuvre_kind))
        ]
        worse_rows = [
            row
            for row in rows
            if (row.get("difference") or {}).get("worse")
            and run.model_kinds[model] in ("head", "ensemble")
        ]
        if worse_rows:
            kinds_text = ", ".join(
                f"{row['manoeuvre'].replace('_', ' ')}"
                f" {format_percent_change(100 * (row['difference']['ratio'] - 1))}"
                for row in worse_rows
            )
            model_texts.append(
                f"{model} against {worse_rows[0]['difference']['to']} ({kinds_text})"
            )
    return (
        f"Protocol {protocol}: worse by more than 5 % in NRMSE on {run.report_split} data:"
        f" {'; '.join(model_texts)}."
        if model_texts
        else ""
    )


def sanity_section(run: RunFiles, findings: Sequence[SanityFinding]) -> Section | None:
    """Return a table of all checks and what each found, None where no model was checked."""
    if not findings:
        return None
    findings_by_model: dict[str, dict[str, SanityFinding]] = {}
    for finding in findings:
        findings_by_model.setdefault(finding.model, {})[finding.check] = finding
    result_cells = {
        None: Cell("n/a", mark="weak"),
        True: Cell("✓ ok"),
        False: Cell("✗ look", mark="bad"),
    }
    table = build_table(
        findings_by_model,
        [
            ("model", str),
            *(
                (check, lambda model, check=check: result_cells[findings_by_model[model][check].ok])
                for check in CHECKS
            ),
        ],
        is_selected=lambda model: model == run.selected,
    )
    details = [
        Section(
            run.model_label(model),
            [
                Facts(
                    [
                        (check, format_minus_signs(finding.text))
                        for check, finding in model_findings.items()
                    ],
                    failed=[
                        check for check, finding in model_findings.items() if finding.ok is False
                    ],
                )
            ],
            is_folded=model != run.selected,
        )
        for model, model_findings in findings_by_model.items()
    ]
    return Section("Physical sanity", [table, *details])
