"""The order of the files, so that two processes end together, and runs for everybody."""

from __future__ import annotations

import gc
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from made_once import made_once
from sample_package import TASKS, install
from tiny import TINY, Command, Said, call, write_yaml

from residnet.core.processes import retain_freed_memory
from residnet.core.registry import clear_caches

# the interval between searches for reference cycles that the command line uses
gc.set_threshold(100_000)
# as every run does
retain_freed_memory()

DEAR = (
    "contracts/test_every_part.py",
    "runs/test_untrusted_folders.py",
    "corpus/test_corpus.py",
    "io/test_consensus.py",
    "export/test_formats.py",
    "test_api.py",
    "export/test_c_names.py",
    "golden/test_golden.py",
    "identification/monitoring/test_monitor.py",
    "tasks/test_new.py",
    "tasks/test_data_loss.py",
    "physics/test_every_vessel.py",
    "heads/test_symbolic.py",
    "test_layers.py",
    "report/test_figures.py",
    "io/test_doctor_faults.py",
    "export/test_policies.py",
    "studies/test_jervan2020.py",
    "identification/test_some_velocities.py",
    "identification/test_fit.py",
    "io/test_motion.py",
    "autopilot/test_courses.py",
    "io/test_relations.py",
    "tasks/test_refusals.py",
    "autopilot/test_steering_identified.py",
    "io/test_doctor.py",
    "contracts/test_beyond_the_plane.py",
    "tasks/test_sklearn_run.py",
    "autopilot/test_heading.py",
    "tasks/test_check_without_torch.py",
    "tasks/test_simulate.py",
    "report/test_sections.py",
    "tasks/test_scale.py",
    "autopilot/test_design.py",
    "quality/test_compatibility_table.py",
    "autopilot/test_roll_task.py",
    "tasks/test_drafted_currents.py",
    "export/test_domain.py",
    "io/test_drafting.py",
    "io/test_basin_workbooks.py",
    "autopilot/test_depth.py",
    "studies/test_force_residual.py",
    "quality/test_lack_of_fit.py",
    "io/test_drafting_habits.py",
    "preprocessing/test_compatibility.py",
)
"""Files of four seconds or more, the longest first, so that the last ones are short."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files; `--dist loadfile` gives each to one process, which makes its fixtures."""
    order = {f"tests/{name}": number for number, name in enumerate(DEAR)}
    items.sort(key=lambda item: order.get(item.nodeid.partition("::")[0], len(DEAR)))


def pytest_collection_finish() -> None:
    """Exclude modules and collected tests, which live until the end, from the search for cycles."""
    gc.freeze()


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Carries out a command line in this process."""

    def carried_out(*words: object) -> Said:
        capsys.readouterr()
        return Said(call(monkeypatch, *words), *capsys.readouterr())

    return carried_out


@pytest.fixture
def omit_currents(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draft without a test for currents, which takes a third of the time of a draft.

    `tests/tasks/test_drafted_currents.py` and the long tests of the corpus draft with it.
    """
    monkeypatch.setattr("residnet.tasks.drafting._has_current", lambda *_: False)


@pytest.fixture(scope="module")
def example_tasks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The tasks `actuators` and `import` of examples/residnet_tasks, as if it were installed."""
    site = install(tmp_path_factory.mktemp("site"), TASKS)
    sys.path.insert(0, str(site))
    clear_caches()
    yield
    sys.path.remove(str(site))
    clear_caches()


@pytest.fixture(scope="session")
def tiny_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configuration of `tiny_run` as a file."""
    return write_yaml(tmp_path_factory.mktemp("config") / "tiny.yaml", TINY)


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run without drawings, a copy for each process."""

    def make(folder: Path) -> None:
        # not at the top: the process that distributes the tests needs no PyTorch
        from pictures import omit_drawings

        from residnet.export import vessel

        with pytest.MonkeyPatch.context() as patch:
            omit_drawings(patch)
            patch.setattr(vessel, "PARITY_STEPS", 60)
            assert call(patch, "run", tiny_config, "--out", folder) == 0

    out = tmp_path_factory.mktemp("runs") / "tiny"
    shutil.copytree(made_once(tmp_path_factory, "tiny", make), out)
    return out
