"""Parts of other installed packages, with the sample package of examples/ as one."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sample_package import install

from residnet.core import registry
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.exits import run_cli
from residnet.export import EXPORT_FORMATS, get_exporter
from residnet.heads import HeadConfig
from residnet.heads.linear import PlsrConfig
from residnet.io.readers import ReaderConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.physics.vessel import load_vessel
from residnet.tasks.registry import list_catalogue


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path that the sample package is installed in."""
    monkeypatch.syspath_prepend(install(tmp_path / "site"))
    registry.clear_caches()
    yield tmp_path
    monkeypatch.undo()
    registry.clear_caches()
    for name in [name for name in sys.modules if name.startswith("residnet_sample")]:
        del sys.modules[name]


def declare(site: Path, group: str, **points: str) -> None:
    """Add a made package with entry points in one group."""
    info = site / "made-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: made\nVersion: 1.0\n")
    lines = "".join(f"{name} = {target}\n" for name, target in points.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")
    registry.clear_caches()


@pytest.mark.usefixtures("installed")
def test_load_kinds_finds_parts_of_packages() -> None:
    head = validate_config({"kind": "slow_water", "time_constant": "3 s"}, HeadConfig, "here")
    assert type(head).__module__ == "residnet_sample.slow_water"
    assert head.time_constant == 3.0
    assert validate_config({"kind": "knots"}, ReaderConfig, "here").build() is not None
    assert validate_config({"kind": "pulse"}, ManoeuvreConfig, "here").kind == "pulse"
    assert load_vessel("sample_ferry").build().n_commands == 2
    assert get_exporter("numbers").suffix == ".csv"
    for given, told in (
        ({"kind": "slow_water", "time_konstant": 3}, "unknown key; did you mean 'time_const"),
        ({"kind": "slow_watr"}, "'slow_watr'; did you mean 'slow_water'"),
    ):
        with pytest.raises(ConfigError, match=told):
            validate_config(given, HeadConfig, "here")


@pytest.mark.usefixtures("installed")
def test_unknown_kind_suggests_to_install_its_package() -> None:
    with pytest.raises(ConfigError, match=r"or install the package that registers it"):
        validate_config({"kind": "tidal_drag"}, HeadConfig, "here")


def test_part_without_docstring_is_listed(installed: Path) -> None:
    (installed / "site" / "made_bare.py").write_text(
        "from typing import Literal\n"
        "from residnet_sample.slow_water import SlowWaterConfig\n"
        "class BareConfig(SlowWaterConfig):\n"
        "    kind: Literal['bare'] = 'bare'\n"
    )
    declare(installed / "site", "residnet.heads", bare="made_bare:BareConfig")
    assert dict(registry.list_parts(HeadConfig))["bare"] == "(no description)"


@pytest.mark.usefixtures("installed")
def test_packages_of_parts_have_their_versions() -> None:
    head = validate_config({"kind": "slow_water"}, HeadConfig, "here")
    ridge = validate_config({"kind": "plsr"}, HeadConfig, "here")
    assert registry.find_part_packages({"a": [head], "b": ridge}) == {"residnet-sample": "0.1.0"}
    assert registry.find_part_packages(ridge) == {}


@pytest.mark.usefixtures("installed")
def test_broken_part_raises_only_where_it_is_used() -> None:
    with pytest.raises(ConfigError, match=r"residnet-sample 0\.1\.0 cannot be used: ModuleNotF"):
        validate_config({"kind": "absent", "anything": 1}, HeadConfig, "here")
    listed = dict(list_catalogue("heads"))
    assert listed["absent"].startswith("(cannot be used: ModuleNotFoundError")
    assert listed["slow_water"].startswith("Linear map")


@pytest.mark.parametrize(
    ("target", "fault"),
    [
        (
            "residnet.baselines.regressors_config:RegressorsConfig",
            "not a subclass of residnet.heads.config.BaseHeadConfig",
        ),
        ("residnet.heads.config:BaseHeadConfig", "BaseHeadConfig lacks build"),
        ("residnet_sample.slow_water:SlowWaterConfig", "has no field `kind: Literal['odd']`"),
        ("residnet_sample.slow_water:Nothing", "AttributeError"),
        ("os", "not a subclass"),
    ],
)
def test_entry_points_of_kinds_with_faults(installed: Path, target: str, fault: str) -> None:
    declare(
        installed / "site",
        "residnet.heads",
        odd=target,
        plsr="residnet_sample.slow_water:SlowWaterConfig",
    )
    listed = dict(registry.list_parts(HeadConfig))
    assert fault in listed["odd"]
    # no package takes a name away
    assert isinstance(validate_config({"kind": "plsr"}, HeadConfig, "here"), PlsrConfig)
    assert "residnet has a kind of that name" in listed["plsr"]


@pytest.mark.parametrize(
    ("statement", "fault"),
    [
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise GeneratorExit('no')", "GeneratorExit: no"),
        ("class Stop(BaseException): pass\nraise Stop('two\\nlines')", "Stop: two"),
    ],
)
def test_entry_point_that_exits_is_skipped_and_reported(
    installed: Path, statement: str, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed / "site" / "made_package.py").write_text(statement + "\n")
    declare(installed / "site", "residnet.heads", boom="made_package:Head")
    listed: dict[str, str] = {}
    run_cli(lambda: listed.update(list_catalogue("heads")))
    assert listed["boom"].startswith(f"(cannot be used: {fault}; from made 1.0")
    assert "slow_water" in listed
    lines = [line for line in capsys.readouterr().err.splitlines() if "boom" in line]
    assert lines == [
        "residnet: warning: entry point 'boom' in residnet.heads of the package made 1.0 was"
        f" skipped ({fault}); repair or uninstall that package"
    ]


def test_entry_point_interruption_is_propagated(installed: Path) -> None:
    (installed / "site" / "made_stop.py").write_text("raise KeyboardInterrupt\n")
    declare(installed / "site", "residnet.heads", boom="made_stop:Head")
    with pytest.raises(KeyboardInterrupt):
        list_catalogue("heads")


def test_entry_points_of_formats_and_vessels_with_faults(installed: Path) -> None:
    declare(installed / "site", "residnet.exporters", odd="residnet_sample.knots:KnotsReader")
    assert isinstance(EXPORT_FORMATS.find_kind("odd"), registry.EntryPointPart)
    with pytest.raises(ConfigError, match=r"format 'odd' of the package made 1\.0 cannot be"):
        get_exporter("odd")
    with pytest.raises(ConfigError, match=r"no export format 'gguf'; valid: .*torchscript"):
        get_exporter("gguf")


def test_vessel_entry_point_without_files(installed: Path) -> None:
    declare(installed / "site", "residnet.vessels", odd="residnet_sample.pulse:Pulse")
    assert "not a package with data files" in dict(list_catalogue("vessels"))["odd"]
    assert "sample package" in dict(list_catalogue("vessels"))["sample_ferry"]
