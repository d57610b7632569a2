"""Bands of free runs: how wide they are, what they held, and what they do not promise."""

from __future__ import annotations

from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.figures.tracks import leading
from residnet.report.format import DASH, DEG, fixed, number, percent
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.fit.manoeuvres import distinct

_CHANNELS = ("u", "v", "r", "heading", "position")
_WIDTHS = (
    ("u", "u [m/s]", 1.0),
    ("v", "v [m/s]", 1.0),
    ("r", "r [deg/s]", DEG),
    ("heading", "heading [deg]", DEG),
    ("position", "position [m]", 1.0),
)


def section(run: RunFiles) -> Section | None:
    """Return the section on bands; None where the run has none."""
    models: Content = run.json("bands.json").get("models") or {}
    lead = leading(run)
    if not models:
        return None
    blocks: list[Block] = [Text(_about(run, models))]
    told = cautions(run, lead)
    if told:
        blocks.append(Bullets(told, warning=True))
    for protocol in run.protocols:
        table = _coverage(run, protocol)
        if table is None:
            continue
        parts: list[Block] = [table]
        kinds = _kinds(run, protocol, lead)
        if kinds is not None:
            parts.append(kinds)
        widths = _widths(models.get(lead, {}).get(protocol))
        if widths is not None:
            parts.append(widths)
        blocks.append(Section(f"Protocol {protocol}", parts, folded=protocol != run.protocols[0]))
    return Section("Bands", blocks)


def cautions(run: RunFiles, model: str) -> list[str]:
    """Return whole sentences about what the bands of a model do not promise."""
    known: Content = (run.json("bands.json").get("models") or {}).get(model) or {}
    out: list[str] = []
    for protocol, band in known.items():
        out += [text for text in band["cautions"] if text not in out]
        longest = max(
            (float(w.t[-1] - w.t[0]) for w in run.windows(run.focus) if w.protocol == protocol),
            default=0.0,
        )
        if longest > band["horizon"] + 1e-6:
            out.append(
                f"Runs of protocol {protocol} last up to {fixed(longest, 0)} s, and the band is"
                f" calibrated up to {fixed(band['horizon'], 0)} s only; beyond, it grows in"
                " proportion to time, without any promise."
            )
    return out


def _about(run: RunFiles, models: Content) -> list[str]:
    band = next(iter(next(iter(models.values())).values()))
    level = f"{100 * band['level']:.0f} %"
    return [
        f"A band is to hold {level} of the errors of a free run on logs that nobody has seen. It"
        " grows with the horizon, and is wider where the predicted run is livelier. It was"
        " calibrated over logs that its model was not fitted on: training logs, predicted by"
        " models that leave them out, and the validation logs.",
        f"The tables say what the bands held of the {run.focus} data. Whole: share of the runs that"
        f" a band holds from beginning to end, each channel for itself, where it is widened to hold"
        f" {level} of them. Score: mean width, and {2 / (1 - band['level']):.0f} times what lies"
        " outside, in units of the error of zero; less is better. Beside it stand a band of one"
        " width at all horizons and the spread of the run's models, taken for normal.",
    ]


def _coverage(run: RunFiles, protocol: str) -> Table | None:
    rows = {model: run.row(model, run.focus, protocol) for model in run.kinds}
    known = {model: row for model, row in rows.items() if row and "band_coverage" in row}
    if not known:
        return None
    table = Table(
        ["model", *_CHANNELS, "mean", "whole", "bands", "one width", "spread"],
        groups=[("coverage", 7), ("score", 3)],
    )
    for model, row in known.items():
        table.add(run.label(model), _cells(row), selected=model == run.selected)
    return table


def _kinds(run: RunFiles, protocol: str, model: str) -> Table | None:
    kinds = distinct(run, run.manoeuvres(run.focus, protocol), run.focus, protocol)
    rows = {kind: run.row(model, run.focus, protocol, kind) for kind in kinds}
    known = {kind: row for kind, row in rows.items() if row and "band_coverage" in row}
    if len(known) < 2:
        return None
    table = Table(
        [f"manoeuvre, {model}", *_CHANNELS, "mean", "whole", "bands", "one width", "spread"],
        groups=[("coverage", 7), ("score", 3)],
    )
    for kind, row in known.items():
        table.add(kind.replace("_", " "), _cells(row))
    return table


def _cells(row: Content) -> list[Cell]:
    coverage, own = row["band_coverage"], row["band_score"]
    out = [Cell(fixed(coverage.get(name), 2)) for name in (*_CHANNELS, "mean", "whole")]
    out.append(Cell(number(own)))
    for name in ("band_score_constant", "band_score_spread"):
        value = row.get(name)
        note = percent(100 * (value / own - 1)) if value is not None and own > 0 else ""
        out.append(Cell(DASH if value is None else number(value), note))
    return out


def _widths(band: Content | None) -> Table | None:
    """Return the half widths of the leading model at a few horizons."""
    if band is None:
        return None
    table = Table(["half width after", *(title for _, title, _ in _WIDTHS)])
    steps = band["steps"]
    for share in (0.1, 0.25, 0.5, 1.0):
        place = min(range(len(steps)), key=lambda i: abs(steps[i] - share * steps[-1]))
        table.add(
            f"{number(steps[place] * band['step'])} s",
            [
                Cell(number(factor * band["half_width_of_any_run"][name][place]))
                for name, _, factor in _WIDTHS
            ],
        )
    return table
