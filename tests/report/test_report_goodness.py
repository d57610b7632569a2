"""The section on goodness of fit shows the numbers of goodness.json; a folder without it has none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_run import DEG, made_run, write_json
from made_series import autoregressive

from residnet.judge.goodness import OneStep, content, table
from residnet.report.fit import write_report
from residnet.report.run_reader import RunFiles
from residnet.report.sections.goodness import section
from residnet.report.tables import number


def test_section_shows_what_the_file_says(tmp_path: Path) -> None:
    run = made_run(tmp_path)
    assert section(RunFiles(run)) == []
    assert 'id="goodness"' not in write_report(run).read_text()
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
    parts = section(RunFiles(run))
    assert [part["title"] for part in parts] == [
        "surge u′ [m/s/s], test data",
        "sway v′ [m/s/s], test data",
        "yaw r′ [deg/s/s], test data",
    ]
    yaw = dict(parts[2]["table"].rows)
    row = next(row for row in rows if row["model"] == "plsr" and row["axis"] == "r_dot")
    texts = [cell.text for cell in yaw["plsr"]]
    assert texts[:3] == ["9.00", number(DEG * row["rmse"]), number(row["r2"])]
    assert texts[8] == f"{number(DEG * row['mae_ci95'][0])} to {number(DEG * row['mae_ci95'][1])}"
    assert yaw["plsr"][-1].note == "baseline"
    assert yaw["plsr"][-1].mark == "best"
    assert yaw["baseline"][-1].text == "–"
    assert "times too narrow" in parts[0]["sentences"][0]
    assert 'id="goodness"' in write_report(run).read_text()
