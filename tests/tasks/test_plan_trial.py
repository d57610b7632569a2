"""The page, the table and the files of planned trials."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml
from read_page import Page, plain

from residnet.core.log import Log
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.tasks.fit.service import NextTrials


def trial(name: str, volume: float) -> Any:
    t = np.arange(0.0, 30.0, 0.5)
    channels = dict.fromkeys(("x", "y", "psi", "u", "v", "r"), 0.1 * t)
    flight = SimpleNamespace(
        true_log=Log(name, t, channels),
        manoeuvre=Zigzag(kind="zigzag", drive=0.5, steer=0.5, heading=0.3),
    )
    return SimpleNamespace(
        simulated_run=flight,
        duration_minutes=0.5,
        max_distance=12.0,
        uncertainty_reduction=0.25,
        volume_gain_per_minute=volume,
    )


def test_what_to_run_stands_in_table_page_and_files(tmp_path: Path) -> None:
    trials: Any = [trial("zigzag_1", 3.0), trial("turn_1", 2.0)]
    plan: Any = SimpleNamespace(
        candidates=trials, selected_trials=trials[:1], uncertainty_reduction=0.4
    )
    planned = NextTrials("hull", plan)
    text = planned.to_text().splitlines()
    assert text[0].startswith("Candidate trials for hull")
    assert text[2].split() == ["zigzag_1", "0.5", "12", "25.0", "3.00"]
    assert text[-1].startswith("Run zigzag_1: ")
    files = planned.write_files(tmp_path)
    assert [file.name for file in files] == ["next_trials.yaml", "next_tracks.csv", "report.html"]
    assert yaml.safe_load(files[0].read_text())["manoeuvres"][0]["kind"] == "zigzag"
    page = plain(files[2])
    assert "Run zigzag_1" in page.partition('id="at-a-glance"')[0]
    assert "<tr data-selected><th" in page
    assert Page(page).tables[0][1][0] == "zigzag_1"
