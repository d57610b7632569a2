"""Configs: values, YAML, paths, and that what is written loads back."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
from made_configs import Failure, Fit, Lstm, Mlp, Sensor, Space, Task
from pydantic import Field, TypeAdapter, ValidationError

from residnet.core.config import (
    BaseConfig,
    Config,
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
    quantity,
)
from residnet.core.errors import ConfigError, UsageError

# values


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (Seconds, 0.5, 0.5),
        (Seconds, 2, 2.0),
        (Seconds, "0.5 s", 0.5),
        (Seconds, "1e-3", 1e-3),
        (Seconds, "-20ms", -0.02),
        (Seconds, " 2  min ", 120.0),
        (Radians, "20 deg", math.radians(20)),
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
        (quantity("-"), "5 %", 0.05),
    ],
)
def test_quantity_is_si(kind: Any, value: object, expected: float) -> None:
    result = TypeAdapter(kind).validate_python(value)
    assert type(result) is float
    assert result == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("kind", "value", "parts"),
    [
        (Radians, "20 s", ["unit 's' does not measure [rad]", "rad, deg", "given '20 s'"]),
        (Radians, "20 dge", ["unknown unit 'dge'; did you mean 'deg'?"]),
        (Seconds, "1 fortnight", ["unknown unit 'fortnight'; valid: day, h, min, ms, ns, s, us"]),
        (Seconds, "soon", ["expected a number in s or text such as '1.5 ms' (given 'soon')"]),
        (Seconds, "", ["expected a number"]),
        (Seconds, True, ["expected a number", "given true"]),
        (Seconds, None, ["expected a number", "given null"]),
        (Seconds, [1.0], ["expected a number"]),
        (Seconds, math.nan, ["must be a finite number"]),
        (Seconds, math.inf, ["must be a finite number"]),
        (Seconds, "1e999 s", ["must be a finite number"]),
        (Seconds, 10**400, ["must be a finite number"]),
        (Annotated[Seconds, Field(gt=0)], "-1 s", ["greater than 0"]),
    ],
)
def test_quantity_refuses(kind: Any, value: object, parts: list[str]) -> None:
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(kind).validate_python(value)
    for part in parts:
        assert part in str(caught.value)


def test_quantity_takes_si_units_only() -> None:
    with pytest.raises(UsageError, match="unit 'deg' is not SI; the SI unit is 'rad'"):
        quantity("deg")
    with pytest.raises(UsageError, match="unknown unit 'furlong'"):
        Quantity("furlong")


def test_quantities_in_containers_and_with_constraints(
    load: Callable[..., Fit], failure: Failure
) -> None:
    config = load(
        "dt: 50 ms\nlimit: 90 deg\nrates: {gnss: [5 Hz, 60 rpm], imu: [100]}\nwindow: 2 min\n"
    )
    assert (config.dt, config.limit, config.window) == (0.05, pytest.approx(math.pi / 2), 120.0)
    assert config.rates == {"gnss": (5.0, 1.0), "imu": (100.0,)}
    assert failure("dt: -50 ms\n") == "run.yaml:2: dt: must be greater than 0 (given -0.05)"
    assert failure("rates:\n  gnss: [1 Hz, 2 kn]\n").startswith(
        "run.yaml:3: rates.gnss.1: unit 'kn' does not measure [1/s]; units that do: Hz"
    )


def test_config_is_frozen_and_closed() -> None:
    config = Lstm(hidden_size=3)
    with pytest.raises(ValidationError, match="frozen"):
        config.hidden_size = 4
    with pytest.raises(ValidationError, match="Extra inputs"):
        Lstm(hidden_size=3, hiden=4)  # type: ignore[call-arg]


def test_defaults_are_checked() -> None:
    class Wrong(Config):
        dt: Seconds = Field(default=-1.0, gt=0)

    with pytest.raises(ValidationError, match="greater than 0"):
        Wrong()


# paths


def test_path_is_taken_from_the_configs_folder_first(
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


def test_path_expands_environment_and_home(
    load: Callable[..., Fit], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_LOGS", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load("out: ${TEST_LOGS}/a\n").out == tmp_path / "a"
    assert load("out: ~/b\n").out == tmp_path / "b"


def test_path_faults(failure: Failure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TEST_LOGS", raising=False)
    unset = (
        "out: environment variable 'TEST_LOGS' is not set; set it (export TEST_LOGS=...) or write"
        " the path itself"
    )
    assert failure("out: ${TEST_LOGS}/a\n").startswith(f"run.yaml:2: {unset}")
    monkeypatch.setenv("TEST_LOGS", "")
    assert failure("", "out=${TEST_LOGS}/a").startswith(f"override 'out=${{TEST_LOGS}}/a': {unset}")
    assert (
        failure("logs:\n- nope.csv\n")
        == "run.yaml:3: logs.0: no such file or folder: nope.csv (given 'nope.csv')"
    )
    assert failure(f"logs: [{'x' * 400}]\n").startswith(
        "run.yaml:2: logs.0: no such file or folder: "
    )
    assert failure("out: 3\n") == "run.yaml:2: out: expected a path (given 3)"
    assert failure("out: ''\n") == "run.yaml:2: out: expected a path (given '')"
    assert (
        failure("out: ~no-such-user/a\n")
        == "run.yaml:2: out: no home folder is known for '~' (given '~no-such-user/a')"
    )


# writing


def test_dump_loads_back_to_an_equal_config(
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
        sensors=(
            Sensor(name="multi\nline # ü"),
            Sensor(name="12:30"),
            Sensor(name="~"),
            Sensor(name=""),
        ),
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


def test_dump_is_complete_and_in_order_of_the_fields(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = dump_config(Fit(task="fit", policy=Mlp(hidden=(3, 4))))
    assert [line.split(":")[0] for line in text.splitlines() if not line.startswith(" ")] == list(
        Fit.model_fields
    )
    assert "  hidden: [3, 4]\n" in text
    assert f"out: {tmp_path}/runs\n" in text


def test_import_is_light() -> None:
    code = (
        "import sys, residnet.core.config; print(sorted({'torch', 'numpy', 'pandas', 'lightning',"
        " 'scipy'} & set(sys.modules)))"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "[]\n"
    )


class Parts(Config):
    """A mapping and a default."""

    parts: dict[str, int]
    size: int = 3


def test_a_key_is_taken_away(tmp_path: Path) -> None:
    path = tmp_path / "parts.yaml"
    path.write_text("parts: {a: 1, b: 2}\nsize: 5\n")
    assert load_config(path, ["~parts.a"], Parts) == Parts(parts={"b": 2}, size=5)
    assert load_config(path, ["~size"], Parts).size == 3
    assert load_config(path, ["~parts.a", "parts.a=7"], Parts).parts == {"a": 7, "b": 2}


@pytest.mark.parametrize(
    ("override", "message"),
    [("~parts.aa", "did you mean 'a'"), ("~parts.a.x", "no 'parts.a.x'"), ("~", "no ''")],
)
def test_what_is_not_there_cannot_be_taken_away(
    override: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "parts.yaml"
    path.write_text("parts: {a: 1, b: 2}\n")
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(path, [override], Parts)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", ["1234567890123456789012", "1e200", "-1e31", "1e-200"])
def test_numbers_that_no_vessel_has_are_refused(tmp_path: Path, number: str) -> None:
    path = tmp_path / "fit.yaml"
    path.write_text(f"task: fit\ndt: {number}\n")
    with pytest.raises(ConfigError, match=r"fit.yaml:2: dt: expected a number of usual size"):
        load_config(path, [], Fit)


def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(ConfigError, match="/dev/zero: is longer than 2 MB"):
        load_config(Path("/dev/zero"), [], Fit)


class Swept(Config):
    """A config with a base.

    Attributes:
        base: file, or the name of a shipped config.
    """

    base: BaseConfig


def test_a_base_is_a_file_or_a_shipped_config(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("task: fit\n")
    assert Swept.model_validate({"base": str(own)}).base == own
    assert Swept.model_validate({"base": "quickstart"}).base.name == "quickstart.yaml"
    with pytest.raises(ValidationError, match=r"no config 'quickstrat' either.*quickstart"):
        Swept.model_validate({"base": "quickstrat"})
    with pytest.raises(ValidationError, match="no such file or folder"):
        Swept.model_validate({"base": "absent.yaml"})
