"""Interactive figures: their data are those of the run, and a browser draws and works them."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from browser import browser, layout
from made_run import made_run, residuals

from residnet.report.fit import write_fit_page
from residnet.report.interactive.drawing import draw
from residnet.report.interactive.explorer import Case, Explorer, Look, Panel, thinned
from residnet.report.interactive.free_runs import explorers
from residnet.report.run_reader import RunFiles

_MOST_BYTES = 4_000_000


def run_with_residuals(folder: Path) -> RunFiles:
    run = made_run(folder)
    residuals().to_parquet(run / "residuals.parquet")
    return RunFiles(run)


def unpacked(columns: dict[str, object], name: str) -> np.ndarray:
    stored = columns[name]
    if isinstance(stored, str):
        return unpacked(columns, stored)
    assert isinstance(stored, list)
    low, step, text = stored
    levels = np.frombuffer(base64.b64decode(text), dtype="<u2")
    return np.where(levels == 65_535, np.nan, low + step * levels)


def test_cases_hold_their_curves_to_a_part_in_sixty_thousand() -> None:
    time = np.linspace(0, 40, 300)
    curve = np.where(time > 30, np.nan, 7 * np.sin(time))
    panel = {"a": (time, curve), "b": (time[:90], np.full(90, 3.0))}
    explorer = Explorer(
        "x", "X", "Look.", "Run", {"a": Look("a", "ink"), "b": Look("</script>", "#123456")},
        [Panel("p")], [Case("one", [panel]), Case("two", [{"b": (time, time)}])],
    )  # fmt: skip
    drawn = draw([explorer])
    assert drawn is not None
    assert "</script>" not in drawn.cases["x"]
    one, two = (case["panels"][0] for case in json.loads(drawn.cases["x"])["cases"])
    np.testing.assert_allclose(unpacked(one, "a"), curve, atol=14 / 60_000)
    np.testing.assert_allclose(unpacked(one, "x of a"), time, atol=40 / 60_000)
    assert np.isnan(unpacked(one, "b")[90:]).all()
    assert (unpacked(one, "b")[:90] == 3.0).all()
    assert np.isnan(unpacked(two, "a")).all(), "a case without a curve draws none"
    assert draw([]) is None


def test_thinning_keeps_both_ends() -> None:
    rows = thinned(10_001, 500)
    assert (rows[0], rows[-1], len(rows)) == (0, 10_000, 500)
    assert thinned(7, 500).tolist() == list(range(7))


def test_runs_to_choose_from_are_the_median_worst_and_best_of_each_kind(tmp_path: Path) -> None:
    found = {explorer.name: explorer for explorer in explorers(run_with_residuals(tmp_path / "r"))}
    assert set(found) == {"free-runs", "horizon", "residuals"}
    titles = [case.title for case in found["free-runs"].cases]
    for kind in ("zigzag", "turning"):
        assert any(title.startswith(f"{kind}, whole: median error") for title in titles)
    looks = found["free-runs"].looks
    assert looks["measured"].shown
    assert looks["plsr"].shown, "the selected model"
    assert looks["baseline"].shown
    assert not looks["zero"].shown
    track, surge = found["free-runs"].cases[0].curves[:2]
    assert np.isnan(track["measured"][0]).sum() == 10, "masked samples are a gap"
    assert np.isfinite(surge["plsr"][1]).all()


@pytest.mark.skipif(browser() is None, reason="no browser (chromium or chrome) is installed")
def test_a_browser_draws_every_panel_and_the_controls_work(tmp_path: Path) -> None:
    page = write_fit_page(run_with_residuals(tmp_path / "run"))
    assert page.stat().st_size < _MOST_BYTES
    for width in (390, 820):
        found = layout(page, width, tmp_path)
        assert (found.overflow, found.broken) == (0, []), width
        assert found.smallest >= 11
        assert len(found.panels) == 11
        assert all(found.panels), "every panel is drawn"
        assert found.used == {
            "focused": True,
            "zoomed": pytest.approx(0.5, abs=0.01),
            "reset": pytest.approx(1.0, abs=0.01),
            "hidden": True,
            "chosen": True,
        }
