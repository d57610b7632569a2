"""Sentences of the report: the verdict, and what was fitted on what."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.judge.sanity import Finding
from residnet.report.run_reader import Row, RunFiles
from residnet.report.tables import DEG, distinct, number, percent, title_of, unit_of


def verdict(run: RunFiles) -> list[str]:
    """A paragraph in plain words, sentence by sentence."""
    protocol, split = run.protocols[0], run.focus
    lead = run.selected or (run.heads[0] if run.heads else run.baseline)
    row = run.row(lead, split, protocol)
    if lead is None or row is None:
        return [
            f"The run holds no free runs of its selected model on {split} data; see the tables."
        ]
    unseen = (
        "that no fit has seen"
        if split in ("test", "external")
        else f"of the {split} data (not unseen: read with care)"
    )
    why = "chosen on validation data" if run.selected else "the first head; nothing was selected"
    kind = ((run.evaluation.get("protocols") or {}).get(protocol) or {}).get("kind")
    runs = {"manoeuvre": "whole manoeuvre", "windows": "window"}.get(str(kind), "run") + (
        "" if row["windows"] == 1 else "s"
    )
    out = [
        f"Model {lead} ({why}) was free-run over {row['windows']} {runs} {unseen} (protocol"
        f" {protocol})."
    ]
    out.append(_level(run, lead, row, run.row(run.baseline, split, protocol)))
    truth = run.row(run.truth, split, protocol)
    if truth is not None and run.truth != lead:
        out.append(_against_plant(run, row, truth, run.row(run.baseline, split, protocol)))
    out.append(_end(run, row, run.row(run.baseline, split, protocol), lead))
    out.append(_divergence(run, split))
    return out


def _level(run: RunFiles, lead: str, row: Row, base: Row | None) -> str:
    parts = []
    for channel in run.channels:
        unit, factor = unit_of(run, channel)
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


def _against_plant(run: RunFiles, row: Row, truth: Row, base: Row | None) -> str:
    parts = []
    for channel in run.channels:
        unit, factor = unit_of(run, channel)
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


def _end(run: RunFiles, row: Row, base: Row | None, lead: str) -> str:
    if "position_error_end" not in row:
        return ""

    def off(of: Row) -> tuple[str, str]:
        return (
            number(of["position_error_end"], 2) + " m",
            number(DEG * of["heading_error_end"], 2) + " deg",
        )

    text = "At the end of a free run the position is off by {} and the heading by {} on average"
    text = text.format(*off(row))
    if base is not None and lead != run.baseline:
        text += " (baseline: {}, {})".format(*off(base))
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


def cautions(run: RunFiles, findings: Sequence[Finding]) -> list[str]:
    """What a reader must know before using the selected model; empty where nothing speaks against
    it.
    """
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
        out.append("No head beats the baseline on validation data: the baseline was selected.")
    # the first sentence; the figures stand in the section on sanity
    failed = [finding for finding in findings if finding.ok is False and finding.model == lead]
    out += [
        f"{finding.model}, {finding.check}: {finding.text.partition('. ')[0].rstrip('.')}."
        for finding in failed
    ]
    return out


def worse_than_reference(run: RunFiles, protocol: str) -> str:
    """Heads and ensembles that are worse than what they are compared with by more than 5 %, by kind
    of manoeuvre; empty where there are none.
    """
    lost = []
    for model in run.heads:
        rows = [
            row
            for kind in distinct(run, run.manoeuvres(run.focus, protocol), run.focus, protocol)
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


def fitted_on(run: RunFiles) -> list[tuple[str, str]]:
    """What was fitted on what, as pairs of a name and a sentence."""
    baseline = run.resolved.get("baseline") or {}
    samples = run.fit(run.baseline or "baseline").get("samples")
    fit = f", fitted on {samples} samples" if samples else ""
    logs: dict[str, list[Row]] = {}
    for entry in run.quality:
        logs.setdefault(entry["split"], []).append(entry)
    splits = [
        f"{split} {len(members)} logs, {sum(log['seconds'] for log in members) / 60:.1f} min"
        for split, members in logs.items()
    ]
    protocols = run.evaluation.get("protocols") or {}
    scales = [
        f"{name} {number(unit_of(run, name)[1] * value)} {unit_of(run, name)[0]}"
        for name, value in (run.metrics.get("scales") or {}).items()
    ]
    facts = [
        ("data", _data(run)),
        ("splits", "; ".join(splits)),
        ("inputs", _inputs(run)),
        *_model(run),
    ]
    facts.append(("baseline", str(baseline.get("kind", "")) + fit if baseline else ""))
    for name, protocol in protocols.items():
        facts.append(
            (
                f"protocol {name}",
                _protocol(protocol)
                + ("; selects the model" if name == run.evaluation.get("selection") else ""),
            )
        )
    facts.append(("NRMSE divides by", ", ".join(scales)))
    return [(name, text) for name, text in facts if text]


def _data(run: RunFiles) -> str:
    data = run.resolved.get("data") or {}
    if not data:
        return ""
    if data.get("kind") != "simulated":
        return (
            f"measured logs ({(data.get('reader') or {}).get('kind', 'files')}),"
            f" {len(run.provenance.get('inputs') or {})} files"
        )
    text = f"simulated sea trials of vessel {data.get('vessel')}"
    noise = data.get("noise") or {}
    if noise:
        text += (
            f", noise u {number(noise.get('u'), 2)} m/s, v {number(noise.get('v'), 2)} m/s, r"
            f" {number(DEG * noise.get('r', 0), 2)} deg/s"
        )
    return text + f"; data seed {data.get('seed')}"


def _inputs(run: RunFiles) -> str:
    signals = run.resolved.get("signals") or {}
    text = ", ".join(signals.get("inputs") or [])
    if signals.get("exogenous"):
        text += "; exogenous: " + ", ".join(signals["exogenous"])
    if signals.get("forces"):
        text += (
            f"; forces from the thrusters of {signals['forces']}"
            if isinstance(signals["forces"], str)
            else "; forces from given thrusters"
        )
    return text


def _model(run: RunFiles) -> list[tuple[str, str]]:
    card = run.card(run.baseline or "baseline")
    if not card:
        return []
    signals = card.get("signals") or {}
    names = ["u", "v", "r", *(signals.get("inputs") or []), *(signals.get("exogenous") or [])]
    ranges = []
    for name, low, high in zip(names, card["low"], card["high"], strict=False):
        unit, factor = unit_of(run, name)
        ranges.append(
            f"{name} {number(factor * low)} to {number(factor * high)} {unit}".removesuffix(" -")
        )
    return [
        ("model step", f"{card['dt']:g} s, {card['integrator']}; inputs held over a step"),
        ("training range", "; ".join(ranges)),
    ]


def _protocol(protocol: Row) -> str:
    if protocol.get("kind") == "windows":
        return (
            f"back-to-back windows of {protocol['length']:g} s, the first from"
            f" {protocol.get('first', 0):g} s on, each from the measured state"
        )
    if protocol.get("kind") == "manoeuvre":
        return (
            "whole manoeuvres; they start from the mean velocities of the first"
            f" {protocol['initial']:g} s and are scored after them"
        )
    return str(protocol.get("kind", "not described"))
