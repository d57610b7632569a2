"""Figures: pictures that can be opened and show something, of the right windows, from numbers that
hold.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_run import DEG, LEVEL, made_run, metrics, residuals, write_json
from PIL import Image

from residnet.core.errors import UsageError
from residnet.report.figures.errors import bar_group, growth, r_squared
from residnet.report.figures.files import read_figures
from residnet.report.figures.fit import write_figures
from residnet.report.figures.style import styles
from residnet.report.figures.terms import of_breeding
from residnet.report.figures.tracks import representative, shown
from residnet.report.run_reader import RunFiles


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = made_run(tmp_path_factory.mktemp("runs") / "made")
    residuals().to_parquet(folder / "residuals.parquet")
    write_figures(RunFiles(folder))
    return folder


def test_every_figure_is_a_light_picture_that_shows_something(run: Path) -> None:
    figures = read_figures(run / "figures")
    names = [figure.path.stem[3:] for figure in figures]
    assert names == [
        "tracks",
        "history_turning",
        "history_zigzag",
        "horizon_whole",
        "horizon_T30",
        "bars",
        "residuals",
        "learning",
    ]
    for figure in figures:
        assert figure.path.stat().st_size < 200_000
        with Image.open(figure.path) as picture:
            picture.load()
            width, height = picture.size
            pixels = np.asarray(picture.convert("L"))
        assert width == 980
        assert 250 < height < 1500
        assert 0.005 < float((pixels < 200).mean()) < 0.6, figure.path.name
        # nothing is cut off: the outermost pixels are white
        edges = np.concatenate(
            (pixels[:2].ravel(), pixels[-2:].ravel(), pixels[:, 0], pixels[:, -1])
        )
        assert edges.min() > 250, figure.path.name
        assert figure.title
        assert figure.caption.endswith(".")


def test_figures_are_replaced_and_foreign_pictures_left_alone(run: Path) -> None:
    stale, foreign = run / "figures" / "99_old.png", run / "figures" / "mine.png"
    stale.write_bytes((run / "figures" / "01_tracks.png").read_bytes())
    Image.new("RGB", (10, 10)).save(foreign)
    before = (run / "figures" / "06_bars.png").read_bytes()
    written = write_figures(RunFiles(run))
    assert not stale.exists()
    assert foreign.exists()
    assert read_figures(run / "figures") == written
    assert (run / "figures" / "06_bars.png").read_bytes() == before


def test_the_representative_window_has_the_median_error(run: Path) -> None:
    files = RunFiles(run)
    windows = files.windows("test")
    assert len(windows) == 8
    chosen = representative(files, windows, "whole")
    # errors grow with the number of the log: of zigzags 01, 02, 03 the second is the median
    assert [window.log for window in chosen] == ["turning_01", "zigzag_02"]
    assert shown(files) == ["baseline", "truth", "plsr"]


def test_masked_samples_do_not_count(run: Path) -> None:
    window = next(window for window in RunFiles(run).windows("test") if window.log == "zigzag_02")
    np.testing.assert_allclose(window.rmse("plsr"), LEVEL["plsr"], rtol=1e-12)
    time, error = growth([window], "plsr")
    assert time[0] == pytest.approx(0.1)
    seen = np.isfinite(error[:, 0])
    # the second in which all samples are masked leaves no error of u, v and position, but one of r
    assert 0 < (~seen).sum() <= 6
    np.testing.assert_allclose(error[seen, 0], LEVEL["plsr"][0], rtol=1e-9)
    np.testing.assert_allclose(error[:, 2], DEG * LEVEL["plsr"][2], rtol=1e-9)
    assert error[-1, 3] == pytest.approx(np.hypot(*LEVEL["plsr"][:2]) * time[-1], rel=0.02)


def test_roles_have_fixed_looks_and_no_two_models_share_one(run: Path) -> None:
    look = styles(RunFiles(run))
    assert look["plsr"]["color"] == "#0072B2"
    assert look["baseline"]["linestyle"] == "--"
    assert len({(style["color"], str(style["linestyle"])) for style in look.values()}) == len(look)


def test_lines_keep_their_colours(run: Path) -> None:
    with Image.open(run / "figures" / "03_history_zigzag.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int).reshape(-1, 3)
    for color in ((0, 114, 178), (230, 159, 0), (0, 158, 115), (0, 0, 0)):
        assert (np.abs(pixels - color).max(1) < 12).sum() > 200, color


def test_many_heads_keep_distinct_looks(tmp_path: Path) -> None:
    content = metrics(("test",), ("plsr",))
    content["rows"] = [
        content["rows"][0] | {"model": f"head{i}", "selected": False} for i in range(12)
    ]
    content["selected"] = None
    write_json(tmp_path / "metrics.json", content)
    look = styles(RunFiles(tmp_path))
    assert len({(style["color"], str(style["linestyle"])) for style in look.values()}) == 12


def test_bars_follow_speed_and_steering_runs_where_there_are_such_groups(
    run: Path, tmp_path: Path
) -> None:
    assert bar_group(RunFiles(run), "whole", "u") == "all"
    content = metrics(("test",))
    content["rows"] += [
        line | {"manoeuvre": name}
        for line in content["rows"]
        if line["manoeuvre"] == "all"
        for name in ("speed", "steering")
    ]
    write_json(tmp_path / "metrics.json", content)
    assert [bar_group(RunFiles(tmp_path), "whole", channel) for channel in "uvr"] == [
        "speed",
        "steering",
        "steering",
    ]


def test_r_squared() -> None:
    target = np.array([1.0, 2.0, 4.0])
    assert r_squared(target, target) == 1.0
    assert r_squared(target, np.full(3, target.mean())) == pytest.approx(0.0)


def test_a_folder_with_metrics_alone_gives_the_bars_alone(tmp_path: Path) -> None:
    write_json(tmp_path / "metrics.json", metrics(("external",), ("baseline", "plsr")))
    assert [figure.path.name for figure in write_figures(RunFiles(tmp_path))] == ["01_bars.png"]


def test_a_folder_without_metrics_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no metrics\.json"):
        write_figures(RunFiles(tmp_path))


def test_damaged_pictures_are_passed_over(tmp_path: Path) -> None:
    """A report draws them again; nothing of them is needed."""
    whole, folder = tmp_path / "whole.png", tmp_path / "figures"
    Image.new("RGB", (40, 30)).save(whole)
    folder.mkdir()
    for cut in (0, 4, 20, 40, 60):
        (folder / f"cut_{cut}.png").write_bytes(whole.read_bytes()[:cut])
    (folder / "folder.png").mkdir()
    (folder / "foreign.png").write_text("no picture")
    assert read_figures(folder) == []


def test_a_bred_equation_shows_its_generations(tmp_path: Path) -> None:
    folder = made_run(tmp_path / "made")
    model = RunFiles(folder).heads[0]
    history = [{"train": 1 / k, "validation": 1.2 / k, "terms": k} for k in range(1, 6)]
    row = {"history": history, "generation": 4}
    write_json(folder / "models" / model / "fit.json", {"equations": {"u_dot": row, "r_dot": row}})
    (drawing,) = of_breeding(RunFiles(folder))
    first, second = drawing.figure.axes
    assert [axes.get_title(loc="left") for axes in (first, second)] == ["surge", "yaw"]
    errors = np.asarray(first.lines[1].get_ydata(), dtype=float)
    np.testing.assert_allclose(errors, [1.2 / k for k in range(1, 6)])
    assert np.asarray(first.lines[2].get_xdata()).tolist() == [4]
