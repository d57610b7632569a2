"""The verdict on a fit, and what a reader must know before using its selected model."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.format import DASH, minus, number, percent, plural, title_of
from residnet.data.doctor import summary
from residnet.judge.soundness import CHECKS, Finding
from residnet.judge.verdict import UNSEEN, Evidence, diverged_note
from residnet.judge.verdict import level as judged_level
from residnet.judge.verdict import verdict as judged
from residnet.report.blocks import Bullets, Cell, Facts, Section, Text, table_of
from residnet.report.figure import Figure
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


_MEASURED = "measurements"
"""Row of what the measured velocities leave, integrated."""
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
    told = run.live.text
    if made := next((log["integrated"] for log in run.quality if log.get("integrated")), None):
        doctor = f"{_NO_PLACE.format(', '.join(made))} {doctor}".strip() if not told else doctor
        told += "; no heading was measured" if told and run.live.turns and "psi" in made else ""
    doctor = f"{told[0].upper()}{told[1:]}. {doctor}".strip() if told else doctor
    sides = (one for one in inspection.get("together") or [] if one["code"] == "one_side")
    return Evidence(
        selected,
        split,
        rows,
        run.baseline or "",
        run.json("selection.json"),
        (run.limits.get("splits") or {}).get(split, {}),
        doctor,
        protocol,
        next((one["text"] for one in sides if one["level"] != "note"), ""),
    )


def level(run: RunFiles) -> str:
    """Return the level of the verdict on the selected model, empty where it has no free runs."""
    return judged_level(evidence(run, run.lead))


def opening(run: RunFiles, figures: Sequence[Figure]) -> Section | None:
    """Return the rest of the first screen: a run of median error beside the models' errors.

    The rows: what predicts, what was selected, the baseline, zero, what the measurements themselves
    leave, then the others, the nearest first. None where there is no free run.
    """
    rows = {one: row for one in run.kinds if (row := run.row(one, run.focus, run.main))}
    if run.lead not in rows or not run.ends:
        return None
    known = {entry["model"]: entry for entry in run.json("selection.json").get("models") or []}
    limits = (run.limits.get("splits") or {}).get(run.focus, {}).get(run.main, {})
    first = [run.lead, run.selected, run.baseline, "zero"]
    table: list[Content] = [rows[one] for one in dict.fromkeys(first) if one in rows]
    floor = limits.get("kinematics") or {}
    ends = {f"{of}_error_end": floor[f"{of}_mean"] for of in run.ends if floor}
    # a pose that was integrated from the velocities has no floor but rounding
    if measured := any(end > 1e-9 for end in ends.values()):
        table.append({"model": _MEASURED, "diverged": 0, **ends})
    table += sorted(
        (row for one, row in rows.items() if one not in first),
        key=lambda row: float(row[f"{run.ends[0]}_error_end"]),
    )

    def error(row: Content, key: str, factor: float) -> Cell:
        span = row.get(f"{key}_ci95")
        least = min(rows[one][key] for one in rows if one != run.truth)
        note = "–".join(number(factor * end, 2) for end in span) if span else ""
        return Cell(number(factor * row[key], 2), note, "best" if row[key] == least else "")

    def fault(row: Content) -> str:
        return next(iter((known.get(row["model"]) or {}).get("faults") or []), "")

    def sound(row: Content) -> Cell:
        if fault(row) or diverged_note(row):
            return Cell("✗", diverged_note(row), "text")
        return Cell("✓" if row["model"] in known else DASH, mark="text")

    elsewhere = run.main != run.protocols[0]
    told = [
        f"Mean of {plural(rows[run.lead]['windows'], 'free run')} on {run.focus} data"
        f" ({run.main}"
        + f", which start elsewhere than those of {run.protocols[0]} above" * elsewhere
        + ")"
        + (
            "; small: 95 % interval of this mean (above: of as many new runs)."
            if rows[run.lead].get(f"{run.ends[0]}_error_end_ci95")
            else "."
        ),
        "" if run.focus in UNSEEN else "These data are not unseen: read with care.",
        "Zero: no model at all, the first velocities are held." if "zero" in rows else "",
        "Measurements: where the measured velocities themselves lead." if measured else "",
        *(f"✗ {run.label(row['model'])}: {why}." for row in table if (why := fault(row))),
    ]
    shown = table_of(
        table,
        [
            (
                "model",
                lambda row: _MEASURED if row["model"] == _MEASURED else run.label(row["model"]),
            ),
            *(
                (f"{name} [{unit}]", lambda row, of=of, f=f: error(row, f"{of}_error_end", f))
                for of, (name, unit, f) in ((of, run.end(of)) for of in run.ends)
            ),
            ("sound", sound),
        ],
        groups=[(f"error {run.horizon}", len(run.ends))],
        selected=lambda row: row["model"] == run.lead,
    )
    return Section("", [*figures, shown, Text(" ".join(filter(None, told)), quiet=True)])


def cautions(run: RunFiles, findings: Sequence[Finding]) -> Section | None:
    """Return what speaks against using the model reported first, None where nothing does."""
    out = []
    lead = run.predictor
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
    out += [
        text for text in (worse_than_reference(run, protocol) for protocol in run.protocols) if text
    ]
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
    looks = {None: Cell("n/a", mark="weak"), True: Cell("✓ ok"), False: Cell("✗ look", mark="bad")}
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
