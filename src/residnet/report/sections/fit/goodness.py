"""Goodness of fit: one-step residuals of every model, and how sure their level is."""

from __future__ import annotations

from residnet.report.blocks import Block, Cell, Section, Table, Text
from residnet.report.format import DASH, interval, number
from residnet.report.run_reader import Content, RunFiles

_AXES = {"u_dot": "surge u′", "v_dot": "sway v′", "r_dot": "yaw r′"}
_WHITE = 0.05
"""Least p-value at which residuals pass for white noise."""


def section(run: RunFiles) -> Section | None:
    """Return the section on goodness of fit, None where the run has no goodness.json."""
    parts = axes(run)
    if not parts:
        return None
    blocks: list[Block] = [
        Text(
            "These are one-step residuals: what each model leaves of the measured acceleration"
            " along the measured states. A model that is good here may still be poor in free run,"
            " and the other way round."
        ),
        *parts,
        Text(
            [
                "C_p, AIC and BIC use the noise variance of the model with the least residual. The"
                " parameters of a kernel model are the trace of its smoother, those of a network"
                " all its weights.",
                "95 %, blocks: moving-block bootstrap with a block length chosen from the data. 95"
                " %, independent: Student's t for independent samples, far too narrow for"
                " correlated residuals. White: test of Ljung and Box, which counts every sample.",
                "Difference: of the mean |residual| from that of the named model at the same"
                " samples, with its interval by blocks. Negative is better; a bold one excludes"
                " zero.",
            ],
            quiet=True,
        ),
    ]
    return Section("Goodness of fit", blocks)


def axes(run: RunFiles) -> list[Section]:
    """Return tables and sentences for each axis, of the split that the report speaks of.

    Another split stands in where that one has no samples.
    """
    splits = run.json("goodness.json").get("splits") or {}
    split = next((name for name in (run.focus, *splits) if splits.get(name)), "")
    rows: list[Content] = splits.get(split) or []
    out: list[Section] = []
    for axis, title in _AXES.items():
        of_axis = [row for row in rows if row["axis"] == axis]
        if of_axis:
            unit, factor = run.unit(axis.replace("_dot", ""))
            blocks: list[Block] = [_fits(of_axis, factor), _residuals(of_axis, factor)]
            blocks.append(Text(" ".join(_sentences(of_axis))))
            unit = f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
            out.append(Section(f"{title} [{unit}], {split} data", blocks, folded=bool(out)))
    return out


def _fits(rows: list[Content], factor: float) -> Table:
    """Return how close each model fits on one axis, and what its parameters cost."""
    table = Table(["model", "parameters", "RMSE", "R²", "adjusted R²", "C_p", "AIC", "BIC"])
    for row in rows:
        cells = [
            Cell(number(row["parameters"], 3)),
            Cell(number(factor * row["rmse"])),
            Cell(number(row["r2"])),
            Cell(number(row["r2_adjusted"])),
            Cell(number(factor**2 * row["cp"])),
            Cell(number(row["aic"], 4)),
            Cell(number(row["bic"], 4)),
        ]
        table.add(row["model"], cells)
    return table


def _residuals(rows: list[Content], factor: float) -> Table:
    """Return the size of the residuals of one axis with its intervals, and how alike they are."""
    columns = [
        "mean |residual|",
        "95 %, blocks",
        "95 %, independent",
        "block [s]",
        "independent samples",
        "correlation at lag 1",
        "white, p",
        "difference",
    ]
    table = Table(["model", *columns])
    for row in rows:
        cells = [
            Cell(number(factor * row["mae"])),
            Cell(interval(row["mae_ci95"], factor)),
            Cell(interval(row["mae_ci95_independent"], factor), mark="weak"),
            Cell(number(row["block_seconds"], 2)),
            Cell(f"{row['effective']:.0f} of {row['samples']}"),
            Cell(number(row["autocorrelation"][0])),
            Cell(
                "< 0.001" if row["white_p"] < 1e-3 else number(row["white_p"], 2),
                mark="" if row["white_p"] > _WHITE else "weak",
            ),
            _difference(row.get("difference"), factor),
        ]
        table.add(row["model"], cells)
    return table


def _difference(pair: Content | None, factor: float) -> Cell:
    if pair is None:
        return Cell(DASH)
    return Cell(
        f"{number(factor * pair['mae'])} ({interval(pair['ci95'], factor)})",
        note=f"to {pair['to']}",
        mark="best" if pair["excludes_zero"] else "",
    )


def _sentences(rows: list[Content]) -> list[str]:
    """Return by how much intervals of independent samples are too narrow, and what is white."""
    wider = [
        (row["mae_ci95"][1] - row["mae_ci95"][0])
        / (row["mae_ci95_independent"][1] - row["mae_ci95_independent"][0])
        for row in rows
        if row["mae_ci95"]
        and row["mae_ci95_independent"]
        and row["mae_ci95_independent"][1] > row["mae_ci95_independent"][0]
    ]
    out = []
    if wider:
        out.append(
            "The interval that takes the samples for independent is"
            f" {min(wider):.1f} to {max(wider):.1f} times too narrow."
        )
    white = [row["model"] for row in rows if row["white_p"] > _WHITE]
    out.append(
        f"The residuals of {', '.join(white)} pass for white noise."
        if white
        else "No model leaves white residuals."
    )
    return out
