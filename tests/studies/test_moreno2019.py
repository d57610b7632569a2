"""The tables of document 001 from a run folder made by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from kinds import of_kind
from made_run import complete_row, metrics_file, stored

from residnet.report.blocks import Cell, Table, Text
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles
from residnet.studies import moreno2019
from residnet.studies.moreno2019 import GridNotes, grid_errors, grid_figures

MODELS = (
    *(
        "constant_velocity",
        "baseline",
        "rbf_joint",
        "rbf_each",
        "p1_joint",
        "p1_each",
        "p2_joint",
        "p2_each",
    ),
    *("symbolic", "gptips"),
)
COLUMNS = ("u", "v", "r", "psi", "x", "y")


def write(run: Path, split: str, models: tuple[str, ...]) -> None:
    """One record of 400 s: model k is off by (k + 1) cm/s in u and v, and in r by so many mrad/s,
    with changing sign.
    """
    t = np.arange(2000) * 0.2
    measured = {name: np.sin(0.01 * (k + 1) * t) for k, name in enumerate(COLUMNS)}
    parts = []
    for number, model in enumerate(models, start=1):
        sign = np.where(np.sin(0.3 * t + number) > 0, 1.0, -1.0)
        off = {name: number * (1e-3 if name == "r" else 1e-2) * sign for name in COLUMNS}
        predicted = {name: measured[name] + off[name] for name in COLUMNS}
        # off by 5 m/s where it is not to be scored
        usable = t > 20.0
        predicted["u"] = np.where(usable, predicted["u"], 5.0)
        parts.append(stored("record", model, t, measured, predicted, usable))
    folder = run / "rollouts" / split
    folder.mkdir(parents=True)
    pd.concat(parts).to_parquet(folder / f"{split}_1.parquet")


def made(run: Path, models: tuple[str, ...] = MODELS) -> Path:
    kinds = {"constant_velocity": "constant_velocity", "baseline": "baseline"}
    rmse = dict.fromkeys("uvr", 1.0)
    about = {"split": "test", "protocol": "record"}
    rows = [
        complete_row(rmse, model=model, kind=kinds.get(model, "head"), **about) for model in models
    ]
    (run / "metrics.json").write_text(json.dumps(metrics_file(rows, "rbf_joint")))
    (run / "figures").mkdir()
    for split in ("train", "validation", "test"):
        write(run, split, models)
    return run


def test_tables_hold_the_errors_of_the_records(tmp_path: Path) -> None:
    (section,) = moreno2019.sections(RunFiles(made(tmp_path)))
    errors, _, figure, _ = section.blocks
    content = json.loads((tmp_path / "study.json").read_text())
    found = {(row["model"], row["split"]) for row in content["rows"]}
    assert found == {(m, s) for m in MODELS for s in ("train", "validation", "test")}
    for row in content["rows"]:
        number = MODELS.index(row["model"]) + 1
        assert row["u"] == pytest.approx(1e-2 * number)
        assert row["r"] == pytest.approx(1e-3 * number)
        assert row["u_ci95"][0] <= row["u"] * 1.0001
        assert row["u_ci95"][1] >= row["u"] * 0.9999
    rows = {(row["model"], row["split"]): row for row in content["pairs"]}
    # of squares: (3 / 4)^2 - 1
    assert rows["rbf_joint", "test"]["v"] == pytest.approx(9 / 16 - 1)
    assert isinstance(errors, Table)
    cells = {(row.label, row.cells[0].text): row.cells for row in errors.rows}
    shown = cells["polynomial p = 2, joint tuning", "test"][1]
    assert shown == Cell("0.0700", "0.0700 to 0.0700; published 0.2249")
    assert isinstance(figure, Figure)
    assert figure.static_images[0].stat().st_size > 10_000


def test_the_curves_are_what_the_search_tried() -> None:
    tried: list[dict[str, Any]] = [
        {"sigma": [width] * 3, "penalty": [penalty] * 3, "validation": width + penalty}
        for width in (1.0, 10.0)
        for penalty in (0.01, 0.1, 1.0)
    ]
    own_width = {"sigma": [1.0, 1.0, 10.0], "penalty": [0.1] * 3, "validation": 0.5}
    none = {"penalty": [], "validation": 1.0}
    choice = [entry | {"diverged": 0} for entry in (*tried, own_width, none)]
    errors = np.arange(1.0, 19.0).reshape(2, 3, 3)
    notes = GridNotes.model_validate(
        {"free_run_choice": choice, "cross_validated_error": errors.tolist()}
    )
    grid, one_step = grid_errors(notes)
    widths = {(one["penalty"][0], one["sigma"][0]): one["validation"] for one in tried}
    assert grid == widths
    assert one_step[0.01, 1.0] == 1.0
    assert one_step[0.1, 10.0] == pytest.approx(np.mean([13 / 1, 14 / 2, 15 / 3]))
    over_penalty, over_width = grid_figures(notes)
    x, y = over_penalty.cases[0].curves[0]["sigma = 10"]
    assert list(x) == [0.01, 0.1, 1.0]
    assert y == pytest.approx(10.0 + x)
    assert [figure.name for figure in (over_penalty, over_width)] == ["5", "6"]


def test_a_run_without_the_optional_package_says_what_it_lacks(tmp_path: Path) -> None:
    (section,) = moreno2019.sections(RunFiles(made(tmp_path, MODELS[:-1])))
    said = of_kind(section.blocks[0], Text)
    assert "Not run: symbolic regression, GPTIPS settings" in str(said)
