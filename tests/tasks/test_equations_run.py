"""A run with equations: over a baseline, over none, and with late inputs; in its notes, its report
and its figures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from read_page import plain
from tiny import TINY, call, read_json, write_yaml

from residnet.dynamics.store import load_model
from residnet.report.figure_files import read_figures

pytestmark = pytest.mark.long

HEAD = {"kind": "symbolic", "features": ["u", "v", "r", "tau_x", "tau_n"]}
WEAK = {"kind": "weak", "window": "2 s"}
CONFIG: dict[str, Any] = {
    **TINY,
    "name": "equations",
    "training": {},
    "ensembles": {},
    "baselines": {"nothing": {"kind": "still"}},
    "base_of": {"whole": "nothing"},
    "heads": {
        "equation": HEAD,
        "whole": HEAD | {"estimator": WEAK, "choose": "free_run"},
        "late": HEAD | {"delay": {"channels": ["tau_x", "tau_n"], "longest": 4}},
    },
    "export": {"models": ["late"]},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("equations")
    file = write_yaml(folder / "config.yaml", CONFIG)
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", file, "--out", folder / "run") == 0
    return folder / "run"


@pytest.fixture(scope="module")
def notes(run: Path) -> dict[str, Any]:
    return {path.parent.name: read_json(path) for path in run.glob("models/*/fit.json")}


def test_equations_predict_and_stand_in_writing(notes: dict[str, Any]) -> None:
    assert notes["equation"]["validation"] < 0.9 * notes["baseline"]["validation"]
    assert notes["whole"]["validation"] < 0.5 * notes["nothing"]["validation"]
    assert len(notes["whole"]["free_run_choice"]) >= 2
    for model in ("equation", "whole", "late"):
        own = notes[model]
        assert list(own["equations"]) == ["u_dot", "v_dot", "r_dot"]
        for name, equation in own["equations"].items():
            assert equation["text"].startswith(f"{name} = ")
            given = "double u, double v, double r, double tau_x, double tau_n"
            assert equation["c"].count(f"double {name}({given})") == 1
        assert own["parameters"] == len(own["coefficients"]) == sum(own["kept"])
    assert 0 <= notes["late"]["delay"]["steps"] <= 4
    assert len(notes["late"]["delay"]["profile"]) == 5


def test_terms_along_a_log_add_up_to_what_the_head_says(run: Path, notes: dict[str, Any]) -> None:
    table = pd.read_parquet(run / "terms.parquet")
    assert set(table["model"]) == {"equation", "whole", "late"}
    assert set(table["log"]) <= {path.stem for path in (run / "rollouts" / "test").iterdir()}
    for model in ("equation", "whole"):
        coefficients = {(c["axis"], c["term"]) for c in notes[model]["coefficients"]}
        own = table[(table["model"] == model) & (table["term"] != "target")]
        assert set(zip(own["axis"], own["term"], strict=True)) == coefficients
        _, module = load_model(run / "models" / model)
        assert int((module.double().head.coefficients != 0).sum()) == len(coefficients)
        # target and sum of the terms agree as well as the fit says
        for axis in ("u_dot", "r_dot"):
            rows = table[(table["model"] == model) & (table["axis"] == axis)]
            wide = rows.pivot(index="t", columns="term", values="value").dropna()
            left = wide["target"] - wide.drop(columns="target").sum(axis=1)
            assert float(left.std()) < float(wide["target"].std())


def test_report_and_figures_show_the_equations(run: Path, notes: dict[str, Any]) -> None:
    titles = {figure.title for figure in read_figures(run / "figures")}
    assert titles >= {f"Equation of {model}, term by term" for model in CONFIG["heads"]}
    text = plain(run / "report.html")
    assert "Equations of equation" in text
    assert "candidate terms are linearly independent on these data (condition number" in text
    seconds = notes["late"]["delay"]["seconds"]
    assert f"Delayed inputs act {seconds:g} s after they are given." in text
    assert notes["whole"]["coefficients"][0]["term"] in text
