"""The report's page of the data doctor, from a doctor.json as a fit writes it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from made_run import made_run, write_fit_page
from read_page import plain

from residnet.core.log import Log
from residnet.data.doctor import inspect, inspect_together, inspection
from residnet.report.run_reader import RunFiles


def sick(name: str, gyro: float) -> Log:
    t = np.arange(0.0, 100.0, 0.1)
    psi = 0.5 * np.sin(0.2 * t)
    r = 0.1 * np.cos(0.2 * t) + gyro
    return Log(
        name,
        t,
        {
            "psi": psi,
            "r": r,
            "u": 1.0 + 0.1 * np.sin(0.1 * t),
            "v": 0.05 * np.sin(0.3 * t),
            "delta": 0.3 * np.sin(0.21 * t),
        },
    )


def test_findings_above_a_note_stand_in_a_table_and_notes_below(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run")
    assert 'id="data-doctor"' not in write_fit_page(RunFiles(run)).read_text()
    logs = [sick("first", np.radians(0.5)), sick("second", 0.0)]
    clock = logs[1].t.copy()
    clock[500:] += 7.0
    logs[1] = logs[1].replace(t=clock)
    reports = [inspect(log) for log in logs]
    (run / "doctor.json").write_text(json.dumps(inspection(reports, inspect_together(logs))))
    text = plain(write_fit_page(RunFiles(run)))
    loud = {
        finding.code for report in reports for finding in report.findings if finding.level != "note"
    }
    assert "gaps" in loud
    page = text[
        text.index('<section id="data-doctor">') : text.index(
            "</section>", text.index('<section id="data-doctor">')
        )
    ]
    assert '<a href="#data-doctor">Data doctor</a>' in text
    assert all(
        f'<th class="label"><div>{code.replace("_", " ")}</div></th>' in page for code in loud
    )
    assert "split the log there (mask kind: gap)" in page
    assert "10 Hz over" in page
