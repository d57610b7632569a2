"""The manoeuvring booklet of a fit, on simulated zigzags of the rudder boat whose own indices are
known; and the trials that would narrow it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from read_page import plain
from tiny import Command, read_json, write_yaml

pytestmark = pytest.mark.long

CONFIG = """
task: fit
name: booklet
data:
  kind: simulated
  vessel: example_rudder_boat
  seed: 1
  trials:
    - {kind: zigzag, count: 10, heading: [10 deg, 20 deg], drive: [0.6, 0.8]}
  duration: 40 s
  step: 0.2 s
  noise: {u: 0.01, v: 0.01, r: 0.1 deg/s}
  identification: {zigzag: 6}
  validation: {zigzag: 2}
prepare:
  grid: {step: 0.2 s}
  derivative: {kind: savitzky_golay, window: 1.4 s, order: 2}
signals: {inputs: [n, delta]}
integrator: heun
baseline: {kind: regressors, ridge: 1.0e-6, sets: [fossen]}
refit: {baseline: {horizon: 10 s, every: 10 s, iterations: 3}}
evaluation:
  protocols: {T10: {kind: windows, length: 10 s}}
  selection: T10
  scales: {u: 0.5, v: 0.2, r: 5 deg/s}
booklet:
  model: baseline
  length: 6 m
  scale: 4
  inputs: {n: {drive: 20}, delta: {steer: 30 deg, rate: 25 deg/s}}
  initial: {u: 4 m/s}
  duration: 60 s
  draws: 20
  manoeuvres:
    - {kind: turning_circle, name: circle, until: 360 deg, rudder: 25 deg, drive: 0.8, start: 0 s}
    - {kind: zigzag, name: ten_ten, rudder: 10 deg, heading: 10 deg, drive: 0.8, start: 0 s,
       reversals: 2}
"""


def write(folder: Path, **booklet: Any) -> Path:
    content = yaml.safe_load(CONFIG)
    content["booklet"] |= booklet
    return write_yaml(folder / "booklet.yaml", content)


def test_pages_hold_values_with_intervals_and_limits_beside_measured_ones(
    tmp_path: Path, command: Command
) -> None:
    run = tmp_path / "run"
    assert command("run", write(tmp_path), "--out", run).code == 0
    booklet = read_json(run / "booklet.json")
    pages = {page["name"]: page for page in booklet["pages"]}
    assert booklet["draws"] == 20
    circle = pages["circle"]["indices"]
    zigzag = pages["ten_ten"]["indices"]
    for found in (*circle.values(), *zigzag.values()):
        low, high = found["interval"]
        assert low <= high
    advance = circle["advance"]
    assert advance["interval"][0] < advance["value"] < advance["interval"][1]
    assert advance["lengths"] == pytest.approx(advance["value"] / 6.0)
    assert advance["ship"] == pytest.approx(4.0 * advance["value"])
    assert circle["time_90"]["ship"] == pytest.approx(2.0 * circle["time_90"]["value"])
    assert zigzag["initial_turning_distance"]["limit"] == pytest.approx(2.5 * 24.0)
    assert zigzag["first_overshoot"]["kept"] in (True, False)
    repeated = [page for page in booklet["pages"] if page["split"]]
    assert {page["split"] for page in repeated} == {"validation", "test"}
    assert len(repeated) == 6
    for page in repeated:
        first, yaw = (page["indices"][key] for key in ("first_overshoot", "largest_yaw_rate"))
        # the form of the model is nearly the plant's: what is left is within the turning of one
        # sample and of the gear's response (0.2 s each), which a rate alone leaves out
        assert abs(first["difference"]) < 0.4 * yaw["measured"], page["name"]
        assert first["measured"] > 0.02
    text = plain(run / "report.html")
    assert "Manoeuvring booklet" in text
    assert "tactical diameter" in text
    assert len(list((run / "figures").glob("*booklet*.png"))) == 3
    said = command("plan-trial", run, "--time", "60 s", "--out", tmp_path / "plan")
    assert said.code == 0
    assert "they narrow the prediction intervals" in said.out
    assert (tmp_path / "plan" / "next_tracks.csv").read_text().count("\n") > 100


def test_a_manoeuvre_that_does_not_end_is_named(tmp_path: Path, command: Command) -> None:
    said = command("run", write(tmp_path, duration="3 s"), "--out", tmp_path / "run")
    assert said.code == 1
    told = "circle: timed out after 2.8 s before a heading change of 360 deg; give more duration"
    assert told in said.err
