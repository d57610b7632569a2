"""The page builder: every block is drawn, the file stands alone, its contents are escaped."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_run import provenance
from PIL import Image
from read_page import Page

from residnet.core.format import format_number
from residnet.report.blocks import (
    Bullets,
    Cell,
    Code,
    Facts,
    Section,
    Table,
    Text,
    build_table,
    flag_cell,
)
from residnet.report.figure import Case, Figure, GlyphStyle, Panel
from residnet.report.page import write_page


def table() -> Table:
    out = Table(["controller", "settling [s]", "remark"], "Changes of 10 deg.")
    remark = Cell("tuned at the corners", mark="text")
    out.add_row("proportional_and_derivative", [Cell("12.5", "best of 5"), remark])
    cells = [Cell("10.1", mark="best"), Cell("learned", mark="text")]
    out.add_row("net", cells, is_selected=True)
    return out


def every_block(folder: Path) -> list[Section]:
    picture = folder / "figures" / "track.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (900, 300), "white").save(picture)
    case = Case("", [{"a": (np.arange(3.0), np.arange(3.0))}])
    look = {"a": GlyphStyle("a")}
    panel = [Panel("u [m/s]")]
    figure = Figure("track", "Track", "Look out.", look, panel, [case], static_images=[picture])
    return [
        Section("Results of <all>", [Text(["First.", "", "Second."]), table()]),
        Section("Pictures", [figure, None]),
        Section(
            "Details",
            [
                Bullets(["mind the gap"], is_warning=True),
                Facts([("damping", "is wrong"), ("gain", "is right")], failed=["damping"]),
                Section("Inside", [Code("a: 1\nb: 2")], is_folded=True),
            ],
            is_folded=True,
        ),
    ]


def test_every_block_is_drawn_and_nothing_is_loaded_or_run(tmp_path: Path) -> None:
    path = write_page(
        tmp_path, "run & all", "A <b>.", ["It works.", "", "Well."], every_block(tmp_path)
    )
    text = path.read_text()
    page = Page(text)
    assert path == tmp_path / "report.html"
    assert "<strong>It works.</strong>" in text
    assert "<li>Well.</li>" in text
    assert "run &amp; all" in text
    assert "A &lt;b&gt;." in text
    assert page.tables == [
        [
            ["controller", "settling [s]", "remark"],
            ["proportional_and_derivative", "12.5|best of 5", "tuned at the corners"],
            ["net", "10.1", "learned"],
        ]
    ]
    named = [section for section in page.sections if section]
    assert named == ["verdict", "results-of-all", "pictures", "details"]
    assert sum(source.startswith("data:image/png;base64,") for source in page.sources) == 1
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in page.sources)
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"<script|url\(|@import|https?://", markup)
    assert "proportional_<wbr>and_<wbr>derivative" in text
    assert text.count("<details>") == 2
    assert "a: 1\nb: 2" in html.unescape(text)
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize(("height", "is_tall"), [(632, False), (800, True), (1556, True)])
def test_wide_pictures_share_a_printed_page(height: int, is_tall: bool, tmp_path: Path) -> None:
    Image.new("RGB", (840, height), "white").save(tmp_path / "track.png")
    figure = Figure(
        "track",
        "Track",
        "",
        {},
        [Panel("u")],
        [Case("", [{}])],
        static_images=[tmp_path / "track.png"],
    )
    text = write_page(tmp_path, "made", "", ["Done."], [Section("Pictures", [figure])]).read_text()
    (attributes,) = re.findall(r'<img src="[^"]*"([^>]*)>', text)
    assert f'width="840" height="{height}"' in attributes
    assert ('class="tall"' in attributes) == is_tall
    assert "figure img.tall" in text


def test_provenance_and_configuration_come_last_and_folded(tmp_path: Path) -> None:
    record = provenance(inputs={"a.csv": "f00d"})
    (tmp_path / "provenance.json").write_text(json.dumps(record))
    (tmp_path / "resolved.yaml").write_text("name: made\n")
    text = write_page(tmp_path, "made", "", ["Done."], [Section("Table", [table()])]).read_text()
    assert Page(text).sections == ["verdict", "table", "provenance"]
    last = text[text.index('id="provenance"') :]
    assert last.count("<details>") == 3
    for part in ("9.8.7", "f00d", "name: made", "SHA-256 of 1 input file<"):
        assert part in last
    assert "run of 2026-01-02" in text


def test_a_table_for_the_terminal_has_its_columns_below_each_other() -> None:
    assert table().to_text().splitlines() == [
        "Changes of 10 deg.",
        "controller                       settling [s]  remark",
        "proportional_and_derivative  12.5 (best of 5)  tuned at the corners",
        "net                                      10.1  learned",
    ]
    grouped = Table(["model", "train", "test"], groups=[("surge u [m/s]", 2)])
    grouped.add_row("plsr", ["1", Cell("2", mark="bad")])
    assert grouped.to_text().splitlines() == [
        "       surge u [m/s]",
        "model    train  test",
        "plsr         1   2 !",
    ]


def test_a_table_is_columns_of_what_rows_hold() -> None:
    rows: list[dict[str, Any]] = [
        {"model": "net", "time": {"mean": 1.25}, "rms": 0.5, "kind": "policy"},
        {"model": "pd", "time": {}, "rms": None, "kind": "law"},
        {"model": "lqr", "time": {"mean": 2.0}, "rms": 1.0, "kind": "law"},
    ]
    made = build_table(
        rows,
        [
            ("controller", "model"),
            ("kind", "kind"),
            ("time [s]", "time.mean", 2),
            ("rms [deg]", "rms", format_number, 10.0),
            ("twice", lambda row: flag_cell(row["model"] * 2, row["model"] == "pd")),
        ],
        is_selected=lambda row: row["kind"] == "policy",
        group_key=lambda row: row["kind"],
    )
    assert [[row.label, *(cell.text for cell in row.cells)] for row in made.rows] == [
        ["net", "policy", "1.25", "5.00", "netnet"],
        ["pd", "law", "–", "–", "pdpd"],
        ["lqr", "law", "2.00", "10.0", "lqrlqr"],
    ]
    marks = [(row.has_rule, row.is_selected) for row in made.rows]
    assert marks == [(True, True), (True, False), (False, False)]
    assert made.text_columns == [True, True, False, False, False]
    assert made.rows[1].cells[-1].mark == "bad"


def test_a_wide_table_stands_in_pieces_that_fit_a_sheet() -> None:
    wide = Table(["model", *"abcdef"], "Told.", [(f"group {k}", 2) for k in range(3)])
    wide.add_row("net", ["1234567890" * 2] * 6)
    pieces = wide.split_to_width
    assert [piece.columns for piece in pieces] == [["model", *"abcd"], ["model", *"ef"]]
    groups = [[("group 0", 2), ("group 1", 2)], [("group 2", 2)]]
    assert [piece.groups for piece in pieces] == groups
    assert [piece.caption for piece in pieces] == ["Told.", ""]
    with pytest.raises(ValueError, match="row 'net': 1 cells for 6 columns"):
        wide.add_row("net", ["1"])


def test_words_of_the_field_are_linked_once_a_section_to_what_they_mean(tmp_path: Path) -> None:
    sections = [
        Section("First", [Text("The NRMSE of free runs; the NRMSE again, and a heading.")]),
        Section("Second", [Text("Two runs diverged."), Bullets(["Its NRMSE is low."])]),
    ]
    text = write_page(tmp_path, "words", "", [], sections).read_text()
    assert text.count('href="#word-nrmse"') == 2
    assert text.count('<dt id="word-nrmse">') == 1
    assert '<a class="term" href="#word-free-run-rollout"' in text
    assert ">free run</a>s; the NRMSE again" in text
    assert 'id="word-head"' not in text
