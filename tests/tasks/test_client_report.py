"""`residnet report --pdf`: the client report of a fit, and its errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from made_run import KINDS, data_quality, made_run, write_json
from tiny import write_yaml

from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.report.client import ClientText, read_client_text, write_client_report
from residnet.report.client_content import ReportTable, ReportText, build_sections
from residnet.report.run_reader import RunFiles

typst = pytest.importorskip("typst")

LOGO = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="40" height="20">'
    '<rect width="40" height="20"/></svg>'
)


def test_the_sections_have_the_tests_the_errors_and_the_limits(tmp_path: Path) -> None:
    folder = made_run(tmp_path / "run")
    rows = data_quality({"early_1": "zigzag", "early_2": "zigzag"}, "train")
    write_json(folder / "data_quality.json", [*rows, *data_quality(KINDS, "test")])
    sections = build_sections(RunFiles(folder), {})
    titles = [section.title for section in sections]
    assert titles == [
        "Summary",
        "Vessel and tests",
        "Validation on held-out manoeuvres",
        "Limits of validity",
    ]
    for section in sections:
        for block in section.blocks:
            if isinstance(block, ReportTable):
                assert all(len(row) == len(block.header) for row in block.rows)
    summary = sections[0].blocks[0]
    assert isinstance(summary, ReportText)
    assert f"identified from 2 of {2 + len(KINDS)} records" in summary.paragraphs[0]


def test_the_pdf_has_logo_and_text_of_the_user(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run")
    logo = tmp_path / "logo.svg"
    logo.write_text(LOGO)
    text = ClientText(title="Trials of #Anna*", client="A yard", introduction=("One $paragraph_.",))
    pdf = write_client_report(run, tmp_path / "a.pdf", logo=logo, text=text)
    assert pdf.read_bytes()[:5] == b"%PDF-"
    # a template of the user's own gets the same data; its markup is not that of the text
    template = tmp_path / "mine.typ"
    template.write_text('#let data = json("report.json")\n#data.title\n#image(data.logo)')
    write_client_report(run, tmp_path / "b.pdf", template=str(template), logo=logo, text=text)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"template": "none.typ"}, "expected 'client' or an existing Typst file"),
        ({"logo": Path("none.svg")}, "expected an existing image"),
    ],
)
def test_a_missing_file_is_one_line(settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    run = made_run(tmp_path / "run")
    with pytest.raises(UsageError, match=message):
        write_client_report(run, tmp_path / "a.pdf", **settings)


def test_a_wrong_template_or_text_is_one_line(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run")
    broken = tmp_path / "broken.typ"
    broken.write_text("#unknown")
    with pytest.raises(DataError, match="Typst cannot compile the template"):
        write_client_report(run, tmp_path / "a.pdf", template=str(broken))
    with pytest.raises(ConfigError, match="titel"):
        read_client_text(write_yaml(tmp_path / "a.yaml", {"titel": "a"}))
