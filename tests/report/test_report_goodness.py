"""The section on goodness of fit shows the numbers of goodness.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_run import DEG, made_run, write_fit_page, write_json
from made_series import autoregressive

from residnet.core.format import number
from residnet.judge.goodness import OneStep, content, table
from residnet.report.blocks import Section, Table, Text
from residnet.report.run_reader import RunFiles
from residnet.report.sections.models import goodness


def test_section_shows_what_the_file_says(tmp_path: Path) -> None:
    run = made_run(tmp_path)
    assert goodness(RunFiles(run)) is None
    assert 'id="goodness-of-fit"' not in write_fit_page(RunFiles(run)).read_text()
    target = autoregressive(0.9, 3, 800, seed=0).T
    models = [
        OneStep("baseline", "baseline", [4, 4, 4], [0.5 * target]),
        OneStep(
            "plsr",
            "head",
            [9, 9, 9],
            [0.4 * target + 0.01 * np.random.default_rng(0).normal(size=target.shape)],
            "baseline",
        ),
    ]
    rows = table(models, [target], 0.1)
    write_json(run / "goodness.json", content("made", {"train": rows, "test": rows}, 0.1))
    section = goodness(RunFiles(run))
    assert section is not None
    parts = [part for part in section.shown if isinstance(part, Section)]
    assert [part.title for part in parts] == [
        "surge u′ [m/s²], test data",
        "sway v′ [m/s²], test data",
        "yaw r′ [deg/s²], test data",
    ]
    fits, residuals, sentences = parts[2].shown
    assert isinstance(fits, Table)
    assert isinstance(residuals, Table)
    assert isinstance(sentences, Text)
    fitted = {line.label: line.cells for line in fits.rows}
    yaw = {line.label: line.cells for line in residuals.rows}
    row = next(row for row in rows if row["model"] == "plsr" and row["axis"] == "r_dot")
    texts = [cell.text for cell in fitted["plsr"]]
    assert texts[:3] == ["9.00", number(DEG * row["rmse"]), number(row["r2"])]
    low, high = (number(DEG * end) for end in row["mae_ci95"])
    assert yaw["plsr"][1].text == f"{low} to {high}"
    assert yaw["plsr"][-1].note == "to baseline"
    assert yaw["plsr"][-1].mark == "best"
    assert yaw["baseline"][-1].text == "–"
    assert "times too narrow" in sentences.lines[0]
    assert 'id="goodness-of-fit"' in write_fit_page(RunFiles(run)).read_text()
