"""The report of the variants of a fit: errors, and paired differences from the reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from residnet.core.format import format_count, format_signed
from residnet.report.blocks import (
    Cell,
    Section,
    Table,
    Text,
    build_table,
    format_paired_interval,
)
from residnet.report.figure import (
    BLUE,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    error_bars,
    join_with_gaps,
    tick_labels,
)
from residnet.report.figure_files import write_figures
from residnet.report.records import VariantRow, VariantsFile
from residnet.report.run_reader import RunFiles

VARIANTS_FILE = "variants.json"
"""File of a run folder with the errors of all variants."""


def variant_sections(files: RunFiles) -> list[Section]:
    """Return the sections of the report, and draw the figure."""
    comparison = VariantsFile.read(files.path / VARIANTS_FILE)
    rows = comparison.rows
    figure = plot_differences(rows, comparison.reference)
    figure_blocks = write_figures(files.path / "figures", [figure])
    explanation = (
        f"NRMSE of the free runs of {comparison.model} on {comparison.split} data, mean over the"
        f" windows and {format_count(rows[0].seeds, 'seed')}; SD: standard deviation over seeds."
        f" Difference: to {comparison.reference} over the same windows, after the mean over seeds;"
        " negative is better, bold is significant (95 % confidence interval from blocks of"
        " windows)."
    )
    table = tabulate_variants(rows, comparison.reference)
    return [
        # the first picture of a page needs no JavaScript
        Section("", [figure.preview(), table, Text(explanation, is_secondary=True)]),
        Section("Differences", figure_blocks),
        Section("Definition of the variants", [tabulate_overrides(rows)]),
    ]


def plot_differences(rows: Sequence[VariantRow], reference: str) -> Figure:
    """Plot the differences from the reference with intervals, one panel for each protocol.

    Args:
        reference: name of the reference variant.
    """
    protocols = list(dict.fromkeys(row.protocol for row in rows))
    names = [name for name in dict.fromkeys(row.variant for row in rows) if name != reference]
    panel_curves = []
    panels = []
    for protocol in protocols:
        protocol_rows = [
            row for row in rows if row.protocol == protocol and row.variant != reference
        ]
        positions = [names.index(row.variant) for row in protocol_rows]
        interval_spans = [
            (position, *row.difference_ci95)
            for position, row in zip(positions, protocol_rows, strict=True)
            if row.difference_ci95
        ]
        interval_lines = join_with_gaps(
            [
                error_bars(*[[part] for part in interval_span])[::-1]
                for interval_span in interval_spans
            ]
        )
        points = (
            np.array([row.difference for row in protocol_rows]),
            np.array(positions, dtype=float),
        )
        panel_curves.append(
            {"interval": interval_lines, "difference": points, "zero": (np.zeros(1), np.zeros(1))}
        )
        label = f"{protocol}: NRMSE, difference to {reference} [-]"
        panels.append(
            Panel(
                "",
                label,
                height=80 + 31 * len(names),
                group=protocol,
                y_names=tick_labels(names),
                y_limits=(len(names) - 0.5, -0.5),
            )
        )
    return Figure(
        "variants",
        "Differences between variants",
        f"NRMSE of each variant minus NRMSE of {reference}, mean over windows and seeds. The bars"
        " are 95 % confidence intervals over logs.",
        {
            "zero": GlyphStyle("", "#666666", width=0.8, kind="vline", z_order=1),
            "interval": GlyphStyle("95 % confidence interval", width=1.2),
            "difference": GlyphStyle("difference", BLUE, kind="points", size=4.5, z_order=4),
        },
        panels,
        [Case("", panel_curves)],
        columns=len(protocols),
    )


def tabulate_variants(rows: Sequence[VariantRow], reference: str) -> Table:
    """Return the table of variants with error and difference under each protocol.

    Args:
        reference: name of the reference variant.
    """
    by_variant: dict[str, dict[str, VariantRow]] = {}
    for row in rows:
        by_variant.setdefault(row.variant, {})[row.protocol] = row
    protocols = list(dict.fromkeys(row.protocol for row in rows))

    def format_error(row: VariantRow) -> Cell:
        notes = [] if row.nrmse_sd is None else [f"SD {row.nrmse_sd:.4f}"]
        notes += [f"{row.diverged} diverged"] if row.diverged else []
        protocol_rows = [other for other in rows if other.protocol == row.protocol]
        is_lowest = row.nrmse_mean == min(other.nrmse_mean for other in protocol_rows)
        return Cell(
            f"{row.nrmse_mean:.4f}",
            ", ".join(notes),
            "bad" if row.diverged else "best" if is_lowest else "",
        )

    def format_difference(row: VariantRow) -> Cell:
        interval = format_paired_interval(row.difference_ci95, "")
        text = format_signed(row.difference) if row.difference_ci95 else ""
        return Cell(text, interval.text, interval.mark)

    protocol_columns: list[tuple[str, Callable[[VariantRow], Cell]]] = [
        ("NRMSE", format_error),
        ("difference", format_difference),
    ]
    return build_table(
        by_variant.values(),
        [
            ("variant", lambda row: row[protocols[0]].variant),
            *(
                (title, lambda row, name=name, of=cell_function: of(row[name]))
                for name in protocols
                for title, cell_function in protocol_columns
            ),
            ("run [s]", lambda row: row[protocols[0]].seconds, 0),
        ],
        groups=[*((f"protocol {name}", len(protocol_columns)) for name in protocols), ("", 1)],
        is_selected=lambda row: row[protocols[0]].variant == reference,
    )


def tabulate_overrides(rows: Sequence[VariantRow]) -> Table:
    """Return the table of the overrides of config keys that define each variant."""
    return build_table(
        {row.variant: row for row in rows}.values(),
        [
            ("variant", lambda row: row.variant),
            ("overrides", lambda row: ", ".join(row.overrides) or "none"),
        ],
    )
