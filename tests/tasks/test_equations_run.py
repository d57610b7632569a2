"""A run with equations: over a baseline, over none, and with late inputs; in its notes, its report,
its figures and its exports.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from read_page import plain
from tiny import TINY, call

from residnet.dynamics.store import load_model
from residnet.report.figure_files import read_figures

pytestmark = pytest.mark.long

FEATURES = ["u", "v", "r", "tau_x", "tau_n"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("equations")
    config: dict[str, Any] = copy.deepcopy(TINY)
    config |= {
        "name": "equations",
        "training": {},
        "ensembles": {},
        "baselines": {"nothing": {"kind": "still"}},
        "base_of": {"whole": "nothing"},
    }
    config["heads"] = {
        "equation": {"kind": "symbolic", "features": FEATURES},
        "whole": {
            "kind": "symbolic",
            "features": FEATURES,
            "estimator": {"kind": "weak", "window": "2 s"},
            "choose": "free_run",
        },
        "late": {
            "kind": "symbolic",
            "features": FEATURES,
            "delay": {"channels": ["tau_x", "tau_n"], "longest": 4},
        },
    }
    config["export"] = {"models": ["whole", "late"]}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", folder / "config.yaml", "--out", folder / "run") == 0
    return folder / "run"


def notes(run: Path, model: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "models" / model / "fit.json").read_text())
    return content


def test_equations_predict_better_than_the_baseline_and_stand_alone(run: Path) -> None:
    assert notes(run, "equation")["validation"] < 0.9 * notes(run, "baseline")["validation"]
    assert notes(run, "whole")["validation"] < 0.5 * notes(run, "nothing")["validation"]
    assert len(notes(run, "whole")["free_run_choice"]) >= 2


def test_notes_hold_the_equations_in_writing(run: Path) -> None:
    for model in ("equation", "whole", "late"):
        own = notes(run, model)
        assert list(own["equations"]) == ["u_dot", "v_dot", "r_dot"]
        for name, equation in own["equations"].items():
            assert equation["text"].startswith(f"{name} = ")
            assert (
                equation["c"].count(
                    f"double {name}(double u, double v, double r, double tau_x, double tau_n)"
                )
                == 1
            )
        assert own["parameters"] == len(own["coefficients"]) == sum(own["kept"])
    assert 0 <= notes(run, "late")["delay"]["steps"] <= 4
    assert len(notes(run, "late")["delay"]["profile"]) == 5


def test_terms_along_a_log_add_up_to_what_the_head_says(run: Path) -> None:
    table = pd.read_parquet(run / "terms.parquet")
    assert set(table["model"]) == {"equation", "whole", "late"}
    rollouts = {path.stem for path in (run / "rollouts" / "test").glob("*.parquet")}
    assert set(table["log"]) <= rollouts
    for model in ("equation", "whole"):
        coefficients = {
            (c["axis"], c["term"]): c["value"] for c in notes(run, model)["coefficients"]
        }
        own = table[(table["model"] == model) & (table["term"] != "target")]
        assert set(zip(own["axis"], own["term"], strict=True)) == set(coefficients)
        _, module = load_model(run / "models" / model)
        stored = module.double().head.coefficients
        assert int((stored != 0).sum()) == len(coefficients)
        # target and sum of the terms agree as well as the fit says
        for axis in ("u_dot", "r_dot"):
            rows = table[(table["model"] == model) & (table["axis"] == axis)]
            wide = rows.pivot(index="t", columns="term", values="value").dropna()
            left = wide["target"] - wide.drop(columns="target").sum(axis=1)
            assert float(left.std()) < float(wide["target"].std())


def test_report_and_figures_show_the_equations(run: Path) -> None:
    titles = [figure.title for figure in read_figures(run / "figures")]
    assert {f"Equation of {model}, term by term" for model in ("equation", "whole", "late")} <= set(
        titles
    )
    text = plain(run / "report.html")
    assert "Equations of equation" in text
    assert "candidate terms differ on these data (condition number" in text
    seconds = notes(run, "late")["delay"]["seconds"]
    assert f"Delayed inputs act {seconds:g} s after they are given." in text
    term = notes(run, "whole")["coefficients"][0]["term"]
    assert term in text


def test_the_late_equation_exports_with_its_memory(run: Path) -> None:
    """The export itself compares the module with the model from a warmed-up memory; here: the
    memory is that of the delay, and whether it has begun.
    """
    extra = {"card.json": ""}
    module = torch.jit.load(str(run / "exports" / "late.pt"), _extra_files=extra)
    assert json.loads(extra["card.json"])["memory"] == 1 + 4 * 2
    spec, model = load_model(run / "models" / "late")
    random = np.random.default_rng(0)
    past = torch.from_numpy(random.normal(size=(1, 9, 6)) * 0.1).float()
    drive = torch.from_numpy(random.uniform(5, 20, size=(1, 9, 2))).float()
    with torch.no_grad():
        torch.testing.assert_close(
            module.warmup(past, drive), model.float().warmup(past, drive), rtol=1e-5, atol=1e-5
        )
    assert spec.head is not None
    assert spec.head.kind == "symbolic"
