"""The figure of a study: differences of its variants to the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import SOLID, new_figure, styled


@styled
def differences(rows: Sequence[Mapping[str, Any]], reference: str) -> Drawing:
    """Draw the differences to the reference with their intervals, a panel for each protocol.

    Args:
        rows: of study.json.
        reference: name of the variant that differences are taken to.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    names = [name for name in dict.fromkeys(row["variant"] for row in rows) if name != reference]
    find = {(row["variant"], row["protocol"]): row for row in rows}
    figure = new_figure(0.9 + 0.28 * len(names))
    panels = figure.subplots(1, len(protocols), sharey=True, squeeze=False)[0]
    for axes, protocol in zip(panels, protocols, strict=True):
        for height, name in enumerate(reversed(names)):
            row = find[name, protocol]
            if row["difference_ci95"] is not None:
                axes.plot(row["difference_ci95"], [height, height], color="black", linewidth=1.2)
            axes.plot(row["difference"], height, "o", markersize=4.5, color=SOLID["color"])
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        axes.set_xlabel(f"{protocol}: NRMSE minus that of {reference} [-]")
    panels[0].set_yticks(range(len(names)), list(reversed(names)))
    caption = (
        f"Free-run error of each variant minus that of {reference}, mean over windows and seeds."
        " The bars are 95 % intervals over logs."
    )
    return Drawing("study", "Variants of the recipe", caption, figure)
