"""`residnet new --length --scale` on workbooks of a model basin whose ship is known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny import Command, read_json, write_yaml

import residnet
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.physics.actuators.steering_gear import simulate_gear
from residnet.tasks.demo import write_basin_workbooks
from residnet.tasks.naval_draft import (
    NavalParticulars,
    choose_held_out_logs,
    draft_naval_sections,
)

LENGTH = 3.2186


def zigzag(name: str, angle_deg: float, *, astern: bool = False, has_command: bool = True) -> Log:
    t = np.arange(0.0, 90.0, 0.1)
    command = np.radians(angle_deg) * np.where((t // 12) % 2 == 0, 1.0, -1.0) * (t > 5)
    channels = {
        "u": np.full_like(t, 1.09),
        "v": 0.0 * t,
        "r": 0.05 * np.sin(0.3 * t) * angle_deg / 10,
        "psi": 0.2 * np.sin(0.3 * t),
        "n": np.where((t > 80) & astern, -9.0, 9.5),
        "delta": simulate_gear(command, 0.0, 0.1, math.radians(15.0), 0.5, 0.0),
    }
    if has_command:
        channels["cmd_delta"] = command
    return Log(name, t, channels, manoeuvre="zigzag")


def draft(logs: list[Log], inputs: tuple[str, ...] = ("delta", "n")) -> tuple[dict, DraftNotes]:
    notes = DraftNotes(None, None)
    naval = NavalParticulars(LENGTH, 50.0, {"beam": 0.46})
    return draft_naval_sections(logs, inputs, naval, "hull", notes), notes


def test_the_booklet_has_the_manoeuvres_within_the_tests_and_the_identified_gear() -> None:
    sections, _ = draft([zigzag("a", 20.0), zigzag("b", 10.0)])
    booklet = sections["booklet"]
    names = [entry["name"] for entry in booklet["manoeuvres"]]
    assert names == [
        "circle_20_starboard",
        "circle_20_port",
        "pull_out_starboard",
        "pull_out_port",
        "zigzag_10_10",
        "zigzag_20_20",
    ]
    gear = booklet["inputs"]["delta"]
    assert float(gear["rate"].split()[0]) == pytest.approx(15.0, rel=0.05)
    assert float(gear["lag"].split()[0]) == pytest.approx(0.5, rel=0.1)
    assert booklet["initial"] == {"u": "1.09 m/s"}
    assert sections["derivatives"]["beam"] == "0.46 m"


def test_a_stopping_trial_needs_astern_revolutions_in_the_logs() -> None:
    sections, _ = draft([zigzag("a", 20.0, astern=True)])
    assert sections["booklet"]["manoeuvres"][-1]["kind"] == "stopping"
    _, notes = draft([zigzag("a", 20.0)])
    assert any("no stopping trial" in text for _, text in notes.notes)


def test_without_commands_the_rate_alone_is_estimated_and_named() -> None:
    sections, notes = draft([zigzag("a", 20.0, has_command=False)])
    gear = sections["booklet"]["inputs"]["delta"]
    assert "lag" not in gear
    assert any("declare lag and delay" in text for _, text in notes.guessed_values)


def test_logs_without_a_rudder_have_a_note_instead_of_a_booklet() -> None:
    sections, notes = draft([zigzag("a", 20.0)], inputs=("n",))
    assert sections == {}
    assert any("one rudder among the inputs" in text for _, text in notes.guessed_values)


def test_of_few_manoeuvres_the_mildest_ones_are_held_out() -> None:
    logs = {Path(name): zigzag(name, angle) for name, angle in (("a", 30), ("b", 10), ("c", 20))}
    assert choose_held_out_logs(logs) == {
        "train": [Path("a")],
        "validation": [Path("c")],
        "test": [Path("b")],
    }
    assert choose_held_out_logs(dict(list(logs.items())[:2])) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--scale", "50"), "--scale: needs --length too"),
        (("--length", "3 kg"), "--length: "),
        (("--length", "3", "--scale", "0"), "--scale: expected a positive number"),
    ],
)
def test_a_wrong_option_is_one_line(
    options: tuple[str, ...], message: str, tmp_path: Path, command: Command
) -> None:
    said = command("new", tmp_path, "--out", tmp_path / "a.yaml", *options)
    assert said.code == 2
    assert message in said.err


def test_python_refuses_an_unknown_particular(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no argument 'bem'"):
        residnet.draft_config(tmp_path, length="3.22 m", bem=0.5)
    with pytest.raises(UsageError, match="needs --length too"):
        residnet.draft_config(tmp_path, scale=50.0)


@pytest.mark.long
def test_a_basin_predicts_the_ship_at_full_scale(tmp_path: Path, command: Command) -> None:
    """The workbooks are those of the Mariner at 1:50, whose full-scale circle is known."""
    write_basin_workbooks(tmp_path / "basin")
    config = tmp_path / "basin.yaml"
    said = command(
        "new", tmp_path / "basin", "--length", "3.2186", "--scale", "50", "--out", config,
        "--defaults",
    )  # fmt: skip
    assert said.code == 0, said.err
    content = yaml.safe_load(config.read_text())
    content |= {"baseline": {"kind": "regressors", "terms": ["1", "u", "v", "r", "delta"]}}
    turn = ["1", "v", "r", "u v", "u r", "v^3", "v^2 r", "v r^2", "r^3", "u|u| delta", "delta^3"]
    surge = ["1", "u", "u^2", "v^2", "r^2", "v r", "delta^2", "v delta"]
    terms = {"u": surge, "v": turn, "r": turn}
    content["baselines"] = {"hull": {"kind": "regressors", "terms": terms, "ridge": 1e-8}}
    content["refit"] = {"hull": {"horizon": "15 s", "every": "7 s"}}
    del content["recipe"]
    run = tmp_path / "run"
    said = command("run", write_yaml(config, content), "--out", run)
    assert said.code == 0, said.err
    pages = {page["name"]: page["indices"] for page in read_json(run / "booklet.json")["pages"]}
    # MSS mariner.m: tactical diameter at 35 deg to starboard by simulation at full scale
    diameter = pages["circle_35_starboard"]["tactical_diameter"]
    measured = pages["TC_35_S"]["tactical_diameter"]["measured"]
    assert diameter["ship"] == pytest.approx(50.0 * measured, rel=0.05)
    # the gear's lag and rate are part of the manoeuvre: the overshoot is that of the test
    overshoot = pages["zigzag_10_10"]["first_overshoot"]["value"]
    truth = pages["ZZ_10-10_S"]["first_overshoot"]["measured"]
    assert math.degrees(overshoot) == pytest.approx(math.degrees(truth), abs=1.0)
    assert (run / "derivatives.json").is_file()
    assert (run / "derivatives_ship.json").is_file()
    ship = tmp_path / "ship"
    assert command("scale", run, "--scale", "50", "--out", ship).code == 0
    full = {page["name"]: page["indices"] for page in read_json(ship / "booklet.json")["pages"]}
    scaled = full["circle_35_starboard"]["tactical_diameter"]
    assert scaled["value"] == pytest.approx(diameter["ship"], rel=1e-3)
    pdf = command("report", run, "--pdf", "--out", tmp_path / "client.pdf")
    assert pdf.code == 0, pdf.err
    assert (tmp_path / "client.pdf").read_bytes()[:5] == b"%PDF-"
