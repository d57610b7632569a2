"""Errors of free runs by model, split and kind of manoeuvre."""

from __future__ import annotations

from residnet.judge.verdict.sentences import diverged_note
from residnet.report.blocks import Block, Cell, Section, Table, Text
from residnet.report.format import DEG, change, number, title_of
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.fit.manoeuvres import distinct


def section(run: RunFiles) -> Section:
    """Return the section on free runs: for each protocol all models, then kind by kind.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    blocks: list[Block] = [Text(_about(run))]
    for protocol in run.protocols:
        table = free_runs(run, protocol)
        if table is None:
            continue
        parts: list[Block] = [table]
        kinds = by_manoeuvre(run, protocol, run.focus)
        if kinds is not None:
            title = f"By kind of manoeuvre, {run.focus} data"
            parts.append(Section(title, [kinds], folded=protocol != run.protocols[0]))
        blocks.append(Section(f"Protocol {protocol}", parts))
    return Section("Free runs", blocks)


def _about(run: RunFiles) -> str:
    where = (
        f"The splits {' and '.join(run.sides)} stand side by side."
        if len(run.sides) > 1
        else f"The data are those of the split {run.focus}."
    )
    small = "the 95 % interval of NRMSE"
    if run.baseline is not None:
        small = f"the change against the baseline on the same data, and {small}"
    return (
        "The tables give the root mean square error of each free run, averaged over the runs."
        f" {where} Small print gives {small}. A run that diverged counts with the error of held"
        " velocities, and its number stands beside the score."
    )


def free_runs(run: RunFiles, protocol: str) -> Table | None:
    """Return the errors of all models under a protocol, the splits side by side for each quantity.

    None where no model has been run under it.
    """
    sides = [
        split for split in run.sides if any(run.row(model, split, protocol) for model in run.kinds)
    ]
    if not sides:
        return None
    quantities = [*run.channels, "nrmse", "position", "heading", "diverged"]
    titles = {channel: f"{title_of(channel)} [{run.unit(channel)[0]}]" for channel in run.channels}
    titles |= {
        "nrmse": "NRMSE, mean [-]",
        "position": "position, end [m]",
        "heading": "heading, end [deg]",
        "diverged": "diverged",
    }
    table = Table(
        ["model", *(split for _ in quantities for split in sides)],
        groups=[(titles[key], len(sides)) for key in quantities],
    )
    for model in run.kinds:
        found = [run.row(model, split, protocol) for split in sides]
        reference = [
            (
                run.row(run.baseline, split, protocol)
                if run.kinds[model] not in ("zero", "baseline")
                else None
            )
            for split in sides
        ]
        cells = [
            _quantity(run, key, row, base)
            for key in quantities
            for row, base in zip(found, reference, strict=True)
        ]
        table.add(run.label(model), cells, selected=model == run.selected)
    return table


def errors_table(run: RunFiles, split: str) -> Table:
    """Return the errors of all models on one split under all protocols, for the terminal."""
    units = [f"{title_of(channel)} [{run.unit(channel)[0]}]" for channel in run.channels]
    ends = ["NRMSE [-]", "position, end [m]", "heading, end [deg]", "diverged"]
    table = Table(
        ["model", "protocol", *units, *ends],
        caption=f"Free-run errors on {split} data, mean over windows.",
    )
    for protocol in run.protocols:
        for model in run.kinds:
            row = run.row(model, split, protocol)
            if row is None:
                continue
            table.add(
                run.label(model),
                [
                    Cell(protocol, mark="text"),
                    *(number(run.unit(name)[1] * row["rmse"][name]) for name in run.channels),
                    Cell(
                        number(row["nrmse"]["mean"]),
                        diverged_note(row),
                        "bad" if row["diverged"] else "",
                    ),
                    *(
                        _quantity(run, key, row, None)
                        for key in ("position", "heading", "diverged")
                    ),
                ],
            )
    return table


def by_manoeuvre(run: RunFiles, protocol: str, split: str) -> Table | None:
    """Return the errors of one split by kind of manoeuvre, None where there is a single kind."""
    kinds = distinct(run, run.manoeuvres(split, protocol), split, protocol)
    if len(kinds) < 2:
        return None
    quantities = [*run.channels, "nrmse", "position", "heading", "diverged"]
    heads = [f"{title_of(channel)} [{run.unit(channel)[0]}]" for channel in run.channels]
    ends = ["NRMSE [-]", "position, end [m]", "heading, end [deg]", "diverged"]
    table = Table(["manoeuvre, model", "runs", *heads, *ends])
    for kind in kinds:
        for place, model in enumerate(model for model, role in run.kinds.items() if role != "zero"):
            row = run.row(model, split, protocol, kind)
            if row is None:
                continue
            base = (
                run.row(run.baseline, split, protocol, kind)
                if run.kinds[model] != "baseline"
                else None
            )
            cells = [
                Cell(str(row["windows"])),
                *(_quantity(run, key, row, base) for key in quantities),
            ]
            # the kind stands once, before its first model
            name = f"{kind.replace('_', ' ')}: " if place == 0 else ""
            table.add(
                name + run.label(model), cells, rule=place == 0, selected=model == run.selected
            )
    return table


def _quantity(run: RunFiles, key: str, row: Content | None, base: Content | None) -> Cell:
    if row is None:
        return Cell("–")
    if key == "diverged":
        return Cell(f"{row['diverged']}/{row['windows']}", mark="bad" if row["diverged"] else "")
    if key == "position":
        return Cell(number(row.get("position_error_end"), 2))
    if key == "heading":
        return Cell(
            number(DEG * row["heading_error_end"], 2) if "heading_error_end" in row else "–"
        )
    if key == "nrmse":
        interval = row.get("nrmse_mean_ci95")
        spread = f"{number(interval[0])}–{number(interval[1])}" if interval else ""
        note = "; ".join(text for text in (spread, diverged_note(row)) if text)
        return Cell(number(row["nrmse"]["mean"]), note, "bad" if row["diverged"] else "")
    value = row["rmse"].get(key)
    if value is None:
        return Cell("–")
    worse = base is not None and value > 1.005 * base["rmse"][key]
    against = change(value, base["rmse"][key]) if base is not None else ""
    note = "; ".join(text for text in (against, diverged_note(row)) if text)
    return Cell(number(run.unit(key)[1] * value), note, "bad" if worse or row["diverged"] else "")
