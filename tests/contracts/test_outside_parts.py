"""A reader, heads and a baseline of another package: endings, faults in their code, provenance."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sample_package import write_package

import residnet
from residnet.baselines import BaselineConfig
from residnet.core import registry
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.external_parts import describe_external_error
from residnet.dynamics.first_step import check_first_step
from residnet.heads import HeadConfig
from residnet.heads.module import register_module
from residnet.identification.settings import FitSettings
from residnet.io.drafting.log_files import find_log_files
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import read_drafted
from residnet.io.readers import ReaderConfig
from residnet.io.readers.detect import AutoConfig, detect_log_kind
from residnet.io.split import find_logs
from residnet.testing import check_baseline, check_head, check_reader, make_example_samples

CODE = textwrap.dedent(
    """
    from typing import ClassVar, Literal
    import numpy as np
    import torch
    from torch import nn
    from residnet.baselines.base import Baseline
    from residnet.baselines.config import IdentifiedConfig
    from residnet.heads.base import Features, ResidualHead
    from residnet.heads.config import BaseHeadConfig
    from residnet.core.log import Log
    from residnet.io.readers.base import ConfiguredReader, require_file, wrap_read_errors
    from residnet.io.readers.compose import RecordingConfig
    from residnet.io.readers.recording import ALL_FIELDS, Recording, Series

    class PlumbConfig(RecordingConfig):
        "Tables of a logger: t [s], spd [kn], rot [deg/s], rud [deg]."
        kind: Literal["plumb"] = "plumb"
        endings: ClassVar[tuple[str, ...]] = (".plumb", ".csv")

        def load(self, path, field_filter=ALL_FIELDS):
            require_file(path)
            with wrap_read_errors(path, "a table of a Plumb logger"):
                t, *columns = np.loadtxt(path, delimiter=";", ndmin=2).T
                fields = dict(zip(("spd", "rot", "rud"), columns, strict=True))
            return Recording(path, {"nav": Series("nav", "", fields, stamp=t)}, files=(path,))

    class DirectConfig(ConfiguredReader):
        "Reader that returns channels in SI units."
        kind: Literal["direct"] = "direct"
        endings: ClassVar[tuple[str, ...]] = (".direct",)

        def read(self, path):
            t, u = np.loadtxt(path, delimiter=";").T
            meta = {"source": str(path), "sha256": ""}
            return Log(path.stem, t, {"u": u, "r": 0.1 * np.sin(t)}, meta=meta)

    class CrudeConfig(PlumbConfig):
        "Reader whose load raises a plain error."
        kind: Literal["crude"] = "crude"
        endings: ClassVar[tuple[str, ...]] = ()

        def load(self, path, field_filter=ALL_FIELDS):
            raise KeyError("spd")

    class ShortConfig(CrudeConfig):
        "Reader that returns a dictionary."
        kind: Literal["short"] = "short"

        def load(self, path, field_filter=ALL_FIELDS):
            return {"t": [0.0, 1.0]}

    class NarrowConfig(BaseHeadConfig):
        "Head with two residuals."
        kind: Literal["narrow"] = "narrow"
        def build(self, names):
            return Narrow(self, names)

    class Narrow(ResidualHead):
        def __init__(self, config, names):
            super().__init__(names)
            self.features = Features(config.select_features(names), names, config.margin)
            self.readout = nn.Linear(self.features.n_features, 2)

        def forward(self, z, s):
            return self.readout(self.features(z)), s

    class SingleConfig(NarrowConfig):
        "Head that returns one tensor."
        kind: Literal["single"] = "single"
        def build(self, names):
            return Single(self, names)

    class Single(Narrow):
        def forward(self, z, s):
            return self.readout(self.features(z))

    class TransposedConfig(NarrowConfig):
        "Head with an error in forward."
        kind: Literal["transposed"] = "transposed"
        def build(self, names):
            return Transposed(self, names)

    class Transposed(Narrow):
        def forward(self, z, s):
            return self.readout(self.features(z).T), s

    class VoidConfig(NarrowConfig):
        "Head without forward."
        kind: Literal["void"] = "void"
        def build(self, names):
            return Void(names)

    class Void(ResidualHead):
        pass

    class FlatConfig(IdentifiedConfig):
        "Baseline that returns one acceleration."
        kind: Literal["flat"] = "flat"
        def build(self, names):
            return Flat()

    class Flat(Baseline):
        def forward(self, z):
            return z[..., :1]
    """
)
HEAD_FAULTS = {
    "single": r"^head 'single' \(class Single of package outside 1\.0\): forward returned Tensor,"
    r" expected \(residual \[B, 3\], memory \[B, 0\]\)$",
    "narrow": r"class Narrow .*: forward returned \(\[B, 2\], \[B, 0\]\), expected \(residual",
    "transposed": r"class Transposed .*: RuntimeError in forward of Transposed \(outside\.py, line",
    "void": r"TypeError in build of VoidConfig \(outside\.py, line \d+\): Can't instantiate",
}
CHANNELS = {
    "u": {"field": "spd", "unit": "kn"},
    "r": {"field": "rot", "unit": "deg/s"},
    "delta": {"field": "rud", "unit": "deg"},
}


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install the package; return a folder with two logs of its logger."""
    site = tmp_path / "site"
    site.mkdir()
    kinds = {
        "heads": ("narrow", "single", "transposed", "void"),
        "readers": ("plumb", "direct", "crude", "short"),
        "baselines": ("flat",),
    }
    entry_points = {
        group: "\n".join(f"{kind} = outside:{kind.capitalize()}Config" for kind in group_kinds)
        for group, group_kinds in kinds.items()
    }
    write_package(site, "outside", CODE, **entry_points)
    monkeypatch.syspath_prepend(site)
    _forget_kinds()
    folder = tmp_path / "logs"
    folder.mkdir()
    t = np.arange(0.0, 40.0, 0.2)
    rudder = 15.0 * np.sign(np.sin(0.3 * t))
    columns = (t, 4.0 + 0.1 * np.sin(0.2 * t), 2.0 * np.sin(0.3 * t), rudder)
    for name in ("one.plumb", "two.PLUMB"):
        np.savetxt(folder / name, np.stack(columns, axis=1), delimiter=";")
    yield folder
    monkeypatch.undo()
    _forget_kinds()
    sys.modules.pop("outside", None)


def _forget_kinds() -> None:
    """List the kinds again, also in the schema of `FitSettings`, which its first use builds."""
    registry.clear_caches()
    FitSettings.model_rebuild(force=True)


def test_endings_of_a_registered_reader_are_logs(logs: Path) -> None:
    assert [path.name for path in find_logs(logs)] == ["one.plumb", "two.PLUMB"]
    assert detect_log_kind(logs / "one.plumb") == "plumb"
    notes = DraftNotes()
    drafted = read_drafted(find_log_files([logs]), notes)
    assert drafted.reader["kind"] == "plumb"
    assert not drafted.errors
    assert "delta" in next(iter(drafted.logs.values())).channels
    for kind in ("plumb", "auto"):
        reader = {"kind": kind, "channels": CHANNELS}
        read = residnet.read_logs(str(logs), reader=reader)
        assert [log.name for log in read] == ["one", "two"]
        assert np.allclose(read[0]["r"], np.deg2rad(2.0 * np.sin(0.3 * read[0].t)))


def test_reader_of_channels_needs_no_channel_map(logs: Path) -> None:
    file = logs / "three.direct"
    file.write_text("".join(f"{0.1 * k:.1f};{1.0 + 0.01 * k:.2f}\n" for k in range(50)))
    drafted = read_drafted([file], DraftNotes())
    assert drafted.reader == {"kind": "direct"}
    assert drafted.logs[file]["u"][1] == 1.01
    with pytest.raises(UsageError, match="set `kind: direct`"):
        AutoConfig().read(file)


def test_registered_reader_takes_no_ending_of_residnet(logs: Path) -> None:
    (logs / "table.csv").write_text("t [s],u [m/s]\n0,1\n1,2\n2,3\n")
    assert detect_log_kind(logs / "table.csv") == "table"
    with pytest.raises(UsageError, match="residnet new FOLDER") as caught:
        AutoConfig().read(logs / "table.csv")
    assert "--config" not in str(caught.value)


def test_message_on_unknown_files_names_endings_of_readers(tmp_path: Path, logs: Path) -> None:
    del logs
    folder = tmp_path / "unknown"
    folder.mkdir()
    (folder / "a.abc").write_bytes(bytes(range(256)))
    with pytest.raises(UsageError, match=r"accept .*\.plumb \(plumb\)"):
        find_log_files([folder])


def test_faults_of_a_reader_name_its_class_and_package(logs: Path) -> None:
    check_reader(
        validate_config({"kind": "plumb", "channels": CHANNELS}, ReaderConfig, "here"),
        logs / "one.plumb",
    )
    for kind, fault in {
        "crude": r"one\.plumb: reader 'crude' \(class CrudeConfig of package outside 1\.0\):"
        r" KeyError in load of CrudeConfig \(outside\.py, line \d+\): 'spd'",
        "short": "load returned dict, expected a Recording",
    }.items():
        config = validate_config({"kind": kind}, ReaderConfig, "here")
        with pytest.raises(DataError, match=fault):
            config.build().read(logs / "one.plumb")
        with pytest.raises(AssertionError, match=fault):
            check_reader(config, logs / "one.plumb")


@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize("kind", HEAD_FAULTS)
def test_faults_of_a_head_are_errors_before_the_fit(kind: str) -> None:
    config = validate_config({"kind": kind}, HeadConfig, "here")
    with pytest.raises(ConfigError, match=HEAD_FAULTS[kind]):
        check_first_step(config, ("u", "v", "r", "n_port", "n_stbd"))
    with pytest.raises(AssertionError, match=HEAD_FAULTS[kind].replace("$", "")):
        check_head(config)


@pytest.mark.usefixtures("logs")
def test_fit_settings_check_the_first_step_of_external_parts() -> None:
    settings = {
        "signals": {"inputs": ["delta"]},
        "prepare": {
            "grid": {"step": 0.1},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
        },
        "baseline": {"kind": "regressors", "terms": ["u", "v", "r"]},
        "evaluation": {
            "protocols": {"T": {"kind": "windows", "length": 5.0, "first": 1.0, "history": 1.0}},
            "selection": "T",
            "scales": {"u": 0.5, "v": 0.2, "r": 0.1},
        },
    }
    with pytest.raises(ConfigError, match="forward returned Tensor"):
        validate_config({**settings, "heads": {"mine": {"kind": "single"}}}, FitSettings, "here")
    head = validate_config({"kind": "single"}, HeadConfig, "here").build(("u", "v", "r", "delta"))
    with pytest.raises(ConfigError, match=r"class Single of package outside\): forward returned"):
        validate_config({**settings, "heads": {"mine": register_module(head)}}, FitSettings, "here")
    with pytest.raises(ConfigError, match=r"returned \[B, 1\], expected accelerations"):
        validate_config({**settings, "baseline": {"kind": "flat"}}, FitSettings, "here")


@pytest.mark.usefixtures("logs")
def test_faults_of_a_baseline_name_its_class() -> None:
    config = validate_config({"kind": "flat"}, BaselineConfig, "here")
    with pytest.raises(AssertionError, match=r"baseline 'flat' \(class Flat of package outside"):
        check_baseline(config)


@pytest.mark.usefixtures("logs")
def test_any_error_in_a_registered_package_names_it() -> None:
    head = validate_config({"kind": "transposed"}, HeadConfig, "here").build(("u", "v", "r"))
    import torch

    with pytest.raises(RuntimeError) as caught:
        head(torch.zeros(7, 3), torch.zeros(7, 0))
    message = describe_external_error(caught.value)
    assert message.startswith("RuntimeError in Transposed.forward (outside.py, line")
    assert "of the package outside 1.0: mat1" in message
    assert describe_external_error(ValueError("no traceback")) == ""


def test_example_samples_name_inputs_that_the_vessel_lacks() -> None:
    from residnet.physics.signals_config import SignalsConfig

    with pytest.raises(UsageError, match=r"'wam_v_cal' have no input 'delta'; valid: .*n_port"):
        make_example_samples("wam_v_cal", SignalsConfig(inputs=("delta", "n")))
