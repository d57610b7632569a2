"""Configs: what stands in them, what stops a run, and the YAML that they are written in."""

from __future__ import annotations

import enum
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, TypeAdapter, ValidationError, field_validator, model_validator

from residnet.core.config import (
    RENAMED_KEYS,
    BaseConfig,
    Config,
    ConfigPath,
    ExistingPath,
    Hertz,
    Metres,
    MetresPerSecond,
    NewtonMetres,
    Newtons,
    Quantity,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
    Seconds,
    dump_config,
    load_config,
    load_mapping,
    quantity_type,
    validate_config,
)
from residnet.core.config_yaml import parse_yaml
from residnet.core.errors import ConfigError, UsageError


class Space(enum.Enum):
    FORCE = "force"
    ACCELERATION = "acceleration"


class Mlp(Config):
    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (32, 32)
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)


class Lstm(Config):
    kind: Literal["lstm"] = "lstm"
    hidden_size: int = Field(gt=0)
    washout: Seconds = 1.0


Head = Annotated[Mlp | Lstm, Field(discriminator="kind")]


class Sensor(Config):
    name: str
    noise: Radians = 0.0
    limits: tuple[float, float] = (-1.0, 1.0)

    @model_validator(mode="after")
    def _ordered(self) -> Sensor:
        if self.limits[0] >= self.limits[1]:
            raise ValueError(f"limits must rise, got {self.limits}")
        return self


class Fit(Config):
    task: Literal["fit"]
    dt: Seconds = Field(default=0.1, gt=0)
    name: str = "unnamed"
    comment: str | None = None
    space: Space = Space.FORCE
    method: Literal["euler", "rk4"] = "rk4"
    resume: bool = False
    epochs: int = 1
    limit: Radians | None = None
    rates: dict[str, tuple[Hertz, ...]] = Field(default_factory=dict)
    threshold: float | list[float] = 3.0
    window: Annotated[Seconds, Field(gt=0)] | Literal["auto"] = "auto"
    heads: dict[str, Head] = Field(default_factory=dict)
    stages: list[Head] = Field(default_factory=list)
    policy: Head | None = None
    fallback: Head | float = 0.0
    pair: tuple[Seconds, dict[str, list[Head]]] | None = None
    sensors: tuple[Sensor, ...] = ()
    by_index: dict[int, float] = Field(default_factory=dict)
    out: ConfigPath = Path("runs")
    logs: tuple[ExistingPath, ...] = ()

    @field_validator("name")
    @classmethod
    def _no_slash(cls, value: str) -> str:
        if "/" in value:
            raise ValueError("a name must not hold '/'")
        return value


class Simulate(Config):
    task: Literal["simulate"]
    duration: Seconds


Task = Annotated[Fit | Simulate, Field(discriminator="task")]

Failure = Callable[..., str]


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Fit]:
    """Loads a `Fit` from YAML text below `task: fit` (which is line 1)."""

    def _load(text: str = "", *overrides: str) -> Fit:
        path = tmp_path / "run.yaml"
        path.write_text("task: fit\n" + text, encoding="utf-8")
        return load_config(path, overrides, Fit)

    return _load


@pytest.fixture
def failure(load: Callable[..., Fit], tmp_path: Path) -> Failure:
    """Message of the error that a config gives, without the folder."""

    def _failure(text: str = "", *overrides: str) -> str:
        with pytest.raises(ConfigError) as caught:
            load(text, *overrides)
        message = str(caught.value)
        assert "\n" not in message
        assert caught.value.exit_code == 2
        return message.replace(f"{tmp_path}{os.sep}", "")

    return _failure


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (Seconds, 2, 2.0),
        (Seconds, "1e-3", 1e-3),
        (Seconds, "-20ms", -0.02),
        (Seconds, " 2  min ", 120.0),
        (Radians, ".5 rad", 0.5),
        (RadiansPerSecond, "1.365 deg/s", math.radians(1.365)),
        (Hertz, "5 Hz", 5.0),
        (Metres, "1 nmi", 1852.0),
        (MetresPerSecond, "10 kn", 10 * 1852 / 3600),
        (RevsPerSecond, "90 rpm", 1.5),
        (RevRate, "120 rpm/s", 2.0),
        (Newtons, "1.5 kN", 1500.0),
        (NewtonMetres, "2 kN m", 2000.0),
        (Annotated[float, Quantity("kg")], "3 t", 3000.0),
        (quantity_type("-"), "5 %", 0.05),
    ],
)
def test_quantity_converts_to_si(kind: Any, value: object, expected: float) -> None:
    result = TypeAdapter(kind).validate_python(value)
    assert type(result) is float
    assert result == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("kind", "value", "told"),
    [
        (Radians, "20 s", "unit 's' does not measure .rad.; units that do: rad, deg.*given '20 s'"),
        (Radians, "20 dge", "unknown unit 'dge'; did you mean 'deg'?"),
        (Seconds, "soon", r"expected a number in s or text such as '1.5 ms' .given 'soon'"),
        (Seconds, True, "expected a number.*given true"),
        (Seconds, None, "expected a number.*given null"),
        (Seconds, [1.0], "expected a number"),
        (Seconds, math.nan, "must be a finite number"),
        (Seconds, "1e999 s", "must be a finite number"),
        (Seconds, 10**400, "must be a finite number"),
        (Annotated[Seconds, Field(gt=0)], "-1 s", "greater than 0"),
    ],
)
def test_quantity_refuses_invalid_values(kind: Any, value: object, told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        TypeAdapter(kind).validate_python(value)


def test_quantity_takes_si_units_only() -> None:
    with pytest.raises(UsageError, match="unit 'deg' is not SI; the SI unit is 'rad'"):
        quantity_type("deg")


class Wrong(Config):
    dt: Seconds = Field(default=-1.0, gt=0)


def test_config_is_immutable_closed_and_validates_defaults() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Lstm(hidden_size=3).hidden_size = 4
    with pytest.raises(ValidationError, match="Extra inputs"):
        Lstm(hidden_size=3, hiden=4)  # type: ignore[call-arg]
    with pytest.raises(ValidationError, match="greater than 0"):
        Wrong()


def test_config_path_is_searched_in_the_config_folder_first(
    load: Callable[..., Fit], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    (tmp_path / "both.csv").touch()
    (here / "both.csv").touch()
    (here / "mine.csv").touch()
    config = load("logs: [both.csv, mine.csv]\nout: new/run\n")
    assert config.logs == (tmp_path / "both.csv", here / "mine.csv")
    assert config.out == here / "new/run"
    assert load().out == here / "runs"
    monkeypatch.setenv("TEST_LOGS", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load("out: ${TEST_LOGS}/a\n").out == tmp_path / "a"
    assert load("out: ~/b\n").out == tmp_path / "b"


def test_dump_config_loads_to_an_equal_config(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log: 1.csv").touch()
    config = Fit(
        task="fit",
        dt=1e-5,
        name="off",
        comment="1e-3",
        space=Space.ACCELERATION,
        limit=math.radians(20),
        rates={"yes": (0.1, 1e22), "010": ()},
        threshold=[1.0, 1 / 3],
        heads={"a b": Mlp(hidden=()), "<<": Lstm(hidden_size=3), "1e3": Mlp()},
        stages=[Lstm(hidden_size=1), Mlp()],
        sensors=tuple(Sensor(name=name) for name in ("multi\nline # ü", "12:30", "~", "")),
        by_index={3: 1.5, -1: 2.0},
        out=Path("runs/a"),
        logs=(Path("log: 1.csv"),),
    )
    text = dump_config(config)
    other = tmp_path / "elsewhere" / "resolved.yaml"
    other.parent.mkdir()
    other.write_text(text, encoding="utf-8")
    monkeypatch.chdir("/")
    again = load_config(other, [], Fit)
    assert again == config
    assert dump_config(again) == text
    assert load_config(other, [], Task) == config
    keys = [line.split(":")[0] for line in text.splitlines() if line[:1].isalpha()]
    assert [key for key in keys if key in Fit.model_fields] == list(Fit.model_fields)
    assert f"out: {tmp_path}/runs/a\n" in text


def test_override_removes_a_key(load: Callable[..., Fit]) -> None:
    text = "rates: {a: [1], b: [2]}\nepochs: 5\n"
    assert load(text, "~rates.a").rates == {"b": (2.0,)}
    assert load(text, "~epochs").epochs == 1
    assert load(text, "~rates.a", "rates.a=[7]").rates == {"a": (7.0,), "b": (2.0,)}


class Swept(Config):
    """A config with a base.

    Attributes:
        base: file, or the name of a shipped config.
    """

    base: BaseConfig


def test_base_config_accepts_a_file_or_a_shipped_config(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("task: fit\n")
    assert Swept.model_validate({"base": str(own)}).base == own
    assert Swept.model_validate({"base": "quickstart"}).base.name == "quickstart.yaml"
    with pytest.raises(ValidationError, match=r"no config named 'quickstrat'.*quickstart"):
        Swept.model_validate({"base": "quickstrat"})
    with pytest.raises(ValidationError, match="no such file or folder"):
        Swept.model_validate({"base": "absent.yaml"})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        # unknown keys, at every depth
        ("epoch: 3", "2: epoch: unknown key; did you mean 'epochs'? (task 'fit')"),
        (
            "heads:\n  a:\n    kind: lstm\n    hiden_size: 3\n    hidden_size: 3",
            "5: heads.a.hiden_size: unknown key; did you mean 'hidden_size'? (kind 'lstm')",
        ),
        (
            "stages:\n- kind: mlp\n- kind: mlp\n  drop_out: 0.1",
            "5: stages.1.drop_out: unknown key; did you mean 'dropout'? (kind 'mlp')",
        ),
        (
            "policy: {kind: mlp, zzz: 1}",
            "2: policy.zzz: unknown key; valid: dropout, hidden, kind (kind 'mlp')",
        ),
        (
            "sensors:\n- {name: a}\n- {nam: b}",
            "4: sensors.1.nam: unknown key; did you mean 'name'? (and 1 more)",
        ),
        # unknown kinds and names
        ("heads:\n  a: {kind: mpl}", "3: heads.a.kind: unknown value 'mpl'; did you mean 'mlp'?"),
        ("stages:\n- kind: gru", "3: stages.0.kind: unknown value 'gru'; valid: lstm, mlp"),
        ("policy: {hidden: [3]}", "2: policy.kind: missing; valid: lstm, mlp"),
        ("method: rk5", "2: method: unknown value 'rk5'; did you mean 'rk4'?"),
        ("method: 4", "2: method: expected 'euler' or 'rk4' (given 4)"),
        ("space: forces", "2: space: unknown value 'forces'; did you mean 'force'?"),
        # types
        ("epochs: 3.0", "2: epochs: expected a whole number (given 3.0)"),
        ("epochs: true", "2: epochs: expected a whole number (given true)"),
        ("name: 3", "2: name: expected text (given 3)"),
        ("resume: yes", "2: resume: expected true or false (given 'yes')"),
        ("heads: [a]", "2: heads: expected a mapping (given ['a'])"),
        ("heads:", "2: heads: expected a mapping (given null)"),
        ("stages: {}", "2: stages: expected a list (given {})"),
        (
            "policy: {kind: mlp, dropout: .inf}",
            "2: policy.dropout: must be a finite number (given inf)",
        ),
        ("by_index: {a: 1.0}", "2: by_index.a: expected a whole number (given 'a')"),
        (
            "sensors:\n- name: a\n  limits: [1]",
            "4: sensors.0.limits: item 1 is missing (given [1])",
        ),
        # quantities
        ("dt: -50 ms", "2: dt: must be greater than 0 s (given -0.05)"),
        (
            "rates:\n  gnss: [1 Hz, 2 kn]",
            (
                "3: rates.gnss.1: unit 'kn' does not measure [1/s]; units that do: Hz, 1/s, 1/min,"
                " rps, rpm (given '2 kn')"
            ),
        ),
        # paths
        (
            "logs:\n- /nowhere/nope.csv",
            "3: logs.0: no such file or folder: /nowhere/nope.csv (given '/nowhere/nope.csv')",
        ),
        ("out: 3", "2: out: expected a path (given 3)"),
        ("out: ''", "2: out: expected a path (given '')"),
        (
            "out: ~no-such-user/a",
            "2: out: the home folder for '~' is unknown (given '~no-such-user/a')",
        ),
        # plain unions name what any member takes, or go with the member that got furthest
        ("threshold: x", "2: threshold: expected a number or a list (given 'x')"),
        ("threshold:\n- 1\n- x", "4: threshold.1: expected a number (given 'x')"),
        (
            "fallback: {kind: mlp, hiden: [1]}",
            "2: fallback.hiden: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        ("fallback: x", "2: fallback: expected a mapping or a number (given 'x')"),
        (
            "pair: [1 s, {a: [{kind: mlp, hiden: [1]}]}]",
            "2: pair.1.a.0.hiden: unknown key; did you mean 'hidden'? (kind 'mlp')",
        ),
        # missing
        ("heads:\n  a:\n    kind: lstm", "3: heads.a.hidden_size: missing (kind 'lstm')"),
        ("sensors:\n- {name: a}\n- noise: 1", "4: sensors.1.name: missing"),
        # validators of our own
        ("name: a/b", "2: name: a name must not hold '/' (given 'a/b')"),
        (
            "sensors:\n- {name: a, limits: [2, 1]}",
            "3: sensors.0: limits must rise, got (2.0, 1.0)",
        ),
        # several at once
        ("epochs: x\nname: 1\nresume: 2", "3: name: expected text (given 1) (and 2 more)"),
    ],
)
def test_load_config_reports_faults_in_one_line(failure: Failure, text: str, expected: str) -> None:
    assert failure(text + "\n") == f"run.yaml:{expected}"


def test_load_config_truncates_long_values(failure: Failure) -> None:
    message = failure(f"epochs: {'x' * 500}\n")
    assert message.endswith("xxx...)")
    assert len(message) < 150
    told = "run.yaml:2: logs.0: no such file or folder: "
    assert failure(f"logs: [{'x' * 400}]\n").startswith(told)


def test_load_config_with_quantity_unions_and_unset_variables(
    failure: Failure, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "unknown value 'atuo'; did you mean 'auto'?" in failure("window: atuo\n")
    monkeypatch.delenv("TEST_LOGS", raising=False)
    unset = "out: environment variable 'TEST_LOGS' is not set; set it (export TEST_LOGS=...) or"
    assert failure("out: ${TEST_LOGS}/a\n").startswith(f"run.yaml:2: {unset}")
    monkeypatch.setenv("TEST_LOGS", "")
    assert failure("", "out=${TEST_LOGS}/a").startswith(f"override 'out=${{TEST_LOGS}}/a': {unset}")


@pytest.mark.parametrize("number", ["1234567890123456789012", "1e200", "-1e31", "1e-200"])
def test_load_config_refuses_implausible_numbers(failure: Failure, number: str) -> None:
    assert failure(f"dt: {number}\n").startswith("run.yaml:2: dt: expected a number of usual size")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("task=simulat", "override 'task=simulat': task: unknown value 'simulat'; did you mean"),
        ("durations=3", "override 'durations=3': durations: unknown key; did you mean 'duration'?"),
        ("task=fit", "run.yaml:2: duration: unknown key; valid: by_index, "),
        ("~task", "override '~task': task: missing; valid: fit, simulate"),
    ],
)
def test_load_config_accepts_a_union(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, override: str, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.yaml").write_text("task: simulate\nduration: 2 min\n")
    found = load_config(Path("run.yaml"), [], Task)
    assert found == Simulate(task="simulate", duration=120.0)
    with pytest.raises(ConfigError) as caught:
        load_config(Path("run.yaml"), [override], Task)
    assert str(caught.value).startswith(expected)


def test_validate_config_names_its_source(tmp_path: Path) -> None:
    assert validate_config({"kind": "mlp", "hidden": [4]}, Head, "card.json") == Mlp(hidden=(4,))
    assert validate_config({"hidden_size": 4, "washout": "20 s"}, Lstm, "card.json").washout == 20.0
    for given, told in (
        ({}, r"hidden_size: missing \(kind 'lstm'\)$"),
        (3, r"expected a mapping \(given 3\)$"),
        ({"hidden_size": object()}, "holds a value that YAML cannot"),
    ):
        with pytest.raises(ConfigError, match=rf"^card\.json: {told}"):
            validate_config(given, Lstm, "card.json")
    (tmp_path / "a.csv").touch()
    found = validate_config({"task": "fit", "logs": ["a.csv"]}, Fit, "card.json", tmp_path)
    assert found.logs == (tmp_path / "a.csv",)


def test_load_config_applies_overrides(load: Callable[..., Fit]) -> None:
    text = (
        "heads:\n  a: {kind: lstm, hidden_size: 3}\npolicy:\nepochs: x\nstages:\n- kind: mlp\n"
        "- kind: lstm\n  hidden_size: 1\n"
    )
    config = load(
        text,
        *("dt=20 ms", "heads.a.hidden_size=64", "heads.b.kind=mlp", "heads.b.hidden=[32,16]"),
        *("policy.kind=mlp", "stages.1.hidden_size=7", "epochs=2", "epochs=5", "comment=a=b"),
        *("threshold=1e-3", "limit=null"),
    )
    assert config.dt == 0.02
    assert config.heads == {"a": Lstm(hidden_size=64), "b": Mlp(hidden=(32, 16))}
    assert config.policy == Mlp()
    assert config.stages == [Mlp(), Lstm(hidden_size=7)]
    assert (config.epochs, config.comment, config.threshold, config.limit) == (5, "a=b", 1e-3, None)


OVERRIDDEN = (
    "heads:\n  a: {kind: lstm, hidden_size: 3}\nname: n\nstages: [{kind: mlp}]\nsensors:\n-"
    " {name: s, limits: [0, 1]}\n"
)


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("epochs=x", "epochs: expected a whole number (given 'x')"),
        ("epoch=3", "epoch: unknown key; did you mean 'epochs'? (task 'fit')"),
        (
            "heads.a.hiden_size=3",
            "heads.a.hiden_size: unknown key; did you mean 'hidden_size'? (kind 'lstm')",
        ),
        (
            "heads.a={kind: lstm, hidden_size: x}",
            "heads.a.hidden_size: expected a whole number (given 'x')",
        ),
        ("heads.a.kind=mpl", "heads.a.kind: unknown value 'mpl'; did you mean 'mlp'?"),
        # overrides that cannot be applied
        ("epochs", "expected key=value, for example heads.lstm.hidden_size=64"),
        ("heads..a=3", "expected key=value, for example heads.lstm.hidden_size=64"),
        ("name.first=3", "name: has no key 'first' (given 'n')"),
        ("stages.1.kind=mlp", "stages: a list of 1 items has no item '1'; the first is 0"),
        ("stages.last.kind=mlp", "stages: a list of 1 items has no item 'last'; the first is 0"),
        ("epochs=[1", "not YAML: expected ',' or ']', but got '<stream end>'"),
        ("heads={a: 1, a: 2}", "duplicate key 'a', first on line 1"),
        ("~heads.aa", "there is no 'heads.aa' to remove; did you mean 'a'?"),
        ("~name.x", "there is no 'name.x' to remove"),
    ],
)
def test_load_config_attributes_faults_to_an_override(
    failure: Failure, override: str, told: str
) -> None:
    assert failure(OVERRIDDEN, override) == f"override '{override}': {told}"


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["heads.a.hidden_size=0", "epochs=2"], "override 'heads.a.hidden_size=0': heads.a.hidden"),
        (["epochs=x", "epochs=y"], "override 'epochs=y': epochs: expected a whole number (given"),
        (["heads.a.kind=mlp"], "run.yaml:3: heads.a.hidden_size: unknown key; did you mean 'hid"),
        # a fault of a whole section names the file and the override that changed the section
        (
            ["sensors.0.limits.0=9"],
            "run.yaml:7 with override 'sensors.0.limits.0=9': sensors.0: limits must rise, got (9",
        ),
    ],
)
def test_load_config_names_the_origin_of_a_value(
    failure: Failure, overrides: list[str], expected: str
) -> None:
    assert failure(OVERRIDDEN, *overrides).startswith(expected)
    assert failure("epochs: x\n", "dt=3").startswith("run.yaml:2: epochs: expected")


def test_renamed_key_error_names_the_new_key(
    failure: Failure, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RENAMED_KEYS, "heads.*.units", "hidden_size")
    assert failure("heads: {a: {kind: lstm, units: 3}}\n").startswith(
        "run.yaml:2: heads.a.units: unknown key; it was renamed to 'hidden_size'"
    )


@pytest.mark.parametrize(
    ("data", "code"),
    [
        ({"dt": "x"}, "config.invalid"),
        ({"dt": -1.0}, "config.out_of_range"),
        ({"epoch": 3}, "config.unknown_key"),
        ({"epochs": "x"}, "config.wrong_type"),
        ({"method": "rk5"}, "config.unknown_value"),
        ({"task": None}, "config.unknown_value"),
        ({"dt": 1e31}, "config.out_of_range"),
    ],
)
def test_config_error_has_a_code(data: dict[str, Any], code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate_config({"task": "fit", **data}, Fit, "run.yaml")
    assert caught.value.code == code


def test_load_mapping_follows_yaml_1_2(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    # a byte order mark is skipped
    path.write_text(
        "\ufeffa: 1e-3\nb: 1E6\nc: 010\nd: 0x10\ne: off\nf: yes\ng: 12:30\nh: 2024-01-01\ni: ~\n"
        "j:\nk: true\nl: .5\nm: '1e-3'\non: 0o17\n7: x\n"
    )
    mapping = load_mapping(path)
    values = (1e-3, 1e6, 10, 16, "off", "yes", "12:30", "2024-01-01", None, None, True, 0.5, "1e-3")
    assert mapping == {**dict(zip("abcdefghijklm", values, strict=True)), "on": 15, "7": "x"}
    assert type(mapping["b"]) is float
    assert type(mapping["c"]) is int


def test_load_config_copies_merged_and_aliased_values(load: Callable[..., Fit]) -> None:
    text = "heads:\n  a: &a {kind: lstm, hidden_size: 3}\n  b: *a\n  c: {<<: *a, hidden_size: 5}\n"
    heads = load(text, "heads.a.hidden_size=4").heads
    assert [heads[name].model_dump()["hidden_size"] for name in "abc"] == [4, 3, 5]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", ": empty; expected a mapping"),
        (b"# nothing\n", ": empty; expected a mapping"),
        (b"- 1\n- 2\n", ": expected a mapping of keys to values, found a list"),
        (b"hello\n", ": expected a mapping of keys to values, found the value 'hello'"),
        (b"a: 1\nb: [1, 2\n", ":3:1: not YAML: "),
        (b"a: b: c\n", ":1:5: not YAML: mapping values are not allowed here"),
        (b"a: 1\n---\nb: 2\n", ":2:1: not YAML: "),
        (b"a: !!python/object:os.system {}\n", ":1:4: not YAML: could not determine a constructor"),
        (b"a: !!timestamp 2024-01-01\n", ":1:4: not YAML: could not determine a constructor"),
        (b"? [a]\n: 1\n", ":1:3: not YAML: a key must be plain text"),
        (b"a: *nowhere\n", ":1:4: not YAML: found undefined alias"),
        (b"a: &a [*a]\n", ": has more than 200000 values, or refers to itself"),
        (b"[" * 5000, ":1:62: not YAML: nested more than 60 levels deep"),
        (b"a: \x01\n", ": not YAML: "),
        (b"a: \xff\n", ": not UTF-8 text (byte 3)"),
        (b"a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n", ":5: duplicate key 'c', first on line 3"),
        (b"l:\n- {k: 1, k: 2}\n", ":2: duplicate key 'k', first on line 2"),
    ],
)
def test_load_config_refuses_unreadable_files(
    tmp_path: Path, content: bytes, expected: str
) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path, [], Fit)
    assert str(caught.value).startswith(f"{path}{expected}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("nope.yaml", r"nope\.yaml: no such file$"),
        (".", "is a folder; give a YAML file"),
        ("/dev/zero", "/dev/zero: is longer than 2 MB"),
    ],
)
def test_load_mapping_refuses_missing_files_folders_and_devices(
    tmp_path: Path, name: str, told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        load_mapping(tmp_path / name)


_BOMB = "\n".join(
    ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]
)
_MERGES = "\n".join(
    [
        "a0: &a0 {x: 1}",
        *(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)),
    ]
)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (_BOMB, "has more than 200000 values"),
        (_MERGES, "has more than 200000 values"),
        ("a: " + "[" * 100_000, "nested more than 60 levels"),
        ("a:\n" + "- " * 10_000, "nested more than 60 levels"),
        ("a: " + "9" * 5000, "whole number of 5000 digits"),
        ("a: 0x" + "f" * 9000, "whole number of 9002 digits"),
    ],
    ids=["aliases", "merges", "brackets", "dashes", "digits", "hex"],
)
def test_parse_yaml_limits_size_depth_and_digits(text: str, told: str) -> None:
    started = time.process_time()
    with pytest.raises(ConfigError, match=told) as caught:
        parse_yaml(text, "x.yaml")
    assert str(caught.value).startswith("x.yaml")
    assert len(str(caught.value)) < 200
    assert time.process_time() - started < 2.0
