"""Task `breeding`, and the record of document 000 chapter 5 that it works on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_page import plain
from scipy.integrate import solve_ivp
from tiny import Command, read_json, write_yaml

from residnet.studies.halvorsen2019.breeding.config import (
    TRUE_COEFFICIENTS,
    NoiseConfig,
    RecordConfig,
)

SMALL: dict[str, Any] = {
    "task": "breeding",
    "name": "small",
    "head": {
        "kind": "genetic",
        "final": None,
        "evolution": {"operators": ["+", "*", "abs"], "split": "sum", "generations": 5},
    },
    "rows": {"key": "head.evolution.population", "values": [10, 300]},
    "columns": {"key": "noise.factor", "values": [0.0, 0.5]},
    "repeats": 3,
    "published": [[1, 0], [3, None]],
}


def test_record_against_scipy() -> None:
    config = RecordConfig(length=20.0)
    record = config.simulate(config.period)
    t = 0.1 * np.arange(200)

    def rate(_: float, y: np.ndarray) -> list[float]:
        """Before the first jump."""
        return [y[1], (1.0 - 13 * y[1] - 5 * y[0]) / 10]

    answer = solve_ivp(rate, (0, 9.0), [0, 0], t_eval=t[:90], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(record["x"][:90], answer.y[0], atol=1e-7)
    np.testing.assert_allclose(
        record["u_dot"], -1.3 * record["u"] + 0.1 * record["tau_x"] - 0.5 * record["x"], atol=1e-15
    )
    assert pytest.approx({"tau_x": 0.1, "u": -1.3, "x": -0.5}) == TRUE_COEFFICIENTS
    assert set(record["tau_x"]) == {-1.0, 1.0}


@pytest.mark.parametrize(
    ("on", "noisy"),
    [("output", {"u_dot"}), ("inputs", {"x", "u", "tau_x"}), ("all", {"x", "u", "tau_x", "u_dot"})],
)
def test_noise_as_a_share_of_the_range(on: str, noisy: set[str]) -> None:
    record = RecordConfig().simulate(18.0)
    made = NoiseConfig.model_validate({"on": on, "factor": 0.2}).add_noise(
        record, np.random.default_rng(0)
    )
    for name, values in record.items():
        largest = np.abs(made[name] - values).max()
        assert (0.19 < largest / np.ptp(values) <= 0.2) if name in noisy else largest == 0


def test_a_grid_runs(tmp_path: Path, command: Command) -> None:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    run = tmp_path / "run"
    assert command("run", write_yaml(tmp_path / "c.yaml", SMALL), "--out", run).code == 0
    cells = {(row["row"], row["column"]): row for row in read_json(run / "study.json")["rows"]}
    # what has no published number is left out
    assert set(cells) == {(10, 0.0), (10, 0.5), (300, 0.0)}
    good = cells[300, 0.0]
    assert good["found"] == good["published_found"] == len(good["equations"]) == 3
    assert good["error"] < 1e-20
    assert cells[10, 0.5]["found"] == 0
    summary = read_json(run / "summary.json")
    assert summary["finished"]
    assert summary["figures"]["share of runs that find the equation"]["value"] >= 3 / 9
    assert "of the 30 runs of the same table" in " ".join(summary["verdict"])
    assert "published 3; " in plain(run / "report.html")
    assert (run / "figures" / "study.png").stat().st_size > 1000


def test_a_late_force_and_its_correction() -> None:
    """The force that acts and the one that the record tells move by themselves."""
    plain = RecordConfig(length=30.0)
    late = RecordConfig(length=30.0, delay=0.5)
    told = RecordConfig(length=30.0, delay=0.5, corrected=0.5).simulate(10.0)
    record = late.simulate(10.0)
    np.testing.assert_array_equal(record["tau_x"], plain.simulate(10.0)["tau_x"])
    np.testing.assert_array_equal(told["tau_x"][5:], record["tau_x"][:-5])
    np.testing.assert_array_equal(told["u_dot"], record["u_dot"])
    explained = -1.3 * told["u"] + 0.1 * told["tau_x"] - 0.5 * told["x"]
    np.testing.assert_allclose(told["u_dot"], explained, atol=1e-15)
    silent = NoiseConfig(on="none", factor=0.5).add_noise(told, np.random.default_rng(0))
    assert all((silent[name] == told[name]).all() for name in told)
