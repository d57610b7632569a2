"""Tables of variants against sums by hand, and the picture that they make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_run import made_run

from residnet.core.errors import DataError
from residnet.judge.metrics import blocks, intervals
from residnet.report.sections.study import (
    Variant,
    differences,
    table,
    variants_table,
    window_nrmse,
)

KEYS = {"T30": tuple((f"log{i // 3}", i % 3) for i in range(18))}


def variants(shift: float, seeds: int = 3, draw: int = 0) -> list[Variant]:
    random = np.random.default_rng(draw)
    level = random.uniform(0.1, 0.3, 18)
    plain = level + random.normal(0, 0.01, (seeds, 18))
    other = level + shift + random.normal(0, 0.01, (seeds, 18))
    return [
        Variant("recipe", (), {"T30": plain}, (10.0,) * seeds),
        Variant("other", ("a=1",), {"T30": other}, (20.0,) * seeds),
    ]


def test_rows_are_means_over_windows_and_seeds() -> None:
    chosen = variants(0.05)
    recipe, other = table(chosen, KEYS, "recipe")
    errors = chosen[1].errors["T30"]
    assert other["nrmse_mean"] == pytest.approx(errors.mean())
    assert other["nrmse_sd"] == pytest.approx(np.std([errors[s].mean() for s in range(3)], ddof=1))
    assert other["nrmse_range"] == pytest.approx([errors.mean(1).min(), errors.mean(1).max()])
    apart = errors.mean(0) - chosen[0].errors["T30"].mean(0)
    assert other["difference"] == pytest.approx(apart.mean())
    (expected,) = intervals(apart[:, None], blocks([i // 3 for i in range(18)]))
    assert other["difference_ci95"] == expected
    assert recipe["difference"] == 0.0
    assert recipe["difference_ci95"] is None
    assert (other["windows"], other["seeds"], other["seconds"]) == (18, 3, 20.0)


def test_one_seed_has_no_spread_and_the_reference_no_difference() -> None:
    rows = table(variants(0.05, seeds=1), KEYS, "recipe")
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
