"""Interactive figures of pictures: a picture's file carries what it shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser import browser, layout
from PIL import Image

from residnet.report.blocks import Section
from residnet.report.figures.files import figures_section, picture_alone, read_figures
from residnet.report.figures.style import new_figure, save
from residnet.report.figures.sweep import parallel_coordinates
from residnet.report.interactive.drawing import draw
from residnet.report.interactive.explorer import FILL, INK
from residnet.report.interactive.pictures import curves_text, picture_explorer
from residnet.report.page import write_page

T = np.linspace(0.0, 10.0, 200)


def drawn(folder: Path) -> Path:
    """A picture with lines, a shade, points, a line across, names at an axis and columns."""
    figure = new_figure(4.0)
    (first, second), (third, fourth) = figure.subplots(2, 2)
    first.plot(T, np.sin(T), color="#0072B2", label="model")
    first.plot(T, np.cos(T), color="black", linestyle="--", label="measured")
    first.fill_between(T, np.sin(T) - 0.1, np.sin(T) + 0.1, color="#0072B2", alpha=0.2)
    first.axhline(0.5, color="0.4", linestyle=":")
    first.set(ylabel="heading\n[deg]", xlabel="time [s]", ylim=(-2.0, 2.0))
    second.semilogy(T, np.exp(-T), color="#0072B2")
    second.set_title("error")
    third.scatter(T[::20], T[::20], color="#D55E00", label="trials")
    fourth.plot([0.0, 1.0], [2.0, 3.0], "o", color="#0072B2", label="model")
    fourth.set_xticks([0, 1], ["u", "v"])
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels)
    path = folder / "figures" / "01_curves.png"
    path.parent.mkdir(parents=True)
    save(figure, path, "Curves", "Look at them.")
    return path


def test_a_picture_becomes_an_interactive_figure(tmp_path: Path) -> None:
    drawn(tmp_path)
    (figure,) = read_figures(tmp_path / "figures")
    explorer = figure.explorer
    assert explorer is not None
    heading, error, trials, names = explorer.panels
    assert (heading.title, heading.x_label) == ("heading [deg]", "time [s]")
    assert tuple(heading.y_limits) == (-2.0, 2.0)
    assert (error.title, error.logarithmic, tuple(error.y_limits)) == ("error", True, ())
    assert names.x_names == {"0": "u", "1": "v"}
    assert all(panel.beside for panel in explorer.panels)
    assert trials.group != heading.group
    looks = explorer.looks
    assert looks["measured"].color == INK
    assert looks["measured"].dash == "dashed"
    assert looks["trials (points)"].points
    assert looks["model, shade"].dash == FILL
    curves = explorer.cases[0].curves
    np.testing.assert_allclose(curves[0]["model"][1], np.sin(T), atol=1e-4)
    np.testing.assert_allclose(curves[1]["model"][1], np.exp(-T), atol=1e-4)
    assert float(np.nanmax(curves[0]["model, shade"][1])) == pytest.approx(1.1, abs=0.01)
    assert np.ptp(curves[0]["other lines"][0]) >= 10.0
    assert curves[3]["model (points)"][1].tolist() == pytest.approx([2.0, 3.0], abs=1e-4)


def test_steps_single_points_and_counts(tmp_path: Path) -> None:
    figure = new_figure(4.0)
    steps, alone = figure.subplots(1, 2)
    steps.step([0, 1, 2], [3.0, 1.0, 2.0], where="post", color="#0072B2", label="best so far")
    alone.plot([0.5], [2.0], "o-", color="#D55E00", label="one run")
    steps.legend()
    alone.legend()
    path = tmp_path / "figures" / "01_counts.png"
    path.parent.mkdir(parents=True)
    save(figure, path, "Counts", "Look at them.")
    (drawn_one,) = read_figures(path.parent)
    explorer = drawn_one.explorer
    assert explorer is not None
    x, y = explorer.cases[0].curves[0]["best so far"]
    np.testing.assert_allclose(x, [0, 1, 1, 2, 2], atol=1e-4)
    np.testing.assert_allclose(y, [3, 3, 1, 1, 2], atol=1e-4)
    assert explorer.looks["one run (points)"].points
    parts = draw([explorer])
    assert parts is not None
    assert '"min_interval":1.0' in parts.script


def test_a_page_holds_the_picture_without_its_curves(tmp_path: Path) -> None:
    path = drawn(tmp_path)
    alone = tmp_path / "alone.png"
    alone.write_bytes(picture_alone(path))
    assert alone.stat().st_size < path.stat().st_size
    with Image.open(alone) as picture, Image.open(path) as whole:
        assert "Curves" not in picture.info
        assert picture.info["Title"] == "Curves"
        assert picture.tobytes() == whole.tobytes()


def test_what_curves_cannot_show_stays_a_picture(tmp_path: Path) -> None:
    figure = new_figure(2.0)
    figure.subplots().imshow(np.eye(3))
    save(figure, tmp_path / "map.png", "Map", "Look.")
    (read,) = read_figures(tmp_path)
    assert read.explorer is None


def test_figures_that_others_cover_are_for_print(tmp_path: Path) -> None:
    drawn(tmp_path)
    whole = figures_section(tmp_path / "figures")
    assert whole is not None
    assert not whole.pictures
    covered = figures_section(tmp_path / "figures", "curves|tracks")
    assert covered is not None
    assert covered.pictures


@pytest.mark.skipif(browser() is None, reason="no browser (chromium or chrome) is installed")
def test_a_browser_draws_the_curves_of_a_picture(tmp_path: Path) -> None:
    drawn(tmp_path)
    figures = figures_section(tmp_path / "figures")
    page = write_page(tmp_path, "Run", "", ["Done."], [Section("All", [figures])])
    found = layout(page, 390, tmp_path)
    assert (found.overflow, found.broken) == (0, [])
    assert found.panels == [True] * 4
    assert found.used["zoomed"] == pytest.approx(0.5, abs=0.01)
    assert found.used["reset"] == pytest.approx(1.0, abs=0.01)


def test_trials_of_a_sweep_over_their_keys() -> None:
    trials = [
        {"number": i, "value": 0.1 * i, "values": {"heads.size": i, "kind": "ab"[i % 2]}}
        for i in range(20)
    ]
    content = {
        "trials": [*trials, {"number": 20, "value": None, "values": {}}],
        "keys": ["heads.size", "kind"],
        "log": [],
        "minimized": False,
        "objective": "score [-]",
    }
    drawing = parallel_coordinates(content)
    text = curves_text(drawing.figure)
    explorer = picture_explorer("keys", drawing.title, drawing.caption, text)
    assert explorer is not None
    (panel,), (case,) = explorer.panels, explorer.cases
    assert panel.unnumbered
    assert panel.x_names == {
        "0": "heads.size\n0 to 19",
        "1": 'kind\n"a" to "b"',
        "2": "score\n0 to 1.9",
    }
    x, y = case.curves[0]["best"]
    np.testing.assert_allclose(x[:3], (0.0, 1.0, 2.0), atol=1e-3)
    np.testing.assert_allclose(y[:3], (1.0, 1.0, 1.0), atol=1e-3)
    counts = {name: int(np.isfinite(curve[0]).sum()) // 3 for name, curve in case.curves[0].items()}
    assert counts["best tenth"] + counts["better half"] + counts["worse half"] == len(trials)


def test_what_no_legend_names_keeps_its_colour_and_its_group(tmp_path: Path) -> None:
    figure = new_figure(2.0)
    axes = figure.subplots()
    axes.plot(T, np.sin(T), color="#0072B2", label="law")
    axes.plot(T, np.cos(T), color="#0072B2", linestyle="--", label="learned")
    axes.fill_between(T, np.cos(T), 2.0, color="#0072B2", alpha=0.3, gid="learned")
    axes.fill_between(T, -2.0, -1.0, color="#0072B2", alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels())
    save(figure, tmp_path / "01_shades.png", "Shades", "Look.")
    (read,) = read_figures(tmp_path)
    assert read.explorer is not None
    looks = read.explorer.looks
    assert set(looks) == {"law", "learned", "learned, shade", "shades"}
    assert looks["shades"].color == looks["learned, shade"].color == "#0072b24c"


def test_shades_across_the_axes_end_at_their_limits(tmp_path: Path) -> None:
    figure = new_figure(2.0)
    axes = figure.subplots()
    axes.plot(T, 0.01 * np.sin(T), color="#0072B2", label="measured")
    axes.axvspan(2.0, 3.0, color="0.88", label="masked")
    axes.legend()
    save(figure, tmp_path / "01_masked.png", "Masked", "Look.")
    (read,) = read_figures(tmp_path)
    assert read.explorer is not None
    assert read.explorer.looks["masked, shade"].dash == FILL
    x, y = read.explorer.cases[0].curves[0]["masked, shade"]
    assert (x.min(), x.max()) == pytest.approx((2.0, 3.0), abs=1e-3)
    assert abs(y).max() == pytest.approx(max(map(abs, axes.get_ylim())), rel=1e-3)


def surfaces(folder: Path) -> Path:
    """A picture of two surfaces over the same axes, with a bar of colours and a mark."""
    from matplotlib.colors import LogNorm

    figure = new_figure(3.0)
    panels = figure.subplots(1, 2)
    for number, axes in enumerate(panels):
        heights = np.outer([1.0, 2.0, 5.0], [3.0, 7.0, 11.0, 13.0]) * 10.0**number
        heights[2, 0] = np.nan
        image = axes.imshow(
            heights, origin="lower", extent=(0.5, 4.5, -0.5, 2.5), norm=LogNorm(1.0, 900.0)
        )
        axes.plot(2 + number, 1, "x", color="#D55E00", label="chosen")
        axes.set(title=("surge", "sway")[number], xlabel="functions")
    panels[0].set_ylabel("order")
    figure.colorbar(image, ax=panels).set_label("share [%]")
    path = folder / "figures" / "surface.png"
    path.parent.mkdir(parents=True)
    save(figure, path, "Surface", "Look at it.")
    return path


def test_a_surface_becomes_cells_and_sections(tmp_path: Path) -> None:
    (figure,) = read_figures(surfaces(tmp_path).parent)
    explorer = figure.explorer
    assert explorer is not None
    assert explorer.surface is not None
    assert (explorer.surface.x_label, explorer.surface.y_label) == ("functions", "order")
    assert explorer.surface.height == "share [%]"
    assert explorer.surface.limits == (1.0, 900.0)
    surge, sway = explorer.cases
    assert (surge.title, surge.chosen, sway.chosen) == ("surge", (2.0, 1.0), (3.0, 1.0))
    x, y = surge.curves[0]["surface"]
    assert len(surge.heights) == 11, "a cell without a height is none"
    np.testing.assert_allclose(surge.heights[(x > 3.9) & (y > 1.9)], 65.0, rtol=1e-3)
    np.testing.assert_allclose(sway.heights[(x < 1.1) & (y < 0.1)], 30.0, rtol=1e-3)


@pytest.mark.skipif(browser() is None, reason="no browser (chromium or chrome) is installed")
def test_a_browser_cuts_a_surface(tmp_path: Path) -> None:
    section = figures_section(surfaces(tmp_path).parent)
    page = write_page(tmp_path, "Run", "", ["Done."], [Section("All", [section])])
    found = layout(page, 390, tmp_path)
    assert (found.overflow, found.broken) == (0, [])
    assert found.panels == [True] * 3
    assert found.used["cut"] == [["2", "1"], ["3", "1"]], "a slider chooses the next section"
    assert found.used["section"] == pytest.approx([11.0, 22.0, 55.0], rel=1e-3)
