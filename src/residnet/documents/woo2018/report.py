"""What a run of configs/studies/woo2018/woo2018.yaml adds to the report of a fit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from residnet.core.files import whole
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
    """Write study.json, draw the figures of document 003 and return the section of the report.

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
    changes = {model: changes_of_error(files, model) for model in LEARNED}
    with whole(run / "study.json") as file:
        content = {"schema": "residnet.woo2018/1", "changes": changes}
        file.write_text(json.dumps(content, indent=1) + "\n")
    blocks = [about, *steady, _table(changes), *figures]
    return [Section("Document 003 (Woo et al. 2018)", blocks)]


def changes_of_error(files: RunFiles, model: str) -> dict[str, float | None]:
    """Return how a model changes the error of the linear one on unseen manoeuvres, by velocity.

    A change is the ratio of root mean square errors less one; None where a row is absent.
    """
    changes: dict[str, float | None] = {}
    for channel, group in _GROUPS.items():
        rows = [files.row(name, "test", PROTOCOL, group) for name in ("baseline", model)]
        errors = [None if row is None else row["rmse"][channel] for row in rows]
        changes[channel] = (
            None if errors[0] is None or errors[1] is None else errors[1] / errors[0] - 1
        )
    return changes


def _table(changes: Mapping[str, Mapping[str, float | None]]) -> Table:
    """Return the table of how much each LSTM changes the error of the linear model."""
    table = Table(
        ["model", "u %", "v %", "r %"],
        caption="Change of the root mean square error on unseen manoeuvres from the linear model to"
        " the LSTM. The document prints one figure for each velocity.",
    )
    for model, by_channel in changes.items():
        cells = [
            beside_published(
                None if change is None else 100 * change, 100 * CHANGE_OF_ERROR[channel], 3
            )
            for channel, change in by_channel.items()
        ]
        table.add(MODEL_NAMES[model], cells)
    return table
