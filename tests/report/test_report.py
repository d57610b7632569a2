"""The page of a fit: its numbers are those of the folder's files, and what a folder lacks is left
out.
"""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser, layout
from made_run import (
    DEG,
    LEVEL,
    finding,
    inspection,
    limits,
    made_run,
    metrics,
    protocol_limits,
    row,
    write_fit_page,
    write_json,
)
from made_series import autoregressive
from read_page import Page, plain

from residnet.core.errors import DataError, UsageError
from residnet.core.format import format_interval, format_number
from residnet.core.log import Log
from residnet.evaluation.goodness import (
    OneStepResiduals,
    build_goodness_file,
    build_goodness_table,
)
from residnet.evaluation.records import SANITY_CHECKS, SanityRow
from residnet.evaluation.soundness import build_sanity_file
from residnet.evaluation.verdict import LEVEL_TEXTS
from residnet.quality import build_inspection, inspect_log, inspect_log_set
from residnet.report.blocks import Section, Table, Text
from residnet.report.fit import write_fit_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections.models import goodness_section, term_unit

REFITTED = "values and standard errors are those after the refit through rollouts"


def shown(run: Path) -> str:
    """Return the text of the page, with spaces where numbers keep to their units."""
    return plain(write_fit_page(RunFiles(run)))


def part(text: str, section: str) -> str:
    (found,) = re.findall(rf'<section[^>]* ?id="{section}">.*?</section>', text, re.DOTALL)
    return str(found)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return made_run(tmp_path / "made")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of the made-up run as it is."""
    return shown(made_run(tmp_path_factory.mktemp("made") / "run"))


def test_free_run_numbers_are_those_of_metrics(page: str) -> None:
    cells = Page(part(page, "free-runs")).table("model", "plsr (selected)")
    # train and test of u, v, r, then nrmse with its interval, position, heading, diverged
    plsr = cells["plsr (selected)"]
    assert plsr[:3] == ["0.0320|−60 %", "0.0400|−60 %", "0.0240|−40 %"]
    assert plsr[3:6] == ["0.0300|−40 %", "0.458|−50 %", "0.573|−50 %"]
    assert row("plsr", "test", "whole")["nrmse"]["mean"] == pytest.approx(0.08)
    turned = format_number(DEG * LEVEL["plsr"][2], 2)
    assert plsr[7:14:2] == ["0.0800|0.0720–0.0880", "0.40", turned, "0/6"]
    assert cells["mlp"][3] == "0.0510|+2 %"
    assert cells["baseline"][1] == "0.100"
    assert 'class="bad">0.0510' in page
    cells = Page(page).table("manoeuvre, model", "turning: baseline")
    assert [cells[f"{kind}: baseline"][1] for kind in ("turning", "zigzag")] == ["0.110", "0.120"]


def test_the_first_screen_answers_how_far_off_and_which_model(page: str) -> None:
    first = page.partition('id="at-a-glance"')[2].partition("</section>")[0]
    (table,) = Page(f"<section>{first}</section>").tables
    assert table[0] == ["model", "error after 30 s", ""]
    # what is selected, then what it is to be better than, then the others, the nearest first
    labels = [line[0] for line in table[2:]]
    assert labels == ["plsr (selected)", "baseline", "constant_velocity", "plant", "mlp"]
    assert table[2][1:3] == ["0.40", format_number(DEG * LEVEL["plsr"][2], 2)]
    assert "Mean of 6 free runs on test data (T30)." in first
    # the run holds no errors after single times, so that nothing is known to be good
    text = html.unescape(page)
    verdict = re.search(r'<section class="verdict limited".*?</section>', text, re.DOTALL)
    assert verdict is not None
    assert "On test data the velocity errors of plsr" in verdict[0]
    assert "! Limited" in page
    for absent in ("Before you use it", "Physical sanity", 'id="data-checks"', REFITTED):
        assert absent not in text


def test_parameters_heads_data_and_provenance(page: str) -> None:
    read = Page(page)
    terms = read.table("term", "du/dt: u")
    assert terms["du/dt: u"] == ["−0.914", "0.076", "12", "1/s"]
    assert terms["dr/dt: v|v|"] == ["0.50", "0.10", "5.0", "rad/m²"]
    heads = read.table("head", "plsr (selected)")
    assert heads["plsr (selected)"][1:3] == ["23 basis functions; order 7 (latent variables)", "72"]
    assert heads["mlp"][1:4] == ["layers of 16, 8", "1\u2009347", "u, n"]
    quality = read.table("split, manoeuvre", "test: zigzag")["test: zigzag"]
    assert quality[:6] == ["3", "180", "1800", "97.5", "95.0", "frozen 2.5 %"]
    assert quality[6:] == ["1.50", "0.200", "5.73"]
    told = ("9.8.7", "abc123", "f00d", "torch 2.13.0", "on 2400 samples", "selection: whole")
    assert [words for words in told if words not in page] == []


def test_bad_news_is_told(run: Path) -> None:
    content = metrics()
    for line in content["rows"]:
        if (line["model"], line["split"], line["manoeuvre"]) == ("plsr", "test", "all"):
            line["diverged"] = 2
            line["rmse"] = line["rmse"] | {"v": 0.06}
            line["nrmse"] = line["nrmse"] | {"mean": 0.3}
    write_json(run / "metrics.json", content)
    page = html.unescape(shown(run))
    first = page.partition('id="at-a-glance"')[2].partition("</section>")[0]
    assert '<td class="text"><div>✗<small>2/6 diverged</small>' in first
    assert "plsr is worse than the baseline in sway v" in page
    assert "times its training error" in page


def judged(run: Path, level: str) -> Path:
    """A made-up run whose verdict has that level; a log has a clock that jumps."""
    ends = {"position": 0.4, "heading": 0.01}
    # what the end of an interval allows counts
    most = 15.0 if level == "limited" else 1.1
    spans = {of: [0.9 * x, most * x] for of, x in ends.items()}
    windows = 3 if level == "too few windows" else 12
    horizon: dict[str, Any] = {
        "seconds": 30.0,
        "windows": windows,
        "logs": 4,
        "slowest": 0.9,
        "fastest": 1.1,
    }
    floor = {**ends, "intervals": dict.fromkeys(ends)}
    others = {
        "constant_velocity": {"position": 12.0, "heading": 12.0 / DEG},
        "baseline": {"position": 1.0, "heading": 1.1 / DEG},
    }
    models = {
        name: {**other, "intervals": {of: [0.8 * x, 1.2 * x] for of, x in other.items()}}
        for name, other in others.items()
    }
    models["plsr"] = {**ends, "intervals": spans}
    horizon |= {"sailed": 30.0, "floor": floor, "models": models}
    horizons = [{**horizon, "seconds": 10.0, "windows": windows, "sailed": 10.0}, horizon]
    path = made_run(run)
    write_json(path / "limits.json", limits({"T30": protocol_limits(horizons=horizons)}, {}))
    late = finding("gaps", "will mislead", "a gap", effect=0.2)
    write_json(path / "doctor.json", inspection({"zigzag_01": [late], "zigzag_02": []}, []))
    if level == "do not use":
        content = metrics()
        for line in content["rows"]:
            line["nrmse"]["mean"] *= 100.0 if line["model"] == "plsr" else 1.0
        write_json(path / "metrics.json", content)
    return path


def five_answers(seen: str, level: str) -> bool:
    """How far off after 30 s, better than doing nothing, which model, is it of use, which data."""
    rows = (
        "error after 30 s",
        r"plsr \(selected\) \| 0.40.{,20}\| 0.57",
        r"constant_velocity \| 12.{,20}\| 12",
    )
    doctor = "1 of 2 logs has faults that would mislead a fit: gaps"
    words = (*rows, re.escape(LEVEL_TEXTS[level]), re.escape(doctor))
    return all(re.search(pattern, seen) for pattern in words)


@pytest.mark.parametrize("level", LEVEL_TEXTS)
def test_five_questions_are_answered_before_the_first_section(level: str, tmp_path: Path) -> None:
    text = html.unescape(shown(judged(tmp_path / "run", level)))
    opening = text.partition("<main")[2].partition('id="at-a-glance"')
    glance = Page(f"<section>{opening[2].partition('</section>')[0]}</section>").tables[0]
    rows = " | ".join(" | ".join(line) for line in glance)
    assert five_answers(f"{opening[0]} {rows}", level)


NEXT_STEPS = {
    "good": "Test your controller in simulation",
    "limited": "Record more logs",
    "do not use": "Record more logs",
    "too few windows": "Record more test logs",
}


def facts_of(run: Path) -> str:
    """The facts of the first screen as text."""
    text = html.unescape(shown(run))
    facts = re.search(r'<section class="facts">.*?</section>', text, re.DOTALL)
    assert facts is not None
    assert text.index("</section>", text.index('id="verdict"')) < facts.start()
    assert facts.end() < text.index('id="at-a-glance"')
    return re.sub(r"<[^>]+>", "", facts[0])


@pytest.mark.parametrize("level", LEVEL_TEXTS)
def test_facts_have_reference_evidence_domain_and_next_step(level: str, tmp_path: Path) -> None:
    run = judged(tmp_path / "run", level)
    file = run / "models" / "plsr" / "model.json"
    ranges = {"low": [0.0, -0.2, -0.1, 5.0], "high": [1.25, 0.2, 0.1, 20.0]}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {**ranges, "signals": {"inputs": ["n"]}})
    facts = facts_of(run)
    assert "position 0.40 m instead of 12 m; heading 0.57 deg instead of 12 deg" in facts
    assert "free runs of 30 s on 4 test logs: zigzag (3) and turning (1)" in facts
    assert "mean speeds 0.90 to 1.1 m/s" in facts
    domain = "u 0.00 to 1.25 m/s, v −0.200 to 0.200 m/s, r −5.73 to 5.73 deg/s, n 5.0 to 20.0 1/s"
    assert f"{domain}; errors outside, and under other kinds of commands than" in facts
    assert "First fix this: zigzag_01: a gap" in facts
    (run / "doctor.json").unlink()
    facts = facts_of(run)
    assert NEXT_STEPS[level] in facts
    is_exported = "residnet export RUN --format c" in facts
    assert is_exported == (level != "do not use")
    assert ("not exported unless" in facts) == (level == "do not use")


def test_facts_say_when_constant_velocity_is_not_beaten(tmp_path: Path) -> None:
    run = judged(tmp_path / "run", "good")
    content = json.loads((run / "limits.json").read_text())
    for horizon in content["splits"]["test"]["T30"]["horizons"]:
        horizon["models"]["constant_velocity"] |= {
            "position": 0.3,
            "intervals": {"position": [0.2, 0.4], "heading": [0.1, 0.3]},
        }
    write_json(run / "limits.json", content)
    facts = facts_of(run)
    assert "The model is not shown to be better than holding the initial velocities" in facts
    assert "position 0.40 m instead of 0.30 m (not smaller)" in facts


def test_free_runs_of_logs_that_turn_to_one_side_make_no_good_model(tmp_path: Path) -> None:
    run = judged(tmp_path / "run", "good")
    doctor = json.loads((run / "doctor.json").read_text())
    text = "all of 9 logs turn to port"
    for known, found in (("good", "note"), ("limited", "will mislead")):
        together = [finding("one_side", found, text)]
        write_json(run / "doctor.json", doctor | {"together": together})
        opening = html.unescape(shown(run)).partition('id="at-a-glance"')[0]
        assert LEVEL_TEXTS[known] in opening
        assert (text in opening) == (known == "limited")


@pytest.mark.long
@pytest.mark.skipif(browser() is None, reason="no browser is installed")
@pytest.mark.parametrize("level", ["good", "do not use"])
def test_five_questions_are_answered_by_the_first_screen_alone(level: str, tmp_path: Path) -> None:
    run = RunFiles(judged(tmp_path / "run", level))
    write_fit_figures(run)
    page = write_fit_page(run)
    for width, height in ((1400, 900), (390, 844)):
        first = layout(page, width, tmp_path).first
        assert first["pictures"]
        assert max(first["verdict"], *first["pictures"]) < height
        # what is selected, the baseline, and zero
        assert first["rows"][2] < height
        assert first["words"] < 6_000
        told = [" ".join(text.split()) for text, end in first["told"] if end < height]
        assert five_answers(" | ".join(told), level)


def limits_file() -> dict[str, Any]:
    """Contents of limits.json for the protocol that selects."""
    paired = {"to": "baseline", "nrmse_mean": -0.02, "ci95": [-0.03, -0.01]}
    paired |= {"excludes_zero": True, "ratio": 0.8, "worse": False}
    of_plsr = {"plsr": {"nrmse_mean": 0.08, "difference": paired}}
    bands = [{"by": "wind", "low": 1.0, "high": 2.5, "windows": 4, "models": of_plsr}]
    worst = {"log": "zigzag_02", "manoeuvre": "zigzag", "t": 12.5, "nrmse": 0.3}
    worst |= {"rmse": {"u": 0.1, "v": 0.2, "r": 0.01}, "position_error_end": 4.2}
    tolerance = {"command_share_of_range": 0.05, "start": {"u": 0.125, "v": 0.0625, "r": 0.0625}}
    motion = {"u": 0.04, "v": 0.02, "r": 1 / DEG, "position": 2.0, "heading": 5 / DEG, "nrmse": 0.2}
    repeats = {"tolerance": tolerance, "pairs": 3, "logs": 2, **motion}
    repeats["manoeuvres"] = {"zigzag": {"pairs": 3, **motion}}
    whole = protocol_limits(bands=bands, worst={"plsr": [worst]})
    return limits({"T30": whole}, {"T30": repeats})


def compared(change: dict[str, float]) -> dict[str, Any]:
    """metrics.json whose heads are compared with the baseline; `change` is the ratio of plsr by
    kind of manoeuvre.
    """
    content = metrics()
    for line in content["rows"]:
        ratio = change.get(line["manoeuvre"], 0.8) if line["model"] == "plsr" else 0.9
        apart = line["nrmse"]["mean"] * (1 - 1 / ratio)
        span = [1.5 * apart, 0.5 * apart] if line["manoeuvre"] == "all" else None
        found = {"to": "baseline", "nrmse_mean": apart, "ci95": span, "ratio": ratio}
        found |= {"excludes_zero": span is not None, "worse": ratio > 1.05}
        line["difference"] = found if line["kind"] == "head" else None
        line["ci95_blocks"] = {"of": "logs", "count": 6}
    return content


def test_how_good_where_it_fails_and_what_limits_it(run: Path) -> None:
    write_json(run / "metrics.json", compared({"turning": 1.2}))
    write_json(run / "limits.json", limits_file())
    text = shown(run)
    cells = Page(text).table("windows of", "all")
    # plsr has 0.08, 0.8 times its reference, so that has 0.1
    paired = ["0.0800", "0.100", "−20 %", "−0.0200", "−0.0300 to −0.0100"]
    assert cells["all"] == ["6", *paired]
    assert cells["turning"] == ["6", "0.0880", "0.0733", "+20 %", "+0.0147", "–"]
    assert cells["wind 1.0 to 2.5 m/s"] == ["4", *paired]
    worst = Page(text).table("worst windows", "zigzag_02 (zigzag)")
    assert worst["zigzag_02 (zigzag)"] == ["12.5", "0.300", "0.100", "0.200", "0.573", "4.2"]
    page = html.unescape(text)
    for words in (
        "3 pairs of stretches (zigzag 3) in 2 of the logs of all splits have commands within 5 %",
        "differ by u 0.0400 m/s, v 0.0200 m/s, r 1.00 deg/s (root mean square), and by 2.0 m and"
        " 5.0 deg at the end",
        "an NRMSE of 0.141 and 1.4 m",
        "Protocol T30: worse by more than 5 % in NRMSE on test data: plsr against baseline"
        " (turning +20 %).",
    ):
        assert words in page


def test_no_repeats_no_reference_and_no_interval_are_said(run: Path) -> None:
    content = compared({})
    found = limits_file()
    none = dict.fromkeys(("difference", "ci95_blocks", "nrmse_mean_ci95"))
    for line in content["rows"]:
        line |= {**none, "rmse_ci95": dict.fromkeys("uvr")}
    write_json(run / "metrics.json", content)
    tolerance = found["repeatability"]["T30"]["tolerance"]
    found["repeatability"]["T30"] = {"tolerance": tolerance, "pairs": 0, "logs": 0}
    write_json(run / "limits.json", found)
    text = html.unescape(shown(run))
    assert Page(text).table("windows of", "all")["all"] == ["6", "0.0800", *4 * "–"]
    assert "hold no two stretches as long as a window" in text
    assert "worse by more than 5 %" not in text


def sick(name: str, gyro: float) -> Log:
    t = np.arange(0.0, 100.0, 0.1)
    turn = {"psi": 0.5 * np.sin(0.2 * t), "r": 0.1 * np.cos(0.2 * t) + gyro}
    move = {"u": 1.0 + 0.1 * np.sin(0.1 * t), "v": 0.05 * np.sin(0.3 * t)}
    return Log(name, t, {**turn, **move, "delta": 0.3 * np.sin(0.21 * t)})


def test_what_doctor_sanity_refit_and_currents_found_is_shown(run: Path) -> None:
    """Findings above a note stand in a table, notes below."""
    logs = [sick("first", np.radians(0.5)), sick("second", 0.0)]
    clock = logs[1].t.copy()
    clock[500:] += 7.0
    logs[1] = logs[1].replace(t=clock)
    reports = [inspect_log(log) for log in logs]
    write_json(run / "doctor.json", build_inspection(reports, inspect_log_set(logs)).to_content())
    checks = [
        SanityRow(model="plsr", check=check, ok=check != "damping", text=f"words on {check}")
        for check in SANITY_CHECKS
    ]
    write_json(run / "sanity.json", build_sanity_file({"plsr": checks}).to_content())
    fit = run / "models" / "baseline" / "fit.json"
    write_json(fit, json.loads(fit.read_text()) | {"refit": {"iterations": 3}})
    current = {"current_north": 0.31, "current_east": -0.1, "standard_error": [0.02, 0.015]}
    fitted = {"zigzag_01": True, "zigzag_02": False}
    currents = [{"log": name, "fitted": one, **current} for name, one in fitted.items()]
    write_json(run / "currents.json", currents)
    text = html.unescape(shown(run))
    for words in ("Physical sanity", "plsr, damping: words on damping", REFITTED):
        assert words in text
    assert "0.31 ± 0.020" in text
    assert "A constant current of each log was estimated: 0.33 m/s on average" in text
    assert "of other logs" in text
    loud = {one.code for report in reports for one in report.findings if one.level != "note"}
    assert loud == {"yaw_drift"}
    assert '<a href="#data-checks">Data checks</a>' in text
    page = part(text, "data-checks")
    for code in loud:
        assert f'<th class="label"><div>{code.replace("_", " ")}</div></th>' in page
    assert "split the log there (mask kind: gap)" in page
    assert "10 Hz over" in page


def test_members_that_an_ensemble_does_not_use_are_named_with_the_reason(run: Path) -> None:
    fit = run / "models" / "mlp" / "fit.json"
    evidence = {"velocity": "v", "reference": "constant velocity", "p_value": 0.012}
    notes = {
        "members": ["hull", "hull_network"],
        "left_out": ["lstm"],
        "exclusions": [{"member": "hull", **evidence}],
    }
    write_json(fit, json.loads(fit.read_text()) | notes)
    text = part(html.unescape(shown(run)), "models")
    assert "mean of hull (not for v), hull_network" in text
    assert (
        "mlp: hull is not used for sway v (p = 0.01): on validation logs constant velocity has a"
        " smaller error (paired t-test)." in text
    )
    assert "mlp: lstm is not a member: it diverged on validation logs." in text


def test_goodness_of_fit_is_as_the_file_says(run: Path) -> None:
    target = autoregressive(0.9, 3, 800, seed=0).T
    noise = 0.01 * np.random.default_rng(0).normal(size=target.shape)
    models = [
        OneStepResiduals("baseline", "baseline", [4, 4, 4], [0.5 * target]),
        OneStepResiduals("plsr", "head", [9, 9, 9], [0.4 * target + noise], "baseline"),
    ]
    rows = build_goodness_table(models, [target], 0.1)
    write_json(
        run / "goodness.json",
        build_goodness_file("made", {"train": rows, "test": rows}, 0.1).to_content(),
    )
    found = goodness_section(RunFiles(run))
    assert found is not None
    parts = [one for one in found.present_blocks if isinstance(one, Section)]
    units = {"surge du/dt": "m/s²", "sway dv/dt": "m/s²", "yaw dr/dt": "deg/s²"}
    assert [one.title for one in parts] == [f"{k} [{u}], test data" for k, u in units.items()]
    fits, residuals, sentences = parts[2].present_blocks
    assert isinstance(fits, Table)
    assert isinstance(residuals, Table)
    assert isinstance(sentences, Text)
    yaw = {line.label: line.cells for line in residuals.rows}
    line = next(line for line in rows if (line.model, line.axis) == ("plsr", "r_dot"))
    texts = [cell.text for cell in fits.rows[1].cells]
    assert texts[:3] == ["9.00", format_number(DEG * line.rmse), format_number(line.r2)]
    assert yaw["plsr"][1].text == format_interval(line.mae_ci95, DEG)
    assert (yaw["plsr"][-1].note, yaw["plsr"][-1].mark) == ("to baseline", "best")
    assert yaw["baseline"][-1].text == "–"
    assert "times too narrow" in sentences.nonempty_paragraphs[0]
    assert 'id="goodness-of-fit"' in shown(run)


def test_a_folder_of_evaluate_has_other_splits_and_no_models(tmp_path: Path) -> None:
    folder = made_run(tmp_path / "other", split="external")
    for path in (folder / "models").rglob("*.json"):
        path.unlink()
    write_json(
        folder / "metrics.json", metrics(("external",), ("constant_velocity", "baseline", "plsr"))
    )
    text = shown(folder)
    assert Page(text).table("model", "plsr (selected)")["plsr (selected)"][0] == "0.40"
    for absent in ("Baseline parameters", "Residual heads", "simulated plant", "side by side"):
        assert absent not in text


def test_metrics_alone_make_a_report_and_folders_without_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "metrics.json"
    for text, error, said in (
        (None, UsageError, r"no metrics\.json"),
        ("{", UsageError, "not readable as JSON"),
        ("{}", UsageError, r"metrics\.json: key 'schema': field required"),
        (json.dumps(metrics() | {"rows": []}), DataError, "holds no rows"),
    ):
        if text is not None:
            file.write_text(text)
        with pytest.raises(error, match=said):
            write_fit_page(RunFiles(tmp_path))
    content = metrics(("validation",), ("plsr",))
    content["rows"] = [line for line in content["rows"] if line["manoeuvre"] == "all"]
    write_json(file, content)
    text = shown(tmp_path)
    Page(text)
    assert "Fit or selection used these data: errors on new data are larger." in text
    assert "Provenance" not in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.031849, "0.0318"),
        (1234.0, "1234"),
        (0.0, "0"),
        (-0.5, "−0.500"),
        (1.2e-7, "1.20e−07"),
        (None, "–"),
        (float("nan"), "–"),
    ],
)
def test_numbers_have_three_digits(value: float | None, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("axis", "term", "unit"),
    [
        ("u_dot", "u|u|", "1/m"),
        ("u_dot", "1", "m/s²"),
        ("u_dot", "tau_x", "m/(s²·N)"),
        ("r_dot", "tau_n", "rad/(s²·N·m)"),
        ("v_dot", "u r", "1/rad"),
        ("r_dot", "n^2 delta", "-"),
        ("v_dot", "wind_v|wind_v|", "1/m"),
        ("v_dot", "lever", ""),
    ],
)
def test_units_of_coefficients(axis: str, term: str, unit: str) -> None:
    assert term_unit(axis, term) == unit


def test_facts_name_the_exported_file(tmp_path: Path) -> None:
    run = judged(tmp_path / "run", "good")
    export = {"model": "selected", "file": "exports/plsr.pt", "fault": None}
    write_json(run / "exports.json", {"schema": "residnet.exports/1", "exports": [export]})
    assert "exports/plsr.pt; as C source: residnet export RUN --format c." in facts_of(run)
