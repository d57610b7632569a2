"""Figures in the pages name sources that exist, and are read from runs as they stand there."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def results() -> ModuleType:
    spec = importlib.util.spec_from_file_location("results", ROOT / "scripts" / "results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["results"] = module
    spec.loader.exec_module(module)
    return module


def test_every_figure_names_a_source_that_exists(results: ModuleType) -> None:
    found = [where for page in results.pages() for where, _ in results.marks(page)]
    assert len(found) > 40
    for where in found:
        name, file, *rest = where.split()
        assert name in results.SOURCES, where
        assert file == "stdout" or file.endswith(".json"), where
        assert len(rest) in (1, 2, 3), where
        assert not rest[1:] or re.fullmatch(r"deg|x[0-9.e-]+", rest[1]), where
    for source in results.SOURCES.values():
        assert (ROOT / source.command[0]).is_file(), source.command


def test_figures_are_read_from_runs_and_put_into_pages(results: ModuleType, tmp_path: Path) -> None:
    run = tmp_path / "quickstart"
    run.mkdir()
    rows = [{"model": "a", "value": 1}, {"model": "b", "value": [0.123456, 2.0]}]
    (run / "metrics.json").write_text(json.dumps({"rows": rows}))
    (run / "stdout").write_text("right in 58 of 60 runs")
    page = tmp_path / "page.md"
    marks = ("metrics.json rows[model=b].value x100", r"stdout in\s(\d+\sof\s60)")
    page.write_text("".join(f"<!--= quickstart {mark} -->old<!--/-->; " for mark in marks))
    assert results.rewrite(page, tmp_path, ["quickstart"]) == 0
    assert results.rewrite(page, tmp_path, []) == 2
    assert [text for _, text in results.marks(page)] == ["12.3 / 200", "58 of 60"]
    with pytest.raises(LookupError, match="no entry with model=c"):
        results.figure("quickstart metrics.json rows[model=c].value", tmp_path)


def test_only_runs_of_this_state_count_and_a_lacking_figure_is_named(
    results: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!--= made stdout took\\s(\\d+) -->old<!--/-->")
    monkeypatch.setattr(results, "pages", lambda: [page])
    script = tmp_path / "bench.py"
    script.write_text("print('took 7')")
    source = results.Source((str(script),), 1)
    assert results.make("made", source, tmp_path, "first", again=False) == ""
    script.write_text("print('took long')")
    assert results.make("made", source, tmp_path, "first", again=False) == ""
    assert results.lacking("made", tmp_path) == ""
    assert results.make("made", source, tmp_path, "second", again=False) == ""
    assert "has no figure made stdout" in results.lacking("made", tmp_path)


def test_what_cannot_be_run_is_said(
    results: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    source = results.SOURCES["tanker"]
    assert "needs esso_osaka/" in results.why_not(source, 1000)
    (tmp_path / "esso_osaka").mkdir()
    assert results.why_not(source, 1000) == ""
    assert results.why_not(source, 1).startswith("takes 9 minutes")


def test_what_ran_stands_in_the_pages_and_what_did_not_is_named(
    results: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    page = tmp_path / "page.md"
    names = ("good", "bad", "long", "other")
    page.write_text(
        "\n".join(f"<!--= {name} stdout took\\s(\\d+) -->old<!--/-->" for name in names)
    )
    (tmp_path / "good.py").write_text("import sys; print('took', sys.argv[1])")
    (tmp_path / "bad.py").write_text("raise SystemExit('no such luck')")
    minutes = {"good": 1, "bad": 2, "long": 99, "other": 1}
    made = {
        name: results.Source((str(tmp_path / f"{name}.py"), "7"), minutes[name]) for name in names
    }
    for name, value in {
        "pages": lambda: [page],
        "SOURCES": made,
        "state": lambda: "now",
        "git": lambda *words: "abc",
    }.items():
        monkeypatch.setattr(results, name, value)
    call = ["results.py", "--runs", str(tmp_path / "runs"), "--only", "good,bad,long"]
    monkeypatch.setattr(sys, "argv", call)
    results.main()
    assert [text for _, text in results.marks(page)] == ["7", "old", "old", "old"]
    said = capsys.readouterr().out
    assert "1 figures changed; those that were run are of commit abc." in said
    assert "not run: bad: failed: no such luck" in said
    assert "not run: long: takes 99 minutes" in said
    assert "not run: other: not asked for" in said
    # what is finished is not run again, unless its command is another one
    results.main()
    assert "running good" not in capsys.readouterr().out
    made["good"] = results.Source((str(tmp_path / "good.py"), "8"), 1)
    results.main()
    assert next(text for _, text in results.marks(page)) == "8"
