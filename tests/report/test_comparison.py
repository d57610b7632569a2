"""Tables of variants against sums by hand, and the picture that they make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from made_run import made_run

from residnet.core.errors import DataError
from residnet.judge.metrics import blocks, intervals
from residnet.tasks.study import differences, variant_rows, variants_table, window_nrmse

KEYS = [(f"log{i // 3}", i % 3) for i in range(18)]


def variants(shift: float, seeds: int = 3) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Return the errors of two variants by window, and as arrays [seeds, windows] by variant."""
    random = np.random.default_rng(0)
    level = random.uniform(0.1, 0.3, 18)
    arrays = {
        name: level + by + random.normal(0, 0.01, (seeds, 18))
        for name, by in (("recipe", 0.0), ("other", shift))
    }
    tables = {
        (name, seed): pd.DataFrame(KEYS, columns=["log", "window"]).assign(
            protocol="T30", nrmse=of_seed, diverged=[seed == 1, *[False] * 17]
        )
        for name, found in arrays.items()
        for seed, of_seed in enumerate(found)
    }
    return pd.concat(tables, names=["variant", "seed"]), arrays


def test_rows_are_means_over_windows_and_seeds() -> None:
    table, arrays = variants(0.05)
    recipe, other = variant_rows(table, "recipe")
    errors = arrays["other"]
    assert other["nrmse_mean"] == pytest.approx(errors.mean())
    assert other["nrmse_sd"] == pytest.approx(np.std([errors[s].mean() for s in range(3)], ddof=1))
    assert other["nrmse_range"] == pytest.approx([errors.mean(1).min(), errors.mean(1).max()])
    apart = errors.mean(0) - arrays["recipe"].mean(0)
    assert other["difference"] == pytest.approx(apart.mean())
    (expected,) = intervals(apart[:, None], blocks([i // 3 for i in range(18)]))
    assert other["difference_ci95"] == pytest.approx(expected)
    assert recipe["difference"] == 0.0
    assert recipe["difference_ci95"] is None
    assert (other["windows"], other["seeds"], other["diverged"]) == (18, 3, 1)


def test_one_seed_has_no_spread_and_the_reference_no_difference() -> None:
    rows = variant_rows(variants(0.05, seeds=1)[0], "recipe")
    for row in rows:
        row |= {"overrides": [], "seconds": 10.0}
    assert rows[1]["nrmse_sd"] is None
    recipe, other = variants_table(rows, "recipe").rows
    assert [cell.text for cell in recipe.cells[:4]] == [f"{rows[0]['nrmse_mean']:.4f}", "–", "", ""]
    low, high = rows[1]["difference_ci95"]
    assert (other.cells[3].text, other.cells[3].mark) == (f"+{low:.4f} to +{high:.4f}", "best")
    figure = differences(rows, "recipe")
    assert figure.cases[0].curves[0]["difference"][0].tolist() == [rows[1]["difference"]]


def test_a_run_without_the_model(tmp_path: Path) -> None:
    run = made_run(tmp_path / "made")
    with pytest.raises(DataError, match="no model 'gru'"):
        window_nrmse(run, "gru", "test")
    with pytest.raises(DataError, match="split 'train'"):
        window_nrmse(run, "selected", "train")
