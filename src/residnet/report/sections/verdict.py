"""The verdict on a fit, and what a reader must know before using its selected model."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.data.doctor import summary
from residnet.judge.soundness import CHECKS, Finding
from residnet.judge.verdict import UNSEEN, Evidence
from residnet.judge.verdict import verdict as judged
from residnet.report.blocks import Bullets, Cell, Facts, Section, table_of
from residnet.report.format import DEG, minus, number, percent, title_of
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.free_runs import distinct


def verdict(run: RunFiles) -> list[str]:
    """Return how good the selected model is, sentence by sentence.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    lead = run.lead
    if run.row(lead, run.focus, run.protocols[0]) is None:
        return [
            f"The run holds no free runs of its selected model on {run.focus} data; see the tables."
        ]
    return judged(evidence(run, lead))


def figures_of_lead(run: RunFiles) -> Section | None:
    """Return the figures behind the verdict in words, None where the model has no free runs.

    The model is compared with the baseline and, where the logs are simulated, with the plant.
    """
    protocol, split, lead = run.protocols[0], run.focus, run.lead
    row = run.row(lead, split, protocol)
    if row is None:
        return None
    base = run.row(run.baseline, split, protocol)
    out = [_seen(run, lead, row), _level(run, lead, row, base)]
    truth = run.row(run.truth, split, protocol)
    if truth is not None and run.truth != lead:
        out.append(_against_plant(run, row, truth, base))
    out += [_end(run, row, base, lead), _divergence(run, split)]
    return Section(f"Figures of {lead}", [Bullets([minus(text) for text in out if text])])


_NO_PLACE = (
    "The logs hold no {}: judge the model by its velocities, for errors of position and heading are"
    " those of integrated velocities."
)


def evidence(run: RunFiles, selected: str) -> Evidence:
    """Return what the folder holds that a verdict on its selected model is passed on."""
    protocol, split = run.protocols[0], run.focus
    rows = {model: row for model in run.kinds if (row := run.row(model, split, protocol))}
    inspection = run.json("doctor.json")
    doctor = summary(inspection).tally if inspection.get("logs") else ""
    if made := next((log["integrated"] for log in run.quality if log.get("integrated")), None):
        doctor = f"{_NO_PLACE.format(', '.join(made))} {doctor}".strip()
    return Evidence(
        selected,
        split,
        rows,
        run.baseline or "",
        run.json("selection.json"),
        (run.limits.get("splits") or {}).get(split, {}).get(protocol, {}),
        doctor,
    )


def _seen(run: RunFiles, lead: str, row: Content) -> str:
    protocol, split = str(row["protocol"]), str(row["split"])
    unseen = (
        "that no fit has seen"
        if split in UNSEEN
        else f"of the {split} data (not unseen: read with care)"
    )
    why = "chosen on validation data" if run.selected else "the first head; nothing was selected"
    kind = ((run.evaluation.get("protocols") or {}).get(protocol) or {}).get("kind")
    runs = {"manoeuvre": "whole manoeuvre", "windows": "window"}.get(str(kind), "run") + (
        "" if row["windows"] == 1 else "s"
    )
    return (
        f"Model {lead} ({why}) was free-run over {row['windows']} {runs} {unseen} (protocol"
        f" {protocol})."
    )


def _level(run: RunFiles, lead: str, row: Content, base: Content | None) -> str:
    parts = []
    for channel in run.channels:
        unit, factor = run.unit(channel)
        text = f"{title_of(channel)} {number(factor * row['rmse'][channel])} {unit}"
        interval = (row.get("rmse_ci95") or {}).get(channel)
        if interval:
            text += f" ({number(factor * interval[0])} to {number(factor * interval[1])})"
        if base is not None and lead != run.baseline and base["rmse"][channel] > 0:
            cut = 100 * (1 - row["rmse"][channel] / base["rmse"][channel])
            text += f", {abs(cut):.0f} % {'below' if cut >= 0 else 'ABOVE'} the baseline"
        parts.append(text)
    return (
        "Root mean square"
        f" errors{' (95 % interval of the mean)' if row.get('nrmse_mean_ci95') else ''}: "
        + "; ".join(parts)
        + "."
    )


def _against_plant(run: RunFiles, row: Content, truth: Content, base: Content | None) -> str:
    parts = []
    for channel in run.channels:
        unit, factor = run.unit(channel)
        text = f"{title_of(channel)} {number(factor * truth['rmse'][channel])} {unit}"
        if base is not None and base["rmse"][channel] > 1.02 * truth["rmse"][channel]:
            share = (base["rmse"][channel] - row["rmse"][channel]) / (
                base["rmse"][channel] - truth["rmse"][channel]
            )
            text += f" (attained: {100 * share:.0f} % of the possible reduction)"
        parts.append(text)
    intro = (
        "The simulated plant itself, started from the same measured state and knowing neither noise"
        " nor disturbance, leaves "
    )
    return intro + "; ".join(parts) + "."


def _end(run: RunFiles, row: Content, base: Content | None, lead: str) -> str:
    if "position_error_end" not in row:
        return ""

    def off(judged: Content) -> tuple[str, str]:
        return (
            number(judged["position_error_end"], 2) + " m",
            number(DEG * judged["heading_error_end"], 2) + " deg",
        )

    position, heading = off(row)
    text = (
        f"At the end of a free run the position is off by {position} and the heading by {heading}"
        " on average"
    )
    if base is not None and lead != run.baseline:
        position, heading = off(base)
        text += f" (baseline: {position}, {heading})"
    return text + "."


def _divergence(run: RunFiles, split: str) -> str:
    whole = [
        row for row in run.rows if row["split"] == split and row.get("manoeuvre", "all") == "all"
    ]
    lost = [
        f"{row['model']} {row['diverged']} of {row['windows']} ({row['protocol']})"
        for row in whole
        if row["diverged"]
    ]
    if not lost:
        return f"No free run of any model diverged on {split} data."
    return (
        f"DIVERGED on {split} data, counted with the error of held velocities: {', '.join(lost)}."
    )


def cautions(run: RunFiles, findings: Sequence[Finding]) -> Section | None:
    """Return what speaks against using the selected model, None where nothing does."""
    out = []
    lead = run.selected
    for protocol in run.protocols:
        row, base = run.row(lead, run.focus, protocol), run.row(run.baseline, run.focus, protocol)
        seen = run.row(lead, "train", protocol)
        if row is None:
            continue
        worse = [
            title_of(c)
            for c in run.channels
            if base is not None
            and lead != run.baseline
            and row["rmse"][c] > 1.005 * base["rmse"][c]
        ]
        if worse:
            out.append(
                f"Protocol {protocol}: {lead} is worse than the baseline in {', '.join(worse)}."
            )
        if (
            seen is not None
            and seen is not row
            and row["nrmse"]["mean"] > 1.5 * seen["nrmse"]["mean"]
        ):
            times = f"{row['nrmse']['mean'] / seen['nrmse']['mean']:.1f} times its training error"
            out.append(
                f"Protocol {protocol}: the {run.focus} error of {lead} is {times}; it may be"
                f" overfitted, or the {run.focus} data differ."
            )
        if row["windows"] < 5:
            out.append(
                f"Protocol {protocol}: only {row['windows']} free runs on {run.focus} data; the"
                " intervals say little."
            )
    out += [
        text for text in (worse_than_reference(run, protocol) for protocol in run.protocols) if text
    ]
    if lead is not None and lead == run.baseline and run.heads:
        out.append(
            "The baseline was selected: on validation data no sound model is clearly better."
        )
    # the first sentence; the figures stand in the section on sanity
    failed = [finding for finding in findings if finding.ok is False and finding.model == lead]
    out += [
        f"{finding.model}, {finding.check}: {finding.text.partition('. ')[0].rstrip('.')}."
        for finding in failed
    ]
    told = [Bullets([minus(text) for text in out], warning=True)]
    return Section("Before you use it", told) if out else None


def worse_than_reference(run: RunFiles, protocol: str) -> str:
    """Return which heads and ensembles are worse than their reference by more than 5 %, and where.

    The sentence names the kinds of manoeuvre; it is empty where no model is worse.
    """
    lost = []
    for model in run.heads:
        rows = [
            row
            for kind in distinct(run, run.focus, protocol)
            if (row := run.row(model, run.focus, protocol, kind))
        ]
        bad = [
            row
            for row in rows
            if (row.get("difference") or {}).get("worse")
            and run.kinds[model] in ("head", "ensemble")
        ]
        if bad:
            where = ", ".join(
                f"{row['manoeuvre'].replace('_', ' ')}"
                f" {percent(100 * (row['difference']['ratio'] - 1))}"
                for row in bad
            )
            lost.append(f"{model} against {bad[0]['difference']['to']} ({where})")
    return (
        f"Protocol {protocol}: worse by more than 5 % in NRMSE on {run.focus} data:"
        f" {'; '.join(lost)}."
        if lost
        else ""
    )


def sanity(run: RunFiles, findings: Sequence[Finding]) -> Section | None:
    """Return a table of all checks and what each found, None where no model was checked."""
    if not findings:
        return None
    of: dict[str, dict[str, Finding]] = {}
    for finding in findings:
        of.setdefault(finding.model, {})[finding.check] = finding
    looks = {
        None: Cell("n/a", mark="weak"),
        True: Cell("✓ ok"),
        False: Cell("✗ look", mark="bad"),
    }
    table = table_of(
        of,
        [
            ("model", str),
            *((check, lambda model, check=check: looks[of[model][check].ok]) for check in CHECKS),
        ],
        selected=lambda model: model == run.selected,
    )
    details = [
        Section(
            run.label(model),
            [
                Facts(
                    [(check, minus(finding.text)) for check, finding in found.items()],
                    failed=[check for check, finding in found.items() if finding.ok is False],
                )
            ],
            folded=model != run.selected,
        )
        for model, found in of.items()
    ]
    return Section("Physical sanity", [table, *details])
