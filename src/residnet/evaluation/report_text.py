"""Sentences of the report: the verdict, and what was fitted on what."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.evaluation.report_tables import DEG, number, title_of, unit_of
from residnet.evaluation.run_reader import Row, RunFiles
from residnet.evaluation.sanity import Finding


def verdict(run: RunFiles) -> list[str]:
    """A paragraph in plain words, sentence by sentence."""
    protocol, split = run.protocols[0], run.focus
    lead = run.selected or (run.heads[0] if run.heads else run.baseline)
    row = run.row(lead, split, protocol)
    if lead is None or row is None:
        return [f"The run holds no free runs of its selected model on {split} data; see the tables."]
    unseen = "that no fit has seen" if split in ("test", "external") else f"of the {split} data (not unseen: read with care)"
    why = "chosen on validation data" if run.selected else "the first head; nothing was selected"
    out = [f"Model {lead} ({why}) was free-run over {row['windows']} {'windows' if row['windows'] != 1 else 'window'} {unseen} (protocol {protocol})."]
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
            text += f" (95 % interval {number(factor * interval[0])} to {number(factor * interval[1])})"
        if base is not None and lead != run.baseline and base["rmse"][channel] > 0:
            cut = 100 * (1 - row["rmse"][channel] / base["rmse"][channel])
            text += f", {abs(cut):.0f} % {'below' if cut >= 0 else 'ABOVE'} the baseline"
        parts.append(text)
    return "Root mean square errors: " + "; ".join(parts) + "."


def _against_plant(run: RunFiles, row: Row, truth: Row, base: Row | None) -> str:
    parts = []
    for channel in run.channels:
        unit, factor = unit_of(run, channel)
        text = f"{title_of(channel)} {number(factor * truth['rmse'][channel])} {unit}"
        if base is not None and base["rmse"][channel] > 1.02 * truth["rmse"][channel]:
            share = (base["rmse"][channel] - row["rmse"][channel]) / (base["rmse"][channel] - truth["rmse"][channel])
            text += f" ({100 * share:.0f} % of the possible reduction attained)"
        parts.append(text)
    return "The simulated plant itself, started from the same measured state and knowing neither noise nor disturbance, leaves " + "; ".join(parts) + "."


def _end(run: RunFiles, row: Row, base: Row | None, lead: str) -> str:
    if "position_error_end" not in row:
        return ""
    text = f"At the end of a free run the position is off by {number(row['position_error_end'], 2)} m and the heading by {number(DEG * row['heading_error_end'], 2)} deg on average"
    if base is not None and lead != run.baseline:
        text += f" (baseline: {number(base['position_error_end'], 2)} m, {number(DEG * base['heading_error_end'], 2)} deg)"
    return text + "."


def _divergence(run: RunFiles, split: str) -> str:
    lost: dict[str, int] = {}
    for row in run.rows:
        if row["split"] == split and row.get("manoeuvre", "all") == "all" and row["diverged"]:
            lost[row["model"]] = lost.get(row["model"], 0) + row["diverged"]
    if not lost:
        return f"No free run of any model diverged on {split} data."
    return "DIVERGED free runs, counted with the error of held velocities: " + ", ".join(f"{model} {count}" for model, count in lost.items()) + f" ({split} data)."


def cautions(run: RunFiles, findings: Sequence[Finding]) -> list[str]:
    """What a reader must know before using the selected model; empty where nothing speaks against it."""
    out = []
    lead = run.selected
    for protocol in run.protocols:
        row, base = run.row(lead, run.focus, protocol), run.row(run.baseline, run.focus, protocol)
        seen = run.row(lead, "train", protocol)
        if row is None:
            continue
        worse = [title_of(c) for c in run.channels if base is not None and lead != run.baseline and row["rmse"][c] > 1.005 * base["rmse"][c]]
        if worse:
            out.append(f"Protocol {protocol}: {lead} is worse than the baseline in {', '.join(worse)}.")
        if seen is not None and seen is not row and row["nrmse"]["mean"] > 1.5 * seen["nrmse"]["mean"]:
            ratio = row["nrmse"]["mean"] / seen["nrmse"]["mean"]
            out.append(f"Protocol {protocol}: the {run.focus} error of {lead} is {ratio:.1f} times its training error; it may be overfitted, or the {run.focus} data differ.")
        if row["windows"] < 5:
            out.append(f"Protocol {protocol}: only {row['windows']} free runs on {run.focus} data; the intervals say little.")
    if lead is not None and lead == run.baseline and run.heads:
        out.append("No head beats the baseline on validation data: the baseline was selected.")
    out += [f"{finding.model}, {finding.check}: {finding.text}" for finding in findings if finding.ok is False and finding.model == lead]
    return out


def fitted_on(run: RunFiles) -> list[tuple[str, str]]:
    """What was fitted on what, as pairs of a name and a sentence."""
    out: list[tuple[str, str]] = []
    data, signals, card = run.resolved.get("data") or {}, run.resolved.get("signals") or {}, run.card(run.baseline or "baseline")
    if data.get("kind") == "simulated":
        noise = data.get("noise") or {}
        text = f"simulated sea trials of vessel {data.get('vessel')}"
        if noise:
            text += f", noise u {number(noise.get('u'), 2)} m/s, v {number(noise.get('v'), 2)} m/s, r {number(DEG * noise.get('r', 0), 2)} deg/s; data seed {data.get('seed')}"
        out.append(("data", text))
    elif data:
        out.append(("data", f"measured logs ({(data.get('reader') or {}).get('kind', 'files')}), {len(run.provenance.get('inputs') or {})} files"))
    splits: dict[str, list[Row]] = {}
    for entry in run.quality:
        splits.setdefault(entry["split"], []).append(entry)
    if splits:
        out.append(("splits", "; ".join(f"{split} {len(logs)} logs, {sum(log['seconds'] for log in logs) / 60:.1f} min" for split, logs in splits.items())))
    if signals.get("inputs"):
        text = ", ".join(signals["inputs"])
        if signals.get("exogenous"):
            text += "; exogenous: " + ", ".join(signals["exogenous"])
        if signals.get("forces"):
            text += f"; forces from the thrusters of {signals['forces']}" if isinstance(signals["forces"], str) else "; forces from given thrusters"
        out.append(("inputs", text))
    if card:
        out.append(("model step", f"{card['dt']:g} s, {card['integrator']}; inputs held over a step"))
        names = ["u", "v", "r", *((card.get("signals") or {}).get("inputs") or []), *((card.get("signals") or {}).get("exogenous") or [])]
        units = {"r": ("deg/s", DEG), "delta": ("deg", DEG), "wind_dir": ("deg", DEG)}
        ranges = [_range(name, low, high, *units.get(name, ("m/s" if name in "uv" else "", 1.0))) for name, low, high in zip(names, card["low"], card["high"], strict=False)]
        out.append(("training range", "; ".join(ranges)))
    samples = run.fit(run.baseline or "baseline").get("samples")
    baseline = run.resolved.get("baseline") or {}
    if baseline:
        out.append(("baseline", str(baseline.get("kind", "")) + (f", fitted on {samples:,} samples".replace(",", "\u2009") if samples else "")))
    for name, protocol in (run.evaluation.get("protocols") or {}).items():
        out.append((f"protocol {name}", _protocol(protocol) + ("; selects the model" if name == run.evaluation.get("selection") else "")))
    scales = run.metrics.get("scales") or {}
    if scales:
        out.append(("NRMSE divides by", ", ".join(f"{name} {number(unit_of(run, name)[1] * value)} {unit_of(run, name)[0]}" for name, value in scales.items())))
    return out


def _range(name: str, low: float, high: float, unit: str, factor: float) -> str:
    return f"{name} {number(factor * low)} to {number(factor * high)} {unit}".strip()


def _protocol(protocol: Row) -> str:
    if protocol.get("kind") == "windows":
        return f"back-to-back windows of {protocol['length']:g} s, the first from {protocol.get('first', 0):g} s on, each from the measured state"
    if protocol.get("kind") == "manoeuvre":
        return f"whole manoeuvres; they start from the mean velocities of the first {protocol['initial']:g} s and are scored after them"
    return str(protocol.get("kind", "not described"))
