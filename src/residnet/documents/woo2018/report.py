"""What a run of configs/studies/woo2018/woo2018.yaml adds to the report of a fit."""

from __future__ import annotations

from pathlib import Path

from residnet.documents.cells import beside_published
from residnet.documents.woo2018.figures import LEARNED, draw
from residnet.documents.woo2018.panels import MODEL_NAMES, PROTOCOL
from residnet.documents.woo2018.published import CHANGE_OF_ERROR
from residnet.documents.woo2018.steady import steady_figure, steady_table
from residnet.report.blocks import Block, Section, Table, Text
from residnet.report.run_reader import RunFiles

_GROUPS = {"u": "speed", "v": "steering", "r": "steering"}
"""Group of manoeuvres that each velocity is judged on, as in Figures 16 and 17."""


def sections(run: Path) -> list[Section]:
    """Draw the figures of document 003 and return the study's section of the report.

    Raises:
        UsageError: where the run lacks a kind of manoeuvre or a model of the study.
    """
    files = RunFiles(run)
    figures = draw(files)
    about = Text(
        "The runs are simulated, with 126 manoeuvres as in the document. Its vessel and its logs"
        " are not public: its figures are comparable in kind and not in size. Beside the document's"
        " manoeuvres stand further acceleration tests that no fit sees, so that surge is judged on"
        " more than two. The plant's own terms are among the candidates of closed-form heads;"
        " configs/studies/woo2018/outside_terms.yaml compares networks and closed forms on a plant"
        " whose terms none of them has."
    )
    steady: list[Block] = [steady_table(files), steady_figure(files)]
    blocks = [about, *steady, _changes(files), *figures]
    return [Section("Document 003 (Woo et al. 2018)", blocks)]


def _changes(files: RunFiles) -> Table:
    """Return how much each LSTM changes the error of the linear model on unseen manoeuvres."""
    table = Table(
        ["model", "u %", "v %", "r %"],
        caption="Change of the root mean square error on unseen manoeuvres from the linear model to"
        " the LSTM. The document prints one figure for each velocity.",
    )
    for model in LEARNED:
        cells = []
        for channel, group in _GROUPS.items():
            rows = [files.row(name, "test", PROTOCOL, group) for name in ("baseline", model)]
            errors = [None if row is None else float(row["rmse"][channel]) for row in rows]
            change = (
                None
                if errors[0] is None or errors[1] is None
                else 100 * (errors[1] / errors[0] - 1)
            )
            cells.append(beside_published(change, 100 * CHANGE_OF_ERROR[channel], 3))
        table.add(MODEL_NAMES[model], cells)
    return table
