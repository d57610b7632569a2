"""Configs: what stops a run, and that the one line says where (file or override), what and the
nearest valid name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from made_configs import Failure, Fit, Head, Lstm, Mlp, Simulate, Task

from residnet.core.config import load_config, validate
from residnet.core.errors import ConfigError

# in files


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        # unknown keys, at every depth
        ("epoch: 3\n", "run.yaml:2: epoch: unknown key; did you mean 'epochs'? (task 'fit')"),
        (
            "heads:\n  a:\n    kind: lstm\n    hiden_size: 3\n    hidden_size: 3\n",
            (
                "run.yaml:5: heads.a.hiden_size: unknown key; did you mean 'hidden_size'? (kind"
                " 'lstm')"
            ),
        ),
        (
            "heads:\n  lstm: {kind: mlp, hiden: [3]}\n",
            "run.yaml:3: heads.lstm.hiden: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        (
            "stages:\n- kind: mlp\n- kind: mlp\n  drop_out: 0.1\n",
            "run.yaml:5: stages.1.drop_out: unknown key; did you mean 'dropout'? (kind 'mlp')",
        ),
        (
            "policy: {kind: mlp, zzz: 1}\n",
            "run.yaml:2: policy.zzz: unknown key; valid: dropout, hidden, kind (kind 'mlp')",
        ),
        (
            "sensors:\n- {name: a}\n- {nam: b}\n",
            "run.yaml:4: sensors.1.nam: unknown key; did you mean 'name'? (and 1 more)",
        ),
        # unknown kinds and names
        (
            "heads:\n  a: {kind: mpl}\n",
            "run.yaml:3: heads.a.kind: unknown value 'mpl'; did you mean 'mlp'?",
        ),
        (
            "stages:\n- kind: gru\n",
            "run.yaml:3: stages.0.kind: unknown value 'gru'; valid: lstm, mlp",
        ),
        ("policy: {hidden: [3]}\n", "run.yaml:2: policy.kind: missing; valid: lstm, mlp"),
        ("stages:\n- {}\n", "run.yaml:3: stages.0.kind: missing; valid: lstm, mlp"),
        ("method: rk5\n", "run.yaml:2: method: unknown value 'rk5'; did you mean 'rk4'?"),
        ("method: 4\n", "run.yaml:2: method: expected 'euler' or 'rk4' (given 4)"),
        ("space: forces\n", "run.yaml:2: space: unknown value 'forces'; did you mean 'force'?"),
        # types
        ("epochs: many\n", "run.yaml:2: epochs: expected a whole number (given 'many')"),
        ("epochs: '3'\n", "run.yaml:2: epochs: expected a whole number (given '3')"),
        ("epochs: 3.0\n", "run.yaml:2: epochs: expected a whole number (given 3.0)"),
        ("epochs: true\n", "run.yaml:2: epochs: expected a whole number (given true)"),
        ("name: 3\n", "run.yaml:2: name: expected text (given 3)"),
        ("resume: yes\n", "run.yaml:2: resume: expected true or false (given 'yes')"),
        ("heads: [a]\n", "run.yaml:2: heads: expected a mapping (given ['a'])"),
        ("heads:\n  a: 3\n", "run.yaml:3: heads.a: expected a mapping (given 3)"),
        ("heads:\n", "run.yaml:2: heads: expected a mapping (given null)"),
        ("stages: {}\n", "run.yaml:2: stages: expected a list (given {})"),
        (
            "policy: {kind: mlp, hidden: [3, x]}\n",
            "run.yaml:2: policy.hidden.1: expected a whole number (given 'x')",
        ),
        (
            "policy: {kind: mlp, dropout: 1.5}\n",
            "run.yaml:2: policy.dropout: must be less than 1 (given 1.5)",
        ),
        (
            "policy: {kind: mlp, dropout: .inf}\n",
            "run.yaml:2: policy.dropout: must be a finite number (given inf)",
        ),
        ("by_index: {a: 1.0}\n", "run.yaml:2: by_index.a: expected a whole number (given 'a')"),
        (
            "sensors:\n- name: a\n  limits: [1]\n",
            "run.yaml:4: sensors.0.limits: item 1 is missing (given [1])",
        ),
        # plain unions name what any member takes, or go with the member that got furthest
        ("threshold: x\n", "run.yaml:2: threshold: expected a number or a list (given 'x')"),
        ("threshold:\n- 1\n- x\n", "run.yaml:4: threshold.1: expected a number (given 'x')"),
        (
            "fallback: {kind: mlp, hiden: [1]}\n",
            "run.yaml:2: fallback.hiden: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        ("fallback: x\n", "run.yaml:2: fallback: expected a mapping or a number (given 'x')"),
        (
            "pair: [1 s, {a: [{kind: mlp, hiden: [1]}]}]\n",
            "run.yaml:2: pair.1.a.0.hiden: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        (
            "pair: [1 m, {}]\n",
            (
                "run.yaml:2: pair.0: unit 'm' does not measure [s]; units that do: s, ms, us, ns,"
                " min, h, day (given '1 m')"
            ),
        ),
        # missing
        (
            "heads:\n  a:\n    kind: lstm\n",
            "run.yaml:3: heads.a.hidden_size: missing (kind 'lstm')",
        ),
        ("sensors:\n- {name: a}\n- noise: 1\n", "run.yaml:4: sensors.1.name: missing"),
        # validators of our own
        ("name: a/b\n", "run.yaml:2: name: a name must not hold '/' (given 'a/b')"),
        (
            "sensors:\n- {name: a, limits: [2, 1]}\n",
            "run.yaml:3: sensors.0: limits must rise, got (2.0, 1.0)",
        ),
        # several at once
        (
            "epochs: x\nname: 1\nresume: 2\n",
            "run.yaml:3: name: expected text (given 1) (and 2 more)",
        ),
    ],
)
def test_one_line(failure: Failure, text: str, expected: str) -> None:
    assert failure(text) == expected


def test_quantity_or_word(failure: Failure) -> None:
    message = failure("window: atuo\n")
    assert message.startswith("run.yaml:2: window: ")
    assert "unknown value 'atuo'; did you mean 'auto'?" in message


def test_long_values_are_cut(failure: Failure) -> None:
    message = failure(f"epochs: {'x' * 500}\n")
    assert message.endswith("xxx...)")
    assert len(message) < 150


def test_root_may_be_a_union(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("task: simulate\nduration: 2 min\n")
    assert load_config(path, [], Task) == Simulate(task="simulate", duration=120.0)
    cases = {
        "task=simulat": (
            "override 'task=simulat': task: unknown value 'simulat'; did you mean 'simulate'?"
        ),
        "durations=3": (
            "override 'durations=3': durations: unknown key; did you mean 'duration'? (task"
            " 'simulate')"
        ),
        "task=fit": f"{path}:2: duration: unknown key; valid: by_index, ",
    }
    for override, expected in cases.items():
        with pytest.raises(ConfigError) as caught:
            load_config(path, [override], Task)
        assert str(caught.value).startswith(expected)
    path.write_text("duration: 2\n")
    with pytest.raises(ConfigError, match="task: missing; valid: fit, simulate"):
        load_config(path, [], Task)


def test_validate_names_its_source_and_takes_a_union(tmp_path: Path) -> None:
    assert validate({"kind": "mlp", "hidden": [4]}, Head, "card.json") == Mlp(hidden=(4,))
    assert validate({"hidden_size": 4, "washout": "20 s"}, Lstm, "card.json").washout == 20.0
    with pytest.raises(ConfigError, match=r"^card\.json: hidden_size: missing \(kind 'lstm'\)$"):
        validate({}, Lstm, "card.json")
    with pytest.raises(ConfigError, match=r"^card\.json: expected a mapping \(given 3\)$"):
        validate(3, Lstm, "card.json")
    with pytest.raises(ConfigError, match=r"^card\.json: holds a value that YAML cannot"):
        validate({"hidden_size": object()}, Lstm, "card.json")
    (tmp_path / "a.csv").touch()
    assert validate({"task": "fit", "logs": ["a.csv"]}, Fit, "card.json", tmp_path).logs == (
        tmp_path / "a.csv",
    )


# overrides


def test_overrides_set_values(load: Callable[..., Fit]) -> None:
    text = (
        "heads:\n  a: {kind: lstm, hidden_size: 3}\npolicy:\nstages:\n- kind: mlp\n- kind: lstm\n "
        " hidden_size: 1\n"
    )
    config = load(
        text,
        *[
            "dt=20 ms",
            "heads.a.hidden_size=64",
            "heads.b.kind=mlp",
            "heads.b.hidden=[32,16]",
            "policy.kind=mlp",
            "stages.1.hidden_size=7",
        ],
        *["epochs=2", "epochs=5", "comment=a=b", "threshold=1e-3", "limit=null"],
    )
    assert config.dt == 0.02
    assert config.heads == {"a": Lstm(hidden_size=64), "b": Mlp(hidden=(32, 16))}
    assert config.policy == Mlp()
    assert config.stages == [Mlp(), Lstm(hidden_size=7)]
    assert (config.epochs, config.comment, config.threshold, config.limit) == (5, "a=b", 1e-3, None)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["epochs=x"], "override 'epochs=x': epochs: expected a whole number (given 'x')"),
        (
            ["epoch=3"],
            "override 'epoch=3': epoch: unknown key; did you mean 'epochs'? (task 'fit')",
        ),
        (
            ["dt=3 deg"],
            (
                "override 'dt=3 deg': dt: unit 'deg' does not measure [s]; units that do: s, ms,"
                " us, ns, min, h, day (given '3 deg')"
            ),
        ),
        (
            ["heads.a.hiden_size=3"],
            (
                "override 'heads.a.hiden_size=3': heads.a.hiden_size: unknown key; did you mean"
                " 'hidden_size'? (kind 'lstm')"
            ),
        ),
        (
            ["heads.a.hidden_size=0", "epochs=2"],
            (
                "override 'heads.a.hidden_size=0': heads.a.hidden_size: must be greater than 0"
                " (given 0)"
            ),
        ),
        (
            ["heads.a={kind: lstm, hidden_size: x}"],
            (
                "override 'heads.a={kind: lstm, hidden_size: x}': heads.a.hidden_size: expected a"
                " whole number (given 'x')"
            ),
        ),
        (
            ["heads.a.kind=mpl"],
            "override 'heads.a.kind=mpl': heads.a.kind: unknown value 'mpl'; did you mean 'mlp'?",
        ),
        (
            ["heads.a.kind=mlp"],
            "run.yaml:3: heads.a.hidden_size: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        (
            ["stages.0.kind=mpl"],
            "override 'stages.0.kind=mpl': stages.0.kind: unknown value 'mpl'; did you mean 'mlp'?",
        ),
        (
            ["epochs=x", "epochs=y"],
            "override 'epochs=y': epochs: expected a whole number (given 'y')",
        ),
        # a fault of a whole section names the file and the override that changed the section
        (
            ["sensors.0.limits.0=9"],
            (
                "run.yaml:7 with override 'sensors.0.limits.0=9': sensors.0: limits must rise, got"
                " (9.0, 1.0)"
            ),
        ),
        # overrides that cannot be applied
        (
            ["epochs"],
            "override 'epochs': expected key=value, for example heads.lstm.hidden_size=64",
        ),
        (["=3"], "override '=3': expected key=value, for example heads.lstm.hidden_size=64"),
        (
            ["heads..a=3"],
            "override 'heads..a=3': expected key=value, for example heads.lstm.hidden_size=64",
        ),
        (["name.first=3"], "override 'name.first=3': name: has no key 'first' (given 'n')"),
        (
            ["stages.1.kind=mlp"],
            (
                "override 'stages.1.kind=mlp': stages: a list of 1 items has no item '1'; the first"
                " is 0"
            ),
        ),
        (
            ["stages.last.kind=mlp"],
            (
                "override 'stages.last.kind=mlp': stages: a list of 1 items has no item 'last'; the"
                " first is 0"
            ),
        ),
        (
            ["epochs=[1"],
            "override 'epochs=[1': not YAML: expected ',' or ']', but got '<stream end>'",
        ),
        (
            ["heads={a: 1, a: 2}"],
            "override 'heads={a: 1, a: 2}': duplicate key 'a', first on line 1",
        ),
    ],
)
def test_faults_are_attributed_to_overrides(
    failure: Failure, overrides: list[str], expected: str
) -> None:
    text = (
        "heads:\n  a: {kind: lstm, hidden_size: 3}\nname: n\nstages: [{kind: mlp}]\nsensors:\n-"
        " {name: s, limits: [0, 1]}\n"
    )
    assert failure(text, *overrides) == expected


def test_faults_of_the_file_are_not_attributed_to_overrides(failure: Failure) -> None:
    assert (
        failure("epochs: x\n", "dt=3") == "run.yaml:2: epochs: expected a whole number (given 'x')"
    )


def test_override_repairs_the_file(load: Callable[..., Fit]) -> None:
    assert load("epochs: x\n", "epochs=3").epochs == 3


def test_keys_that_are_gone_may_stand_where_they_did_nothing(failure: Failure) -> None:
    lstm = {"kind": "lstm", "hidden_size": 3}
    given = {"task": "fit", "heads": {"a": lstm | {"encoder": False}}, "policy": lstm}
    assert validate(given, Fit, "run").heads["a"] == Lstm(hidden_size=3)
    assert failure("heads: {a: {kind: lstm, hidden_size: 3, encoder: true}}\n").startswith(
        "run.yaml:2: heads.a.encoder: unknown key; it is gone: the memory"
    )
