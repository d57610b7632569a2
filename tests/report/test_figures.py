"""Figures: one description, drawn still and in a browser, written and read back; those of a fit."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from browser import browser, layout
from made_run import LEVEL, made_run, metrics, residuals, write_fit_page, write_json
from PIL import Image
from read_page import Page

from residnet.core.errors import UsageError
from residnet.core.ownership import record_folder
from residnet.report.blocks import Section
from residnet.report.browser import render_bokeh
from residnet.report.figure import (
    BLUE,
    MASKED_STYLE,
    MEASURED_STYLE,
    START_STYLE,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    band_outline,
    bar_outlines,
    error_bars,
    join_with_gaps,
    split_at_gaps,
    step_curve,
    style_family,
    subsample_indices,
    tick_labels,
)
from residnet.report.figure_files import read_figures, unpack_column, write_figures
from residnet.report.fit import write_fit_figures
from residnet.report.page import write_page
from residnet.report.records import SweepFile, SweepTrial
from residnet.report.run_reader import RunFiles
from residnet.report.sections import runs
from residnet.report.sections.models import evolution_figures
from residnet.report.sections.sweep import shorten_keys, slice_figure
from residnet.report.still import INLINE_WIDTH, render_matplotlib

T = np.linspace(0.0, 10.0, 900)
needs_browser = pytest.mark.skipif(browser() is None, reason="no browser is installed")
_MOST_BYTES = 2_500_000


def every_kind() -> Figure:
    """A figure of two cases with a map, lines with a gap, a band, a strip, points, bars, names."""
    gap = np.where((T > 3) & (T < 4), np.nan, np.sin(T))
    first = [
        {"a": (20 * np.sin(T), 3 * T), "start": (np.zeros(1), np.zeros(1))},
        {
            "a": (T, np.sin(T)),
            "measured": (T, gap),
            "masked": (np.array([3.0]), np.array([4.0])),
            "band": band_outline(T, gap - 0.1, gap + 0.1),
            "level": (np.zeros(2), np.array([-1.0, 1.0])),
        },
        {"b": (T, np.exp(-T)), "now": (np.array([5.0]), np.zeros(1))},
        {
            "bars": bar_outlines([0, 1], [2.0, 3.0]),
            "spread": error_bars([0, 1], [1.0, 2.5], [2.5, 3.5]),
        },
    ]
    return Figure(
        "every_kind",
        "Every kind",
        "Look at it.",
        {"measured": MEASURED_STYLE, "masked": MASKED_STYLE, **style_family(("a", "b"))}
        | {
            "band": GlyphStyle("band of a", BLUE, kind="fill", alpha=0.2),
            "level": GlyphStyle("limits", kind="hline", dash="dotted"),
            "now": GlyphStyle("now", kind="vline"),
            "bars": GlyphStyle("</script>", BLUE, kind="fill"),
            "spread": GlyphStyle("interval", is_visible=False),
            "start": START_STYLE,
        },
        [
            Panel("north [m]", "east [m]", kind="map"),
            Panel("heading\n[deg]", y_limits=(-2.0, 2.0)),
            Panel("error", "time [s]", "first", y_log=True),
            Panel("u", group="names", x_names=tick_labels(["u", "v"])),
        ],
        [
            Case("one", first, "A note.", texts=[(1, 5.0, np.nan, "stage")]),
            Case(
                "two",
                [{}, {"b": (T[:90], np.full(90, 3.0))}, {}, {}],
                "Other.",
                has_static_image=False,
            ),
        ],
        "Run",
    )


def test_a_figure_is_written_and_read_back(tmp_path: Path) -> None:
    given = every_kind()
    with record_folder(tmp_path):
        (written,) = write_figures(tmp_path, [given])
    (read,) = read_figures(tmp_path)
    assert [path.name for path in read.static_images] == ["01_every_kind.png"]
    assert read.static_images == written.static_images
    assert (read.styles, read.chooser) == (given.styles, "Run")
    words = ["north [m]", "heading [deg]", "first: error", "u"]
    assert [panel.heading for panel in read.panels] == words
    assert (read.panels[1].y_limits, read.panels[2].y_log) == ([-2.0, 2.0], True)
    assert [case.note for case in read.cases] == ["A note.", "Other."]
    x, y = read.cases[0].curves[1]["a"]
    assert len(x) == 300, "no more samples than a screen shows"
    np.testing.assert_allclose(y, np.sin(x), atol=1e-3)
    assert (x[0], x[-1]) == pytest.approx((0.0, 10.0), abs=1e-3)
    assert len(split_at_gaps(*read.cases[0].curves[1]["measured"])) == 2, "a gap stays one"
    with Image.open(read.static_images[0]) as picture:
        assert picture.info["Title"] == "Every kind"
        assert picture.info["Description"] == "Look at it."
    (tmp_path / "damaged.json").write_text('{"name": 1')
    (tmp_path / "foreign.json").write_text("{}")
    Image.new("RGB", (10, 10)).save(tmp_path / "mine.png")
    assert len(read_figures(tmp_path)) == 1
    write_figures(tmp_path, [])
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"checksums.json", "damaged.json", "foreign.json", "mine.png"}


def test_still_pictures_show_what_is_switched_on() -> None:
    canvas = render_matplotlib(every_kind())
    track, heading, error, names = canvas.axes
    assert track.get_aspect() in ("equal", 1.0)
    assert heading.get_ylim() == (-2.0, 2.0)
    assert error.get_yscale() == "log"
    assert [text.get_text() for text in names.get_xticklabels()] == ["u", "v"]
    (legend,) = canvas.legends
    labels = {text.get_text() for text in legend.get_texts()}
    assert labels >= {"a", "b", "measured", "masked", "band of a", "limits", "now", "start"}
    assert "interval" not in labels
    assert [text.get_text() for text in heading.texts] == ["stage"]
    assert len(render_matplotlib(every_kind(), panel_numbers=[1, 2]).axes) == 2


def test_long_legends_and_labels_of_axes_stay_within_a_narrow_figure() -> None:
    names = [f"law {number}, look-ahead" for number in range(10)]
    curves = {name: (T, np.sin(T)) for name in names}
    label = "squared error minus that of the reference model, mean over axes [% of the mean square]"
    panels = [Panel("mean angular rate of the boat [deg/s]", label, height=220)]
    figure = Figure("long", "Long", "", style_family(curves), panels, [Case("", [curves])])
    canvas = render_matplotlib(figure, width=INLINE_WIDTH)
    (axes,) = canvas.axes
    (legend,) = canvas.legends
    assert legend.get_window_extent().y0 >= axes.bbox.y1
    for text in (axes.xaxis.label, axes.yaxis.label):
        extent = text.get_window_extent()
        assert "\n" in text.get_text()
        assert extent.x0 >= 0
        assert extent.x1 <= canvas.bbox.width


def test_outlines_and_steps() -> None:
    x, y = bar_outlines([0, 2], [1.0, 3.0], 0.5)
    assert x[:4].tolist() == [-0.25, -0.25, 0.25, 0.25]
    assert y[5:].tolist() == [0.0, 3.0, 3.0, 0.0]
    assert np.isnan(x[4])
    x, y = step_curve([0, 1, 2], [3.0, 1.0, 2.0])
    assert (x.tolist(), y.tolist()) == ([0, 1, 1, 2, 2], [3, 3, 1, 1, 2])
    rows = subsample_indices(10_001, 500)
    assert (rows[0], rows[-1], len(rows)) == (0, 10_000, 500)
    assert join_with_gaps([])[0].size == 0


def test_cases_on_a_page_hold_their_curves_to_a_part_in_sixty_thousand() -> None:
    figure = every_kind()
    drawn = render_bokeh([figure])
    assert drawn is not None
    cases = json.loads(drawn.figures["figure-every-kind"])["cases"]
    one, two = (case["panels"] for case in cases)
    curve = figure.cases[0].curves[1]["measured"][1]
    np.testing.assert_allclose(unpack_column(one[1], "measured")[: len(T)], curve, atol=2 / 60_000)
    np.testing.assert_allclose(unpack_column(one[1], "x of a")[: len(T)], T, atol=10 / 60_000)
    assert np.isnan(unpack_column(two[1], "a")).all(), "a case without a curve draws none"
    assert render_bokeh([]) is None


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = made_run(tmp_path_factory.mktemp("runs") / "made")
    residuals().to_parquet(folder / "residuals.parquet")
    write_fit_figures(RunFiles(folder))
    return folder


def test_every_figure_of_a_fit_is_a_light_picture_that_shows_something(run: Path) -> None:
    figures = read_figures(run / "figures")
    names = ["track", "free_runs", "horizon", "residuals", "learning"]
    assert [figure.name for figure in figures] == names
    for path in (path for figure in figures for path in figure.static_images):
        assert path.stat().st_size < 200_000
        with Image.open(path) as picture:
            width, height = picture.size
            pixels = np.asarray(picture.convert("L"))
        assert width == 840
        assert 250 < height < 1900
        assert 0.005 < float((pixels < 200).mean()) < 0.6, path.name
        # nothing is cut off: the outermost pixels are white
        edges = (pixels[:2].ravel(), pixels[-2:].ravel(), pixels[:, 0], pixels[:, -1])
        assert np.concatenate(edges).min() > 250, path.name


def test_the_page_of_a_fit_stands_alone_and_loads_nothing(run: Path) -> None:
    path = write_fit_page(RunFiles(run))
    text = path.read_text()
    assert path.stat().st_size < _MOST_BYTES
    scripts = re.findall(r"<script([^>]*)>", text)
    assert scripts
    assert all("src" not in attributes for attributes in scripts)
    assert "<link" not in text
    assert "&lt;script&gt;" in text
    assert '<meta name="viewport"' in text
    sources = Page(text).sources
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in sources)
    assert sum(source.startswith("data:") for source in sources) == 7
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    # clip paths of drawings are in the page itself
    assert not re.search(r"url\((?!#)|@import|https?://", markup)
    assert not list(run.glob("*.partial"))
    path.unlink()
    assert write_fit_page(RunFiles(run)).read_text() == text


def test_runs_to_choose_from_are_the_median_worst_and_best_of_each_kind(run: Path) -> None:
    files = RunFiles(run)
    figure = runs.free_run_figure(files, files.read_split_windows("test"))
    assert figure is not None
    cases = {case.title: case for case in figure.cases}
    # errors grow with the number of the log: of zigzags 01, 02, 03 the second is the median
    median = cases["zigzag, T30: median error (zigzag_02)"]
    pictured = [case.title.split(":")[0] for case in figure.static_cases]
    assert pictured == ["zigzag, T30", "turning, T30"]
    looks = figure.styles
    assert all(looks[name].is_visible for name in ("measured", "plsr", "baseline", "plant"))
    assert not looks["constant_velocity"].is_visible
    assert (looks["plsr"].color, looks["baseline"].dash) == (BLUE, "dashed")
    track, surge = median.curves[:2]
    assert np.isnan(track["measured"][0]).sum() == 10, "masked samples are a gap"
    assert len(surge["masked"][0]) == 1
    assert np.isfinite(surge["plsr"][1]).all()


def test_masked_samples_do_not_count(run: Path) -> None:
    window = next(
        window for window in RunFiles(run).read_split_windows("test") if window.log == "zigzag_02"
    )
    np.testing.assert_allclose(window.rmse_by_channel("plsr"), LEVEL["plsr"], rtol=1e-12)
    error = runs.error_growth([window], "plsr")
    time = error.index.to_numpy()
    assert time[0] == pytest.approx(0.1)
    seen = np.isfinite(error["u"])
    # the second in which all samples are masked leaves no error of u, v and position, but one of r
    assert 0 < (~seen).sum() <= 6
    np.testing.assert_allclose(error["u"][seen], LEVEL["plsr"][0], rtol=1e-9)
    np.testing.assert_allclose(error["r"], LEVEL["plsr"][2], rtol=1e-9)
    assert error["x"].iloc[-1] == pytest.approx(np.hypot(*LEVEL["plsr"][:2]) * time[-1], rel=0.02)
    # a whole turn more is no error of the heading
    turned = window.predicted["plsr"] + np.where(np.arange(6) == 3, 2 * np.pi, 0.0)
    window = replace(window, predicted={"plsr": turned})
    assert runs.error_growth([window], "plsr")["psi"].max() < 0.1


def test_metrics_alone_give_no_figure_and_many_heads_distinct_looks(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no metrics\.json"):
        write_fit_figures(RunFiles(tmp_path))
    write_json(tmp_path / "metrics.json", metrics(("external",), ("baseline", "plsr")))
    assert write_fit_figures(RunFiles(tmp_path)) == []
    content = metrics(("test",), ("plsr",))
    first = content["rows"][0] | {"selected": False}
    content |= {"rows": [first | {"model": f"head{i}"} for i in range(12)]}
    write_json(tmp_path / "metrics.json", content)
    looks = runs.model_styles(RunFiles(tmp_path)).values()
    assert len({(look.color, look.dash) for look in looks}) == 12


def test_a_bred_equation_shows_its_generations(tmp_path: Path) -> None:
    folder = made_run(tmp_path / "made")
    model = RunFiles(folder).heads[0]
    history = [{"train": 1 / k, "validation": 1.2 / k, "terms": k} for k in range(1, 6)]
    row = {"history": history, "generation": 4}
    write_json(folder / "models" / model / "fit.json", {"equations": {"u_dot": row, "r_dot": row}})
    (figure,) = evolution_figures(RunFiles(folder))
    assert [panel.title for panel in figure.panels] == ["surge", "yaw"]
    curves = figure.cases[0].curves[0]
    np.testing.assert_allclose(curves["validation"][1], [1.2 / k for k in range(1, 6)])
    assert curves["kept"][0].tolist() == [4]


def test_trials_of_a_sweep_over_their_keys() -> None:
    trials = [
        SweepTrial(
            number=i,
            state="finished",
            value=0.1 * i,
            seconds=1.0,
            fault="",
            values={"heads.size": i, "kind": "ab"[i % 2]},
        )
        for i in range(20)
    ]
    failed = SweepTrial(number=20, state="failed", value=None, seconds=1.0, fault="x", values={})
    sweep = SweepFile(
        schema="residnet.sweep/1",
        run="made",
        objective="score [-]",
        minimized=False,
        search="random",
        keys=("heads.size", "kind"),
        log=(),
        best=19,
        importance={},
        trials=(*trials, failed),
    )
    figure = slice_figure(sweep)
    size, kind = figure.panels
    assert (size.title, kind.title, kind.x_label) == ("size", "kind", "score")
    assert (size.y_names, kind.y_names) == ({}, {"0": '"a"', "1": '"b"'})
    sizes, kinds = figure.cases[0].curves
    assert [values.tolist() for values in sizes["best"]] == [[pytest.approx(1.9)], [19.0]]
    assert kinds["best"][1].tolist() == [1.0]
    assert sum(len(x) for x, _ in sizes.values()) == len(trials)


def test_keys_have_as_many_parts_as_distinguish_them() -> None:
    keys = ("heads.mlp.hidden", "training.mlp.rate", "training.lstm.rate", "rate")
    assert list(shorten_keys(keys).values()) == ["hidden", "mlp.rate", "lstm.rate", "rate"]


@pytest.mark.long
@needs_browser
def test_a_browser_draws_every_kind_of_curve(tmp_path: Path) -> None:
    figures = write_figures(tmp_path / "figures", [every_kind()])
    page = write_page(tmp_path, "Run", "", ["Done."], [Section("All", figures)])
    found = layout(page, 390, tmp_path)
    assert (found.overflow, found.broken) == (0, [])
    assert found.panels == [True] * 4


@pytest.mark.long
@needs_browser
def test_a_browser_draws_every_panel_of_a_fit_and_the_controls_work(run: Path) -> None:
    page = write_fit_page(RunFiles(run))
    for width in (390, 820):
        found = layout(page, width, run)
        assert (found.overflow, found.broken) == (0, []), width
        assert found.smallest >= 11
        assert all(found.panels), "every panel is drawn"
        near = pytest.approx(0.5, abs=0.01)
        whole = pytest.approx(1.0, abs=0.01)
        done = dict.fromkeys(("focused", "hidden", "chosen"), True)
        assert found.used == {**done, "zoomed": near, "reset": whole}


@pytest.mark.parametrize("amplitude", [0.04, 3.2, 0.9])
def test_tick_labels_of_low_panels_do_not_overlap(amplitude: float) -> None:
    time = np.linspace(0.0, 60.0, 100)
    curve = (time, 0.855 + amplitude * np.sin(time / 9.0))
    panels = [Panel("", "u", height=62), Panel("t [s]", "v", height=62)]
    figure = Figure(
        "low", "Low", "", {"a": GlyphStyle("a", BLUE)}, panels, [Case("", [{"a": curve}] * 2)]
    )
    canvas = render_matplotlib(figure, width=3.0)
    for axes in canvas.axes:
        lower, upper = axes.get_ylim()
        extents = sorted(
            (label.get_window_extent().y0, label.get_window_extent().y1)
            for tick, label in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
            if lower <= tick <= upper
        )
        assert len(extents) >= 2
        assert all(below[1] < above[0] for below, above in pairwise(extents))


@pytest.mark.parametrize(("lowest", "highest"), [(0.02, 0.61), (0.9, 12.0), (0.003, 40.0)])
def test_a_logarithmic_axis_has_two_labels_or_more(lowest: float, highest: float) -> None:
    curve = (T, np.geomspace(lowest, highest, len(T)))
    panels = [Panel("error [m]", "t [s]", y_log=True, height=140)]
    figure = Figure(
        "log", "Log", "", {"a": GlyphStyle("a", BLUE)}, panels, [Case("", [{"a": curve}])]
    )
    canvas = render_matplotlib(figure)
    canvas.draw_without_rendering()
    (axes,) = canvas.axes
    lower, upper = axes.get_ylim()
    ticks = [*axes.yaxis.get_major_ticks(), *axes.yaxis.get_minor_ticks()]
    shown = [tick.label1 for tick in ticks if lower <= tick.get_loc() <= upper]
    extents = sorted(
        (label.get_window_extent().y0, label.get_window_extent().y1)
        for label in shown
        if label.get_text()
    )
    assert len(extents) >= 2
    assert all(below[1] < above[0] for below, above in pairwise(extents))
