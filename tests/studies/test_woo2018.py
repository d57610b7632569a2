"""The figures of document 003 from a run folder made by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_run import complete_row, data_quality, metrics_file, stored, write_json

from residnet.core.errors import UsageError
from residnet.report.blocks import Table
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles
from residnet.studies import woo2018

KINDS = ("zigzag", "acceleration_deceleration", "three_two_one_one")
MODELS = (
    "constant_velocity",
    "nomoto",
    "nomoto_side_slip",
    "baseline",
    "lstm_printed",
    "lstm_rate",
    "lstm",
)
STATES = {"u": [0.5, 1.0, 1.5], "v": [-0.1, 0.0, 0.1], "r": [-0.2, 0.0, 0.2]}
FORCES = {"tau_x": [100.0, 200.0, 300.0], "tau_n": [-100.0, 0.0, 100.0]}
STEADY = {
    "steady_states": STATES | FORCES,
    "steady_constraints": {
        state: {"of": force, "phi": phi, "phi_error": 1e-5, "bias": 0.0, "bias_error": 0.01}
        for state, force, phi in (("u", "tau_x", 5e-3), ("v", "tau_n", 1e-3), ("r", "tau_n", 2e-3))
    },
}
COLUMNS = ("u", "v", "r", "psi", "x", "y")


def row(model: str, split: str, manoeuvre: str) -> dict[str, Any]:
    level = 0.01 * (len(MODELS) - MODELS.index(model)) * (0.8 if split == "train" else 1.0)
    rmse = {"u": 2 * level, "v": level, "r": 0.5 * level}
    kind = "head" if "lstm" in model else "baseline"
    return complete_row(
        rmse,
        model=model,
        kind=model if model == "constant_velocity" else kind,
        split=split,
        protocol="manoeuvre",
        manoeuvre=manoeuvre,
        rmse_ci95={name: [0.9 * value, 1.1 * value] for name, value in rmse.items()},
    )


def rollouts(folder: Path, log: str, size: float) -> None:
    """One log of 8 s; a model's velocities are off by `size` times its place in the list."""
    t = np.arange(81) * 0.1
    waves = (1.0 + 0.2 * np.sin(t), 0.1 * np.sin(2 * t), 0.2 * np.cos(t), 0.2 * np.sin(t))
    measured = dict(zip(COLUMNS, (*waves, t, 0.2 * t**2), strict=True))
    parts = []
    for place, model in enumerate(reversed(MODELS), start=1):
        wave = size * place * 0.02 * np.sin(3 * t + place)
        predicted = {name: measured[name] + wave for name in COLUMNS}
        parts.append(stored("manoeuvre", model, t, measured, predicted))
    folder.mkdir(parents=True, exist_ok=True)
    pd.concat(parts).to_parquet(folder / f"{log}.parquet")


def made_study(run: Path, kinds: tuple[str, ...] = KINDS) -> Path:
    rows = [
        row(model, split, group)
        for split in ("train", "test")
        for model in MODELS
        for group in ("all", "speed", "steering", *KINDS)
    ]
    fit = run / "models" / "baseline" / "fit.json"
    fit.parent.mkdir(parents=True)
    fit.write_text(json.dumps(STEADY))
    (run / "metrics.json").write_text(json.dumps(metrics_file(rows, "lstm")))
    manoeuvre_of_log = {}
    for kind in kinds:
        for number, size in enumerate((3.0, 1.0, 2.0)):
            log = f"{kind}_{number + 1:02d}"
            rollouts(run / "rollouts" / "test", log, size)
            manoeuvre_of_log[log] = kind
    write_json(run / "data_quality.json", data_quality(manoeuvre_of_log, "test"))
    return run


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_study(tmp_path_factory.mktemp("study") / "run")


def test_seven_figures_and_two_tables(study: Path) -> None:
    (section,) = woo2018.sections(RunFiles(study))
    stills = [
        path
        for block in section.blocks
        if isinstance(block, Figure)
        for path in block.static_images
    ]
    numbers = (9, *range(13, 19))
    assert stills == [study / "figures" / "woo2018" / f"{number}.png" for number in numbers]
    assert all(path.stat().st_size > 5_000 for path in stills)
    steady, changes = (block for block in section.blocks if isinstance(block, Table))
    # made up: the error of the linear model is 0.04, that of the best LSTM 0.01
    last = changes.rows[-1].cells[0]
    assert (last.text, last.note) == ("−75.0", "published −76.9")
    written = json.loads((study / "study.json").read_text())["changes"]
    assert written["lstm"]["u"] == pytest.approx(-0.75)
    yaw = steady.rows[-1].cells
    # 2e-3 rad/s per N m is 0.1146 deg/s; Table 1 corrected has .0330 (W12) and 1.287 (W13)
    assert (yaw[0].text, yaw[0].note) == ("0.115", "published 0.033")
    assert yaw[2].note == "published 1.29"


def test_figures_show_the_stored_numbers_of_the_typical_run(study: Path) -> None:
    figures = {figure.name: figure for figure in woo2018.build_figures(RunFiles(study))}
    stored = pd.read_parquet(study / "rollouts" / "test" / "zigzag_03.parquet")
    # Figure 13: sway and yaw rate in the zigzag of the median error, errors below each
    panels = figures["13"].panels
    shown = figures["13"].cases[0].curves
    assert panels[2].title == "zigzag_03"
    assert "deg/s" in panels[2].y_label
    for model in ("baseline", "nomoto"):
        own = stored[stored.model == model]
        np.testing.assert_allclose(shown[2][model][1], np.degrees(own["r_hat"]))
        np.testing.assert_allclose(shown[2]["measured"][1], np.degrees(own["r"]))
        np.testing.assert_allclose(shown[3][model][1], np.degrees(own["r_hat"] - own["r"]))
    # Figure 17: bars are the rows of metrics.json, dots the runs over the linear model
    bars, dots = figures["17"].cases[0].curves[2:]
    heights = bars["test"][1].reshape(-1)[1::5]
    expected = np.degrees(row("nomoto", "test", "steering")["rmse"]["r"])
    assert heights[0] == pytest.approx(expected)
    assert np.asarray(dots["baseline"][1]) == pytest.approx(np.ones(6))
    assert len(dots["lstm"][1]) == 6


def test_a_missing_manoeuvre_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"needs a test manoeuvre of kind {KINDS[0]}"):
        woo2018.sections(RunFiles(made_study(tmp_path / "run", kinds=KINDS[1:])))
