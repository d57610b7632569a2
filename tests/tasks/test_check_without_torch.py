"""Configs are data: a config is read and checked without PyTorch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import residnet
from residnet.baselines import BaselineConfig
from residnet.core.registry import get_plugin_union
from residnet.heads import HeadConfig
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.physics.vessel import find_vessel_files, load_vessel
from residnet.tasks.registry import TaskConfig

QUICKSTART = Path(residnet.__file__).parents[2] / "configs" / "quickstart.yaml"
"""Shipped config of a fit of simulated trials, with a baseline and three heads."""

LIST_TORCH_IMPORTS = """
import importlib, sys
for module in sys.argv[1:]:
    importlib.import_module(module)
    print(module, "torch" in sys.modules)
"""
"""Program that prints each module of its arguments, and whether PyTorch is loaded after it."""


def run_python(program: str, *arguments: str) -> str:
    """Run a program in a process of its own; return its standard output."""
    finished = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def test_check_of_quickstart_takes_at_most_two_seconds_of_processor_time() -> None:
    # tests/test_start_up.py looks at the packages that it imports
    # 0.9 s on two busy cores of 2.5 GHz; PyTorch alone takes 1.8 s
    program = """
import sys, time
sys.argv = ["residnet", "check", sys.argv[1]]
from residnet.__main__ import main
try:
    main()
except SystemExit as end:
    assert not end.code
print(time.process_time())
"""
    assert float(run_python(program, str(QUICKSTART)).splitlines()[-1]) < 2.0


def test_config_classes_of_parts_import_no_torch() -> None:
    modules = {"residnet.autopilot.manoeuvres"}
    for union in (HeadConfig, BaselineConfig, ManoeuvreConfig, FamilyConfig, TaskConfig):
        core_kinds = get_plugin_union(union).core_kinds
        assert core_kinds
        modules |= {object_path.partition(":")[0] for object_path in core_kinds.values()}
    # a module of the user is PyTorch code by definition
    modules.discard("residnet.heads.module")
    lines = run_python(LIST_TORCH_IMPORTS, *sorted(modules)).splitlines()
    assert lines == [f"{module} False" for module in sorted(modules)]


@pytest.mark.parametrize("name", sorted(find_vessel_files()))
def test_channels_of_a_vessel_config_are_those_of_its_plant(name: str) -> None:
    from residnet.manoeuvres.base import Helm

    vessel = load_vessel(name)
    channels = vessel.plant_channels()
    plant = vessel.build()
    helm = Helm.from_plant(plant)
    assert channels.state_names == plant.state_names
    assert channels.input_names == plant.input_names
    assert len(channels.command_names) == plant.n_commands
    assert channels.can_dive == (plant.dive_commands is not None)
    assert channels.max_rudder == helm.max_rudder
    assert channels.has_force_commands == (helm.forces is not None)
    assert channels.max_side_force == helm.side_force
