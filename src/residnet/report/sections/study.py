"""The report of a study: variants of one recipe against each other."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.report.blocks import Cell, Figure, Section, Table, Text
from residnet.report.figures.files import figures_section, write_drawings
from residnet.report.figures.study import differences
from residnet.report.format import fixed, signed
from residnet.report.run_reader import Content, RunFiles


def draw(run: RunFiles) -> list[Figure]:
    """Write the figure of a study from its folder alone; returns it."""
    content = run.json("study.json")
    return write_drawings(
        run.path / "figures", [differences(content["rows"], content["reference"])]
    )


def sections(run: RunFiles) -> list[Section]:
    """Return the variants with their errors, and the figure that stands in the folder."""
    content = run.json("study.json")
    rows = content["rows"]
    seeds = rows[0]["seeds"]
    about = [
        f"Free-run NRMSE of model {content['model']} on {content['split']} data, mean over the"
        f" windows and {seeds} seed{'' if seeds == 1 else 's'}.",
        f"Difference: to {content['reference']} over the same windows, seeds averaged first;"
        " negative is better, and a bold interval excludes zero. Its 95 % interval comes from"
        " blocks of windows.",
    ]
    table = variants_table(rows, content["reference"])
    out = [Section("Variants", [table, Text(about, quiet=True)])]
    figures = figures_section(run.path / "figures")
    return [*out, figures] if figures else out


def variants_table(rows: Sequence[Content], reference: str) -> Table:
    """Return a row for each variant with its error and difference under each protocol.

    Args:
        rows: of study.json.
        reference: name of the variant that differences are taken to.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    heads = ["NRMSE", "sd of seeds", "difference", "95 % interval"]
    table = Table(
        ["variant", *heads * len(protocols), "run [s]", "what changes"],
        groups=[*((f"protocol {name}", len(heads)) for name in protocols), ("", 2)],
    )
    for name in dict.fromkeys(row["variant"] for row in rows):
        parts = {row["protocol"]: row for row in rows if row["variant"] == name}
        cells: list[Cell | str] = []
        for protocol in protocols:
            cells += _errors(parts[protocol])
        first = parts[protocols[0]]
        cells += [fixed(first["seconds"], 0), Cell(", ".join(first["overrides"]), mark="text")]
        table.add(name, cells, selected=name == reference)
    return table


def _errors(row: Content) -> list[Cell | str]:
    bounds = row["difference_ci95"]
    # a study of an earlier version does not know what diverged
    lost = int(row.get("diverged", 0))
    note = f"{lost} diverged" if lost else ""
    cells: list[Cell | str] = [
        Cell(fixed(row["nrmse_mean"], 4), note, "bad" if lost else ""),
        fixed(row["nrmse_sd"], 4),
    ]
    if bounds is None:
        return [*cells, "", ""]
    excludes_zero = bounds[0] > 0 or bounds[1] < 0
    return [
        *cells,
        signed(row["difference"]),
        Cell(f"{signed(bounds[0])} to {signed(bounds[1])}", mark="best" if excludes_zero else ""),
    ]
