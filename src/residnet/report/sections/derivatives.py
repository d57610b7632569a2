"""Hydrodynamic derivatives of the report: SI at both scales, and the non-dimensional systems."""

from __future__ import annotations

from residnet.core.format import DASH, format_interval, format_number
from residnet.evaluation.derivatives import DerivativeRow, DerivativesFile
from residnet.report.blocks import Block, Bullets, Cell, Column, Section, Text, build_table
from residnet.report.run_reader import RunFiles


def derivatives_section(run: RunFiles) -> Section | None:
    """Return the table of derivatives; None where the run has none."""
    content = run.read_record(DerivativesFile, "derivatives.json")
    if content is None:
        return None
    ship = run.read_record(DerivativesFile, "derivatives_ship.json")
    ship_rows = {} if ship is None else {row.name: row for row in ship.rows}
    speed = content.particulars["speed"]
    length = content.particulars["length"]
    introduction = (
        f"Taylor series of the {content.quantity}s of model {content.model} about straight-ahead"
        f" motion at {format_number(speed, 4)} m/s (Froude number"
        f" {format_number(content.froude_number, 3)}), length {format_number(length, 4)} m."
        " Non-dimensional values times 100,000; intervals are 95 % confidence intervals. A row in"
        " bold has an interval that excludes zero."
    )
    if ship is not None:
        introduction += f" The ship is {format_number(ship.scale)} times longer (Froude's law)."

    def scaled(value: float | None, factor: float = 1e5) -> str:
        return DASH if value is None else format_number(value * factor, 4)

    def prime_cell(row: DerivativeRow) -> Cell:
        if row.prime_i is None:
            return Cell(DASH)
        error = row.prime_i_error
        bounds = None if error is None else (row.prime_i - 1.96 * error, row.prime_i + 1.96 * error)
        return Cell(scaled(row.prime_i), format_interval(bounds, 1e5))

    columns: list[Column[DerivativeRow]] = [
        ("derivative", lambda row: row.name),
        ("SI", lambda row: Cell(format_number(row.value, 4), format_interval(row.ci95, 1.0))),
        ("unit", lambda row: row.unit),
    ]
    if ship_rows:
        columns.append(
            (
                "ship, SI",
                lambda row: (
                    format_number(ship_rows[row.name].value, 4) if row.name in ship_rows else DASH
                ),
            )
        )
    columns += [
        ("prime I", prime_cell),
        ("prime II", lambda row: scaled(row.prime_ii)),
        ("bis", lambda row: scaled(row.bis, 1.0)),
    ]
    blocks: list[Block] = [
        Text(introduction),
        build_table(content.rows, columns, is_selected=lambda row: bool(row.is_significant)),
    ]
    if content.published is not None:
        estimates = ", ".join(
            f"{name}' {format_number(1e5 * value, 4)}" for name, value in content.published.items()
        )
        blocks.append(
            Text(
                f"Clarke, Gedling and Hine (1983) estimate, prime I: {estimates}.",
                is_secondary=True,
            )
        )
    if content.remarks:
        blocks.append(Bullets(list(content.remarks)))
    return Section("Hydrodynamic derivatives", blocks)
