"""What a user gets wrong is one line before any work, of `check` and of `run` alike."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from tiny import SWEEP, TINY, VARIANTS, Command, write_yaml
from tiny_tasks import COURSE, TINY_TASKS, actuators, autopilot, flown, imported, measured

FERRY = {
    **TINY,
    "data": {**TINY["data"], "vessel": "milliampere_half"},
    "signals": {"inputs": ["tau_x", "tau_y", "tau_n"]},
    "baseline": {"kind": "believed", "vessel": "milliampere"},
    "heads": {"ridge": {"kind": "ridge", "space": "force"}},
    **{"ensembles": {}, "training": {}, "export": {"models": []}},
}


def steered(folder: Path) -> dict[str, Any]:
    content = autopilot(folder)
    content["peers"]["ptos"] = {"kind": "ptos", "lag": "0.3 s"}
    return content


def course(folder: Path) -> dict[str, Any]:
    write_yaml(folder / "autopilot.yaml", autopilot(folder))
    return COURSE


def by_recipe(folder: Path) -> dict[str, Any]:
    """Logs of 30 s without an input; the recipe's trainings follow from their length."""
    parts = ("baseline", "heads", "training", "prepare", "signals")
    content = {key: value for key, value in measured(folder).items() if key not in parts}
    prepare = {**measured(folder)["prepare"], "grid": {"step": 0.1}}
    return content | {"recipe": "standard", "prepare": prepare, "signals": {"inputs": []}}


def of_tiny(content: dict[str, Any]) -> Callable[[Path], dict[str, Any]]:
    def made(folder: Path) -> dict[str, Any]:
        write_yaml(folder / "tiny.yaml", TINY)
        return content

    return made


pytestmark = pytest.mark.usefixtures("example_tasks")


BASES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "fit": lambda _: TINY,
    "csv": measured,
    "recipe": by_recipe,
    "ferry": lambda _: FERRY,
    "ship": flown,
    "sweep": of_tiny(SWEEP),
    "variants": of_tiny(VARIANTS),
    "actuators": actuators,
    "autopilot": steered,
    "course": course,
    "import": imported,
}
M = "programme.manoeuvres=[{kind: "
STOP = "stopping, name: a, drive: 1"
ROUND = "{kind: enclosure, radius: 9}"
RUN = "programme.model={run: runs/tiny"
CASES: dict[str, list[tuple[str, str]]] = {
    "fit": [
        ("evaluation.selection=manuvre", "did you mean 'manoeuvre'"),
        ("'heads.ridge.features=[u, w]'", "'w' is not a channel"),
        ("training.mlp.steps=3", "no head is named 'mlp'"),
        ("export.models=[lstmm]", "did you mean 'lstm'"),
        ("heads.ridge.folds=40", "head ridge: 40 folds need at least 40 manoeuvres"),
        ("'baseline={kind: linear_steady, speed: [spiral]}'", "linear_steady"),
        ("prepare.grid.step=0.2", "must equal data.step (0.1 s)"),
        ("current.baseline=bseline", "did you mean 'baseline'"),
        (
            "current.baseline=held baselines.held.kind=still",
            "no regressors to estimate a current with",
        ),
    ],
    "csv": [
        ("training.mlp.one_step.window=99.0", "no training log holds a window of 990 samples"),
    ],
    "ferry": [
        ("'baseline={kind: regressors, terms: [u, tau_x]}'", "space: force needs a baseline"),
        ("'heads.mlp={kind: mlp, features: [u_dot]}'", "only heads in force space support"),
    ],
    "ship": [
        ("~programme.vessel", "no vessel"),
        (f"'{M}zigzag, drive: 0.5, heading: 10 deg}}]'", "give either steer"),
        (f"'{M}zigzag, drive: 0.5, rudder: 10 deg, heading: 10 deg}}]'", "has no rudder"),
        (f"programme.vessel=mariner '{M}turning_circle, drive: 1, rudder: 60 deg}}]'", "is 40 deg"),
        ("'programme.initial={uu: 1}'", "no state 'uu'"),
        ("'programme.initial={u: 3 deg}'", "does not measure [m/s]"),
        ("'programme.disturbance.wind={speed: 3, direction: 0}'", "has no input 'wind_speed'"),
        (
            f"'{M}random_steps, drive: 0.5, band: [0.2, 0.1]}}]'",
            "a band needs a lower and a higher",
        ),
        (f"'{M}{STOP}}}, {{kind: {STOP}}}]'", "two manoeuvres are named 'a'"),
        (f"~programme.step '{RUN}, name: rigde}}'", "did you mean 'ridge'"),
        (f"programme.step=0.2 '{RUN}, name: ridge}}'", "must be that of model 'ridge' (0.1 s)"),
        (f"~programme.vessel '{RUN}, name: ridge}}'", "a model needs actuators to manoeuvre"),
        (f"'{RUN}, name: ridge, actuators: mariner}}'", "the model needs the input 'n_port'"),
        (f"'{RUN}, actuators: wam_v_cal, inputs: {{n_port: {{drive: 1}}}}}}'", "not both"),
        (f"'{RUN}, inputs: {{n_port: {{drive: 3 m}}, n_stbd: {{drive: 1}}}}}}'", "inputs.n_port"),
    ],
    "sweep": [
        ("'space={heads.ridge.degree: {low: 3, high: 1}}'", "low (3) must be less than high (1)"),
        ("'space={heads.ridge.degree: {low: 3}}'", "give choices, or low and high"),
        ("'space={heads.ridge.penalty: {low: 0.1, high: 1.0}}'", "number of points"),
        ("'space={heads.ridge.penalty: {low: 0.0, high: 1.0, log: true}}'", "above zero"),
        ("'space={heads.ridge.degree: {choices: [1, 1]}}'", "each only once"),
        ("objective.model=rigde", "did you mean 'ridge'"),
        ("'objective={kind: figure, name: nrmse}'", "must not be used for selection"),
        ("objective.model=selected pruning={}", "name the network whose training is monitored"),
    ],
    "variants": [
        ("search.reference=recpie", "did you mean 'recipe'"),
        ("search.model=rigde", "no model is named 'rigde'"),
        ("'search.seeds=[1, 1]'", "each only once"),
        ("'search.variants.short=[heads.ridge.degre=1]'", "degre"),
        ("'space.seed={choices: [1, 2]}'", "remove space and pruning"),
    ],
    "actuators": [
        ("~throttle", "no test is named"),
        ("throttle.n.column=rmp", "no column 'rmp'; did you mean 'rpm'"),
    ],
    "autopilot": [
        ("conditions=null", "give 'conditions' for its training"),
        ("policies={}", "give at least one policy"),
        ("policies.policy.units=0", "without a law needs a network"),
        ("'conditions.stated.dt=0.1 s'", "dt must be that of test"),
        ("'conditions.stated.duration=1 s'", "takes this vessel at least 2.14 s"),
        ("'rudder=1.5 deg'", "need all of the rudder of 1.5 deg"),
        ("vessel=wam_v_cal 'rudder=0.5 deg'", "cmd_delta"),
        ("conditions.stated.current=0.5", "no input 'current_north'"),
        ("floor=pd", "must name a peer of kind bang_bang"),
        ("peers.policy.kind=pd", "'policy' names two controllers"),
    ],
    "course": [
        ("policy=polcy", "policy: 'polcy' is none of"),
        ("peers=[pid]", "peers: 'pid' is none of"),
        ("'others={pd: {kind: document, horizon: 2 s}}'", "'pd' is a policy or peer already"),
        ("'spread.effect=[1.1, 0.9]'", "effect: low and high must be positive and in order"),
        (f"'line_of_sight=[{ROUND}, {ROUND}]'", "each kind may occur once"),
    ],
    "import": [
        ("'logs=[/log_*]'", "set `root` instead"),
        ("'logs=[raw_*]'", "'raw_*' matches nothing"),
        ("root=nowhere", "there is no folder"),
    ],
}


@pytest.mark.parametrize(
    ("base", "words", "said"), [(base, *case) for base, cases in CASES.items() for case in cases]
)
def test_a_wrong_config_is_one_line_before_any_work(
    base: str,
    words: str,
    said: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: Command,
) -> None:
    monkeypatch.chdir(tmp_path)
    if base == "sweep":
        pytest.importorskip("optuna")
    if "runs/tiny" in words:
        (tmp_path / "runs").mkdir()
        (tmp_path / "runs" / "tiny").symlink_to(request.getfixturevalue("tiny_run"))
    write_yaml(Path("made.yaml"), BASES[base](tmp_path))
    given = [part for word in shlex.split(words) for part in ("-s", word)]
    found = command("check", "made.yaml", "--quiet", *given)
    assert found.code in (1, 2)
    assert said in found.err
    assert found.err.count("\n") == 1
    if (words, said) == CASES[base][0]:
        assert command("run", "made.yaml", "--quiet", "--out", "out", *given) == found
        assert not Path("out").exists(), "nothing is begun"


@pytest.mark.parametrize("base", ["fit", "recipe", "ferry", "variants", "course", *TINY_TASKS])
def test_what_is_right_passes(
    base: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    content = (BASES | TINY_TASKS)[base](tmp_path)
    said = command("check", write_yaml(Path("made.yaml"), content))
    assert said.code == 0
    assert f"the config is valid (task {content['task']}, run {content['name']})" in said.out


SPOILT: list[tuple[Callable[[pd.DataFrame], pd.DataFrame] | bytes, int, str]] = [
    (lambda t: t.assign(t=t["t"].where(t.index != 50, t["t"].iloc[40])), 1, "log_0"),
    (lambda t: t.assign(t=t["t"].where(t.index != 50, t["t"].iloc[49])), 1, "log_0"),
    (lambda t: t.assign(r=float("nan")), 1, "'r'"),
    (lambda t: t.drop(columns="v"), 2, "no column 'v'"),
    (lambda t: t.iloc[:5], 1, "log_0"),
    (b"", 1, "log_0.csv"),
]


@pytest.mark.parametrize(("spoilt", "code", "said"), SPOILT)
def test_logs_that_cannot_be_used(
    spoilt: Any, code: int, said: str, tmp_path: Path, command: Command
) -> None:
    config = write_yaml(tmp_path / "made.yaml", measured(tmp_path))
    file = tmp_path / "logs" / "log_0.csv"
    if isinstance(spoilt, bytes):
        file.write_bytes(spoilt)
    else:
        spoilt(pd.read_csv(file)).to_csv(file, index=False)
    ended = command("run", config, "--out", tmp_path / "run")
    assert ended.code == code
    assert said in ended.err.splitlines()[-1]


@pytest.mark.parametrize("name", ["log_4", "log_5"])
def test_a_log_for_judging_is_as_long_as_a_window(
    name: str, tmp_path: Path, command: Command
) -> None:
    file = write_yaml(tmp_path / "made.yaml", measured(tmp_path))
    short = tmp_path / "logs" / f"{name}.csv"
    short.write_text("\n".join(short.read_text().splitlines()[:40]) + "\n")
    said = command("check", file)
    assert said.code == 1
    assert name in said.err
    assert "too short for a window of any protocol" in said.err
