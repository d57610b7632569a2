"""What a user gets wrong is one line before any work, of `check` and of `run` alike."""

from __future__ import annotations

import copy
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tiny import SWEEP, TINY, call
from tiny_tasks import TINY_TASKS, actuators, autopilot, imported, measured

LAW = {"start": "ptos", "units": 3}
PROGRAMME: dict[str, Any] = {
    "task": "simulate",
    "name": "ship",
    "programme": {
        "vessel": "wam_v_cal",
        "duration": 60,
        "step": 0.1,
        "manoeuvres": [{"kind": "three_two_one_one", "drive": 0.5, "steer": 0.6, "unit": 2}],
    },
}
STUDY = {
    "task": "study",
    "name": "tiny_study",
    "base": "tiny.yaml",
    "common": ["heads={ridge: {kind: ridge}}", "training={}", "ensembles={}", "export.models=[]"],
    "variants": {"recipe": [], "short": ["heads.ridge.degree=1"]},
    "reference": "recipe",
    "model": "ridge",
    "seeds": [0, 1],
}
FERRY = {
    **TINY,
    "data": {**TINY["data"], "vessel": "milliampere_half"},
    "signals": {"inputs": ["tau_x", "tau_y", "tau_n"]},
    "baseline": {"kind": "believed", "vessel": "milliampere"},
    "heads": {"ridge": {"kind": "ridge", "space": "force"}},
    **{"ensembles": {}, "training": {}, "export": {"models": []}},
}
COURSE = {
    "task": "course",
    "name": "bend",
    "autopilot": "autopilot.yaml",
    "course": {
        "buoys": [
            {"north": 50.0, "east": 30.0, "leave_to": "port", "radius": 12.0},
            {"north": 100.0, "east": 20.0, "leave_to": "starboard", "radius": 12.0},
        ],
        "acceptance": 4.0,
        "lookahead": 10.0,
        "planning_dt": "0.2 s",
    },
    "peers": ["pd"],
    "duration": "42 s",
}


def steered(folder: Path) -> dict[str, Any]:
    content = autopilot(folder)
    content["peers"]["ptos"] = {"kind": "ptos", "lag": "0.3 s"}
    return content


def course(folder: Path) -> dict[str, Any]:
    (folder / "autopilot.yaml").write_text(yaml.safe_dump(autopilot(folder)))
    return COURSE


def by_recipe(folder: Path) -> dict[str, Any]:
    """Logs of 30 s without an input; the recipe's trainings follow from their length."""
    parts = ("baseline", "heads", "training", "prepare", "signals")
    content = {key: value for key, value in measured(folder).items() if key not in parts}
    prepare = {**measured(folder)["prepare"], "grid": {"step": 0.1}}
    return content | {"recipe": "standard", "prepare": prepare, "signals": {"inputs": []}}


def of_tiny(content: dict[str, Any]) -> Callable[[Path], dict[str, Any]]:
    def made(folder: Path) -> dict[str, Any]:
        (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY, sort_keys=False))
        return content

    return made


BASES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "fit": lambda _: TINY,
    "csv": measured,
    "recipe": by_recipe,
    "ferry": lambda _: FERRY,
    "trials": lambda _: {"task": "simulate", "name": "trials", "data": TINY["data"]},
    "ship": lambda _: PROGRAMME,
    "sweep": of_tiny(SWEEP),
    "study": of_tiny(STUDY),
    "actuators": actuators,
    "autopilot": steered,
    "course": course,
    "import": imported,
}
M = "programme.manoeuvres=[{kind: "
RUN = "programme.model={run: runs/tiny"
CASES: dict[str, list[tuple[str, str]]] = {
    "fit": [
        ("heads.lstm.hiden_size=3", "did you mean 'hidden_size'"),
        ("heads.lstm.kind=lstn", "did you mean 'lstm'"),
        ("'prepare.grid.step=3 deg'", "does not measure [s]"),
        ("evaluation.selection=manuvre", "did you mean 'manoeuvre'"),
        ("'heads.ridge.features=[u, w]'", "'w' is not a channel"),
        ("data.vessel=wam_w_cal", "did you mean 'wam_v_cal'"),
        ("'data.identification={zigzag: 9}'", "leaves a split empty"),
        ("training.mlp.steps=3", "no head is named 'mlp'"),
        ("export.models=[lstmm]", "did you mean 'lstm'"),
        ("baseline.steer=tau_z", "tau_z"),
        ("heads.ridge.folds=40", "head ridge: 40 folds need as many manoeuvres"),
        ("'baseline={kind: linear_steady, speed: [spiral]}'", "linear_steady"),
        ("prepare.grid.step=0.2", "must equal data.step (0.1 s)"),
        ("study=woo2018", "'nomoto' is absent; give it, or leave the study out"),
        ("booklet.model=ridge", "booklet"),
        ("current.baseline=bseline", "did you mean 'baseline'"),
        ("current.baseline=held baselines.held.kind=still", "no regressors to tell a current by"),
        ("current.baseline=baseline current.spread=0", "greater than 0"),
    ],
    "csv": [
        ("data.reader.channels.u.unit=deg", "m/s"),
        ("data.split.test=[none*.csv]", "none*.csv"),
        ("data.reader.channels.u.column=speed", "no column 'speed'"),
        ("'signals.inputs=[n, rudder]' 'baseline.terms=[u, rudder]'", "rudder"),
        ("heads.ridge.folds=9", "head ridge: 9 folds need as many manoeuvres"),
        ("baseline.manoeuvres=[zigzag]", "no sample is of the manoeuvres"),
        ("training.mlp.one_step.window=99.0", "no training log holds a window of 990 samples"),
        ("refit.baseline.horizon=200.0", "no training log holds a window of 2001 samples"),
        ("evaluation.protocols.T5.length=900", "no window of a protocol"),
    ],
    "ferry": [
        ("'heads.ridge.terms=[u_dot u]'", "accelerations only by themselves"),
        ("'heads.ridge={kind: ridge, terms: [u_dot]}'", "space: force"),
        (
            "'baseline={kind: regressors, terms: [u, tau_x]}'",
            "needs a baseline that knows its mass",
        ),
        ("'heads.mlp={kind: mlp, features: [u_dot]}'", "only a residual in force space knows it"),
    ],
    "trials": [
        ("data.trials.1.kind=zigzack", "did you mean 'zigzag'"),
        ("heads={}", "unknown key"),
        ("'data.identification={zigzag: 5}'", "leaves a split empty"),
        ("programme.vessel=wam_v_cal", "programme"),
    ],
    "ship": [
        ("~programme.vessel", "nothing flies"),
        ("programme.manoeuvres=[]", "nothing is flown"),
        (f"'{M}zigzag, drive: 0.5, heading: 10 deg}}]'", "give either steer"),
        (
            f"'{M}zigzag, drive: 0.5, rudder: 10 deg, heading: 10 deg}}]'",
            "the vessel has no rudder",
        ),
        (
            f"programme.vessel=mariner '{M}turning_circle, drive: 1, rudder: 60 deg}}]'",
            "the vessel's goes to 40 deg",
        ),
        ("'programme.initial={uu: 1}'", "no state 'uu'"),
        ("'programme.initial={u: 3 deg}'", "does not measure [m/s]"),
        ("programme.model.run=nowhere", "no such file or folder"),
        ("'programme.disturbance.wind={speed: 3, direction: 0}'", "has no input 'wind_speed'"),
        (f"'{M}random_steps, drive: 0.5, band: [0.2, 0.1]}}]'", "a band goes from a low"),
        (
            f"'{M}stopping, name: a, drive: 1}}, {{kind: stopping, name: a, drive: 1}}]'",
            "two manoeuvres are named 'a'",
        ),
        (f"~programme.step '{RUN}, name: rigde}}'", "did you mean 'ridge'"),
        (f"programme.step=0.2 '{RUN}, name: ridge}}'", "must be that of model 'ridge' (0.1 s)"),
        (f"~programme.vessel '{RUN}, name: ridge}}'", "a model flies with actuators"),
        (f"'{RUN}, name: ridge, actuators: mariner}}'", "the model is driven by 'n_port'"),
        (f"'{RUN}, actuators: wam_v_cal, inputs: {{n_port: {{drive: 1}}}}}}'", "not both"),
        (f"'{RUN}, inputs: {{n_port: {{drive: 3 m}}, n_stbd: {{drive: 1}}}}}}'", "inputs.n_port"),
    ],
    "sweep": [
        ("'space.heads.ridge.degre={choices: [1]}'", "space"),
        ("'space={heads.ridge.degre: {choices: [1, 2]}}'", "did you mean 'degree'"),
        ("'space={heads.ridge.degree: {low: 3, high: 1}}'", "low (3) must be less than high (1)"),
        ("'space={heads.ridge.degree: {low: 3}}'", "give choices, or low and high"),
        ("'space={heads.ridge.penalty: {low: 0.1, high: 1.0}}'", "number of points"),
        ("'space={heads.ridge.penalty: {low: 0.0, high: 1.0, log: true}}'", "above zero"),
        ("'space={heads.ridge.degree: {choices: [1, 1]}}'", "each only once"),
        ("objective.model=rigde", "did you mean 'ridge'"),
        ("'objective={kind: figure, name: nrmse}'", "must not choose anything"),
        ("'search={kind: tpe}'", "trials"),
        ("objective.model=selected pruning={}", "name the network whose training is watched"),
    ],
    "study": [
        ("reference=recpie", "did you mean 'recipe'"),
        ("model=rigde", "no model is named 'rigde'"),
        ("'seeds=[1, 1]'", "each only once"),
        ("'variants.short=[heads.ridge.degre=1]'", "degre"),
        ("base=nowhere.yaml", "nowhere.yaml"),
    ],
    "actuators": [
        ("'throttle.n.unit=N m'", "does not measure [1/s]"),
        ("throttle.n.column=rmp", "no column 'rmp'; did you mean 'rpm'"),
        ("throttle.files=[throtle.csv]", "no such file"),
        ("~throttle", "no test is named"),
    ],
    "autopilot": [
        ("conditions=null", "give 'conditions' to train it under"),
        ("'policies.policy={start: pd}'", "must name a peer of kind ptos"),
        ("policies={}", "give at least one policy"),
        ("policies.policy.units=0", "without a law needs a network"),
        ("'conditions.stated.dt=0.1 s'", "dt must be that of test"),
        ("'conditions.stated.duration=1 s'", "takes this vessel 2.14 s"),
        ("'rudder=1.5 deg'", "leave nothing of a rudder of 1.5 deg"),
        ("vessel=wam_v_cal 'rudder=0.5 deg'", "cmd_delta"),
        ("conditions.stated.current=0.5", "no input 'current_north'"),
        ("'conditions.stated.delay=[0.4 s, 0.1 s]'", "in order"),
        ("floor=pd", "must name a peer of kind bang_bang"),
        ("peers.policy.kind=pd", "'policy' names two controllers"),
    ],
    "course": [
        ("policy=polcy", "policy: 'polcy' is none of"),
        ("peers=[pid]", "peers: 'pid' is none of"),
        ("'others={pd: {kind: document, horizon: 2 s}}'", "'pd' is a policy or peer already"),
        ("'spread.effect=[1.1, 0.9]'", "effect: low and high must be positive and in order"),
        (
            "'line_of_sight=[{kind: enclosure, radius: 9}, {kind: enclosure, radius: 8}]'",
            "each kind once",
        ),
    ],
    "import": [
        ("'logs=[raw_*]'", "'raw_*' matches nothing"),
        ("'logs=[/log_*]'", "set `root` instead"),
        ("logs=[]", "logs"),
        ("reader.channels.u.column=speed", "no column 'speed'"),
    ],
}


@pytest.mark.parametrize(
    ("base", "words", "said"), [(base, *case) for base, cases in CASES.items() for case in cases]
)
def test_one_line_before_any_work(
    base: str,
    words: str,
    said: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if base == "sweep":
        pytest.importorskip("optuna")
    if "runs/tiny" in words:
        (tmp_path / "runs").mkdir()
        (tmp_path / "runs" / "tiny").symlink_to(request.getfixturevalue("tiny_run"))
    Path("made.yaml").write_text(yaml.safe_dump(BASES[base](tmp_path), sort_keys=False))
    given = [part for word in shlex.split(words) for part in ("-s", word)]
    lines = []
    capsys.readouterr()
    for command in (("check",), ("run", "--out", "out")):
        told = ("made.yaml", "--quiet", *command[1:], *given)
        assert call(monkeypatch, command[0], *told) in (1, 2)
        lines.append(capsys.readouterr().err)
    assert said in lines[0]
    assert lines[0].count("\n") == 1
    assert lines[0] == lines[1]
    assert not Path("out").exists(), "nothing is begun"


@pytest.mark.parametrize("base", ["fit", "recipe", "ferry", "ship", "study", "course", *TINY_TASKS])
def test_what_is_right_passes(
    base: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    content = copy.deepcopy((BASES | TINY_TASKS)[base](tmp_path))
    Path("made.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    assert call(monkeypatch, "check", "made.yaml") == 0
    told = f"the config is valid (task {content['task']}, run {content['name']})"
    assert told in capsys.readouterr().out


@pytest.mark.parametrize(
    ("spoilt", "code", "said"),
    [
        (lambda t: t.assign(t=t["t"].where(t.index != 50, t["t"].iloc[40])), 1, "log_0"),
        (lambda t: t.assign(t=t["t"].where(t.index != 50, t["t"].iloc[49])), 1, "log_0"),
        (lambda t: t.assign(r=float("nan")), 1, "'r'"),
        (lambda t: t.drop(columns="v"), 2, "no column 'v'"),
        (lambda t: t.iloc[:5], 1, "log_0"),
        (b"", 1, "log_0.csv"),
        (b"\x00\xff" * 50, 2, "log_0.csv"),
        (b"t,x\n1,2\n", 2, "log_0.csv"),
    ],
)
def test_logs_that_cannot_be_used(
    spoilt: Any,
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import pandas as pd

    monkeypatch.chdir(tmp_path)
    Path("made.yaml").write_text(yaml.safe_dump(measured(tmp_path)))
    file = tmp_path / "logs" / "log_0.csv"
    if isinstance(spoilt, bytes):
        file.write_bytes(spoilt)
    else:
        spoilt(pd.read_csv(file)).to_csv(file, index=False)
    assert call(monkeypatch, "run", "made.yaml", "--out", "run") == code
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_a_log_for_judging_is_as_long_as_a_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "made.yaml"
    file.write_text(yaml.safe_dump(measured(tmp_path)))
    for name in ("log_4", "log_5"):
        short = tmp_path / "logs" / f"{name}.csv"
        whole = short.read_text()
        short.write_text("\n".join(whole.splitlines()[:40]) + "\n")
        assert call(monkeypatch, "check", file) == 1
        line = capsys.readouterr().err
        assert name in line
        assert "no window of a protocol" in line
        short.write_text(whole)
