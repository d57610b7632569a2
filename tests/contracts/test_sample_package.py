"""A package of somebody else: its parts pass the contracts, its broken ones are caught, it runs."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from sample_package import SAMPLE, install
from tiny import TINY
from written_logs import trial

CHECKS = """
from pathlib import Path
import sys
from residnet_sample.crowded import CrowdedConfig
from residnet_sample.knots import KnotsConfig
from residnet_sample.numbers import NumbersExporter
from residnet_sample.pulse import Pulse
from residnet_sample.slow_water import SlowWaterConfig
from residnet.testing import (
    check_exporter, check_head, check_manoeuvre, check_reader, check_vessel
)
check_head(SlowWaterConfig())
check_head(SlowWaterConfig(features=("u", "r", "tau_n"), time_constant=5.0))
check_reader(KnotsConfig(), Path(sys.argv[1]))
check_manoeuvre(Pulse())
check_exporter(NumbersExporter())
check_vessel("sample_ferry")
try:
    check_head(CrowdedConfig())
except AssertionError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("site"))


def python(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """A new interpreter that knows the sample package."""
    path = os.pathsep.join([str(site), *(entry for entry in sys.path if entry)])
    return subprocess.run(
        [sys.executable, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )


def write_knots(file: Path) -> None:
    """The made trial as the sample package's logger would write it."""
    log = trial(20.0)
    degrees = 180.0 / math.pi
    knots = 3600.0 / 1852.0
    columns = [
        log.t,
        log["x"],
        log["y"],
        log["psi"] * degrees,
        log["u"] * knots,
        log["v"] * knots,
        log["r"] * degrees,
    ]
    np.savetxt(file, np.stack(columns, axis=1), delimiter=",")


@pytest.mark.long
def test_its_parts_pass_the_contracts_and_the_broken_one_is_caught(
    site: Path, tmp_path: Path
) -> None:
    write_knots(tmp_path / "log.txt")
    done = python(site, "-c", CHECKS, tmp_path / "log.txt")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("head crowded: the residual of a row depends on the other rows")


@pytest.mark.long
def test_its_head_runs_by_name_from_yaml(site: Path, tmp_path: Path) -> None:
    """Fit, export in a format of the package, and what is listed."""
    config: dict[str, Any] = {
        **TINY,
        "name": "sample",
        "heads": {"slow": {"kind": "slow_water", "time_constant": "1 s"}},
        "training": {"slow": TINY["training"]["lstm"]},
        "export": {"models": ["slow"]},
    }
    del config["ensembles"]
    file = tmp_path / "sample.yaml"
    run = tmp_path / "run"
    file.write_text(yaml.safe_dump(config))
    done = python(site, "-m", "residnet.cli", "run", file, "--out", run)
    assert done.returncode == 0, done.stderr
    rows = json.loads((run / "metrics.json").read_text())["rows"]
    assert {row["model"] for row in rows} >= {"constant_velocity", "baseline", "slow"}
    assert (run / "report.html").is_file()
    # the tiny fit is rated "do not use", so that its export has to be demanded
    assert not (run / "exports" / "slow.pt").exists()
    done = python(site, "-m", "residnet.cli", "export", run, "--model", "slow", "--anyway")
    assert done.returncode == 0, done.stderr
    assert (run / "exports" / "slow.pt").is_file()
    words = ("export", run, "--model", "slow", "--format", "numbers", "--anyway")
    done = python(site, "-m", "residnet.cli", *words)
    assert done.returncode == 0, done.stderr
    assert "head.readout.weight,0," in (run / "exports" / "slow.csv").read_text()


@pytest.mark.long
def test_a_package_that_is_not_there_is_missed_by_name(tmp_path: Path) -> None:
    """Without the package its kind is unknown, in one line."""
    config = {**TINY, "heads": {"slow": {"kind": "slow_water"}}}
    for key in ("ensembles", "training", "export"):
        config.pop(key)
    (tmp_path / "sample.yaml").write_text(yaml.safe_dump(config))
    done = python(tmp_path, "-m", "residnet.cli", "check", tmp_path / "sample.yaml")
    assert done.returncode == 2
    assert "heads.slow.kind: unknown value 'slow_water'" in done.stderr
    assert done.stderr.count("\n") == 1


def test_it_is_a_package_that_pip_can_build() -> None:
    """Its sources are where its pyproject.toml says, and every entry point but one leads to one."""
    import tomllib

    project = tomllib.loads((SAMPLE / "pyproject.toml").read_text())
    points = [
        target for group in project["project"]["entry-points"].values() for target in group.values()
    ]
    folder = SAMPLE / project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"][0]
    missing = [
        target
        for target in points
        if not (folder.parent / (module := target.partition(":")[0].replace(".", "/"))).is_dir()
        and not (folder.parent / f"{module}.py").is_file()
    ]
    assert missing == ["residnet_sample.absent:AbsentConfig"]
