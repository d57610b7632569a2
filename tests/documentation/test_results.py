"""Figures in the pages name sources that exist, and are read from runs as they stand there."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
import results

ROOT = Path(__file__).resolve().parents[2]


def test_figures_of_all_pages_name_existing_sources() -> None:
    origins = [origin for page in results.list_pages() for origin, _ in results.find_figures(page)]
    assert len(origins) > 40
    for origin in origins:
        name, file, *rest = origin.split()
        assert name in results.SOURCES, origin
        assert file == "stdout" or file.endswith(".json"), origin
        assert len(rest) in (1, 2, 3), origin
        assert not rest[1:] or re.fullmatch(r"deg|x[0-9.e-]+", rest[1]), origin
    for command in results.SOURCES.values():
        assert (ROOT / command[0]).is_file(), command


def test_rewrite_page_inserts_figures_of_runs(tmp_path: Path) -> None:
    run = tmp_path / "quickstart"
    run.mkdir()
    rows = [{"model": "a", "value": 1}, {"model": "b", "value": [0.123456, 2.0]}]
    (run / "metrics.json").write_text(json.dumps({"rows": rows}))
    (run / "stdout").write_text("right in 58 of 60 runs")
    page = tmp_path / "page.md"
    marks = ("metrics.json rows[model=b].value x100", r"stdout in\s(\d+\sof\s60)")
    page.write_text("".join(f"<!--= quickstart {mark} -->old<!--/-->; " for mark in marks))
    assert results.rewrite_page(page, tmp_path, ["quickstart"]) == 0
    assert results.rewrite_page(page, tmp_path, []) == 2
    assert [text for _, text in results.find_figures(page)] == ["12.3 / 200", "58 of 60"]
    with pytest.raises(LookupError, match="no entry with model=c"):
        results.read_figure("quickstart metrics.json rows[model=c].value", tmp_path)


def test_main_rewrites_figures_of_finished_runs_and_names_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    made = {name: (str(tmp_path / f"{name}.py"), "7") for name in ("good", "bad", "long", "other")}
    lines = [f"<!--= {name} stdout took\\s(\\d+) -->old<!--/-->" for name in made]
    page = tmp_path / "page.md"
    good = tmp_path / "good.py"
    page.write_text("\n".join(lines))
    good.write_text("import sys; print('took', sys.argv[1])")
    (tmp_path / "bad.py").write_text("raise SystemExit('no such luck')")
    (tmp_path / "long.py").write_text("import time; time.sleep(60)")
    monkeypatch.setattr(results, "list_pages", lambda: [page])
    monkeypatch.setattr(results, "SOURCES", made)
    monkeypatch.setattr(results, "hash_inputs", lambda: "now")
    monkeypatch.setattr(results, "run_git", lambda *arguments: "abc")
    call = ["results.py", "--runs", str(tmp_path / "runs"), "--only", "good,bad,long"]
    monkeypatch.setattr(sys, "argv", [*call, "--minutes", "0.03"])

    def said() -> str:
        results.main()
        return capsys.readouterr().out

    told = said()
    assert [text for _, text in results.find_figures(page)] == ["7", "old", "old", "old"]
    for words in (
        "1 figures changed; the figures of this call are of commit abc.",
        "not run: bad: failed: no such luck",
        "not run: long: takes longer than 0.03 minutes",
        "not run: other: not selected",
    ):
        assert words in told
    # what is finished is not run again, unless its command or its source is another one
    monkeypatch.setattr(sys, "argv", [*call[:-1], "good"])
    assert "running good" not in said()
    made["good"] = (str(good), "8")
    said()
    assert next(text for _, text in results.find_figures(page)) == "8"
    good.write_text("print('took long')")
    monkeypatch.setattr(results, "hash_inputs", lambda: "later")
    assert "has no figure good stdout" in said()
