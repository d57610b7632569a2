"""Run folders from somebody else: mutated at random, they run nothing and end in one line."""

from __future__ import annotations

import faulthandler
import hashlib
import io
import json
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from forged_run import forge_sums
from made_once import made_once
from pictures import omit_drawings
from tiny import TINY, Command, call, read_json, write_yaml
from tiny_tasks import boat, flown, measured

import residnet
from residnet.cli import main
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.run_loader import accept_run, name_damaged_key, read_json_value
from residnet.engine.c_code import find_compiler
from residnet.export import vessel
from residnet.report import page, still
from residnet.runs import folder as run_folder
from residnet.runs.folder import RunFolder
from residnet.tasks import registry
from residnet.tasks.fit import outcome

SECONDS = 5.0
"""Time after which a folder counts as one that hangs a command."""
BACKSTOP_SECONDS = 120.0
"""Time after which the process ends because code outside of Python does not return."""
SKLEARN: dict[str, Any] = {
    "name": "boosted",
    "heads": {"trees": {"kind": "sklearn", "samples": 100}},
    "bands": None,
    "ensembles": {},
    "training": {},
    "export": {"models": []},
}
REFITTED = {
    "refit": {"baseline": {"horizon": "5 s", "every": "5 s", "iterations": 1}},
    "ensembles": {"ensemble": ["ridge", "mlp"]},
    "export": {"models": []},
}
CONFIGS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "fit": lambda folder: measured(folder) | REFITTED,
    "simulate": flown,
    "sklearn": lambda folder: TINY | SKLEARN | {"data": TINY["data"] | {"duration": 25}},
}


# the run of scikit-learn takes the longest and has no code of its own in the readers
@pytest.fixture(
    scope="session",
    params=[
        pytest.param(kind, marks=[pytest.mark.long] if kind == "sklearn" else [])
        for kind in CONFIGS
    ],
)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of each kind."""

    def make(folder: Path) -> None:
        place = tmp_path_factory.mktemp("config")
        config = write_yaml(place / "config.yaml", CONFIGS[request.param](place))
        with pytest.MonkeyPatch.context() as patch:
            omit_drawings(patch)
            patch.setattr(outcome, "_MAX_ANALYSED_LOGS", 1)
            assert call(patch, "run", config, "--out", folder, "--quiet") == 0

    return made_once(tmp_path_factory, f"untrusted_{request.param}", make)


# ------------------------------------------------------------------------------ mutations

HOSTILE_VALUES: list[Any] = [
    "text", "", None, True, -1, 0, 1e308, 10**400, float("nan"), [], {}, [[]], {"a": {}},
    "../../victim.txt", "/etc/passwd", "/dev/zero", "sklearn.datasets.load_iris", "\0", "\ud800",
    "{{ 7*7 }}", "x" * 100_000, [0] * 10_000,
]  # fmt: skip


def _edit_json(path: Path, rng: random.Random) -> None:
    """Replace, remove or add a value at a random place of a JSON file."""
    content = json.loads(path.read_text())
    here = content
    places = []
    while isinstance(here, dict | list) and here:
        key = rng.choice([*here] if isinstance(here, dict) else range(len(here)))
        places.append((here, key))
        if rng.random() < 0.25:
            break
        here = here[key]
    if not places:
        content = rng.choice(HOSTILE_VALUES)
    else:
        parent, key = places[-1]
        if rng.random() < 0.3:
            del parent[key]
        else:
            parent[key] = rng.choice(HOSTILE_VALUES)
    path.write_text(json.dumps(content))


def _flip_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return a file with up to eight bytes replaced; an empty file stays empty."""
    damaged = bytearray(content)
    for _ in range(rng.randrange(1, 9) if content else 0):
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
    return bytes(damaged)


def _replace_by_link(kind: str, run: Path, path: Path, victim: Path, rng: random.Random) -> None:
    """Replace a file, or a folder of the run, by a symbolic link, or a file by a pipe."""
    if kind == "folder_link":
        folder = rng.choice([place for place in run.rglob("*") if place.is_dir()])
        shutil.rmtree(folder)
        folder.symlink_to(rng.choice([victim.parent, run, Path("/")]))
        return
    files = [file for file in sorted(run.rglob("*")) if file.is_file()]
    path.unlink()
    if kind == "link":
        path.symlink_to(rng.choice([victim, rng.choice(files), Path("nowhere"), path]))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        os.mkfifo(path)


def mutate(run: Path, victim: Path, rng: random.Random) -> str:
    """Change one file of a run folder; returns what was done."""
    files = [path for path in sorted(run.rglob("*")) if path.is_file()]
    texts = [path for path in files if path.suffix == ".json" and path.name != "checksums.json"]
    kind = rng.choice(
        ["truncate", "swap", "link", "folder_link", "device", "fifo", "enlarge", "flip", "delete"]
        + 9 * ["edit"]
    )
    path = rng.choice(texts if kind == "edit" else files)
    content = path.read_bytes()
    if kind == "truncate":
        path.write_bytes(content[: rng.randrange(len(content) + 1)])
    elif kind == "swap":
        other = rng.choice(files)
        path.write_bytes(other.read_bytes())
        other.write_bytes(content)
    elif kind in ("link", "folder_link", "device", "fifo"):
        _replace_by_link(kind, run, path, victim, rng)
    elif kind == "enlarge":
        with path.open("r+b") as file:
            file.truncate(rng.choice([len(content) + 7, 300_000_000]))
    elif kind == "flip":
        path.write_bytes(_flip_bytes(content, rng))
    elif kind == "delete":
        path.unlink()
    elif kind == "edit":
        _edit_json(path, rng)
    return f"{kind} {path.relative_to(run)}"


# -------------------------------------------------------------------------------- reading


class Hang(BaseException):
    """The alarm of a command that takes too long."""


def measure_slowness(seconds: float = 0.005) -> float:
    """Measure how many seconds pass for each second of the processor, at least 1.

    Other processes of the machine make it larger than 1.
    """
    wall_start = time.perf_counter()
    processor_start = time.thread_time()
    while time.thread_time() - processor_start < seconds:
        pass
    return max(1.0, (time.perf_counter() - wall_start) / (time.thread_time() - processor_start))


@contextmanager
def limited(seconds: float = SECONDS) -> Iterator[None]:
    """End a context that takes longer than `seconds` of wall time.

    Waiting counts as much as computing. Only where the processor is shared with other processes
    is the limit longer, by the factor that is measured at the start and when the time is over.
    """
    begin = time.monotonic()
    slowness = measure_slowness()

    def end_if_too_late(*_: object) -> None:
        nonlocal slowness
        slowness = max(slowness, measure_slowness())
        remaining = seconds * slowness - (time.monotonic() - begin)
        if remaining <= 0.0:
            raise Hang(f"longer than {seconds:g} s, at {slowness:.1f} s for each of the processor")
        signal.setitimer(signal.ITIMER_REAL, remaining)

    previous_handler = signal.signal(signal.SIGALRM, end_if_too_late)
    # an alarm is handled between two instructions of Python; a thread ends everything else
    assert sys.__stderr__ is not None
    faulthandler.dump_traceback_later(BACKSTOP_SECONDS, exit=True, file=sys.__stderr__)
    signal.setitimer(signal.ITIMER_REAL, seconds * slowness)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)
        faulthandler.cancel_dump_traceback_later()


@pytest.mark.parametrize("compute", [True, False])
def test_a_hang_is_ended_whether_it_computes_or_waits(compute: bool, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    begin = time.monotonic()

    def hang() -> None:
        while compute:
            pass
        (tmp_path / "fifo").read_bytes()

    with pytest.raises(Hang, match=r"longer than 0\.2 s"), limited(0.2):
        hang()
    assert 0.2 <= time.monotonic() - begin < 30.0
    with limited(0.2):
        pass


def _run_command(*words: object) -> None:
    """Carry out a command line; a refusal has to be one line.

    Raises:
        AssertionError: if it ends in several lines, a traceback or a defect.
    """
    output = io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(io.StringIO()),
        redirect_stderr(output),
    ):
        patch.setattr("sys.argv", ["residnet", *map(str, words)])
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
    said = output.getvalue()
    assert code in (0, 1, 2), said
    assert said.count("\n") <= 1, said
    assert "defect of residnet" not in said, said
    assert "Traceback" not in said, said


def _load_models(run: Path) -> None:
    for name in [path.name for path in sorted((run / "models").glob("*"))][:4] or ["selected"]:
        try:
            residnet.load(run, name)
        except ResidnetError:
            # each model has to be refused or loaded by itself
            continue


def _read_report(run: Path) -> None:
    registry.report_run(run)


def _list_runs(run: Path) -> None:
    registry.format_runs(run.parent, registry.list_runs(run.parent))


def _read_task(run: Path) -> None:
    folder = RunFolder.open(run)
    with name_damaged_key(run):
        registry.open_finished_task(run, registry.get_task_class(folder).supported_commands[0])
        if (run / "metrics.json").is_file():
            read_json_value(run / "metrics.json", run)


def _export(run: Path) -> None:
    # a random name or format would depend on the mutation: each model has its format
    names = sorted(path.name for path in (run / "models").glob("*"))[:4] or ["selected"]
    for name, file_format in zip(names, ("torchscript", "parameters", "casadi", "c"), strict=False):
        out = run.parent.parent / "written" / f"{name}.out"
        words = ("--model", name, "--format", file_format, "--anyway", "--quiet")
        _run_command("export", run, *words, "--out", out)


def _evaluate(run: Path) -> None:
    out = run.parent.parent / "written" / "evaluation"
    _run_command("evaluate", run, run.parent.parent / "new.csv", "--out", out, "--quiet")


def _monitor(run: Path) -> None:
    out = run.parent.parent / "written" / "page"
    words = ("--window", "5 s", "--out", out, "--quiet")
    _run_command("monitor", run, run.parent.parent / "new.csv", *words)


def _compare(run: Path) -> None:
    out = run.parent.parent / "written" / "comparison"
    undamaged = run.parent.parent / "undamaged"
    _run_command("compare", undamaged, run, "--out", out, "--quiet")


def _plan_trial(run: Path) -> None:
    out = run.parent.parent / "written" / "plan"
    _run_command("plan-trial", run, "--time", "10 s", "--count", 1, "--out", out, "--quiet")


ENTRANCES = [
    _load_models, _read_report, _list_runs, _read_task,
    _export, _evaluate, _monitor, _compare, _plan_trial,
]  # fmt: skip


@pytest.fixture
def no_execution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every start of a program and every pickle an error; pictures are not drawn.

    Only the compiler may start, with the sources that residnet writes for compiled rollouts.
    """

    def forbidden(*args: object, **_: object) -> None:
        raise AssertionError(f"something was executed: {args}")

    class CompilerOnly(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, args: Any, *others: Any, **settings: Any) -> None:
            if settings.get("shell") or args[0] != find_compiler():
                forbidden(args, settings)
            super().__init__(args, *others, **settings)

    for owner, name in (
        (os, "system"), (os, "popen"), (os, "execv"),
        (pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, forbidden)
    monkeypatch.setattr(subprocess, "Popen", CompilerOnly)
    # the revision of residnet's source is asked of git, whatever the run folder holds
    monkeypatch.setattr(run_folder, "read_git_revision", lambda: None)
    monkeypatch.setattr(vessel, "PARITY_STEPS", 20)
    monkeypatch.setattr(outcome, "_MAX_ANALYSED_LOGS", 0)
    omit_drawings(monkeypatch)
    # the drawings of the first screen read values of the run folder
    monkeypatch.setattr(page, "draw_svg", still.draw_svg)


def _hashes(folder: Path) -> dict[str, str]:
    return {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _fuzz_seed(
    finished: Path, folder: Path, victim: Path, seed: int, n_entrances: int
) -> tuple[list[str], bool]:
    """Mutate a copy of a run once and read it by some of the entrances.

    Returns:
        One line for each fault; and whether an entrance took too long.
    """
    run = folder / "runs" / "stranger"
    rng = random.Random(seed)
    shutil.copytree(finished, run)
    mutation = mutate(run, victim, rng)
    if rng.random() < 0.7:
        try:
            forge_sums(run)
            mutation += ", sums corrected"
        except OSError:
            # a device or a link has no sum
            pass
    turn = seed % len(ENTRANCES)
    faults = []
    hangs = False
    entrances = (ENTRANCES[turn], ENTRANCES[turn - rng.randrange(1, len(ENTRANCES))])
    for read in entrances[:n_entrances]:
        problem = ""
        try:
            with limited():
                read(run)
        except ResidnetError as error:
            problem = "several lines" if "\n" in str(error) else ""
        except (Hang, Exception) as error:
            hangs = hangs or isinstance(error, Hang)
            problem = f"{type(error).__name__}: {str(error).splitlines()[:1]}"[:300]
        if problem:
            faults.append(f"{seed} {mutation}, {read.__name__}: {problem}")
    shutil.rmtree(run)
    shutil.rmtree(folder / "written", ignore_errors=True)
    return faults, hangs


def fuzz(finished: Path, folder: Path, seeds: range, n_entrances: int) -> list[str]:
    """Mutate a run once for each seed, and read it by one or two of the entrances in turn.

    A mutation that takes too long is repeated once: a folder that hangs a command does so each
    time, while a machine that loads reclaimed memory pages from its disk stalls once.

    Returns:
        One line for each seed and entrance that was not refused in one line, took too long or
        touched a file outside of the run.
    """
    outside = folder / "outside"
    outside.mkdir()
    victim = outside / "victim.txt"
    victim.write_text("the user's thesis")
    boat(9).to_csv(folder / "new.csv", index=False)
    shutil.copytree(finished, folder / "undamaged")
    before = _hashes(outside) | _hashes(folder / "undamaged")
    faults = []
    for seed in seeds:
        seed_faults, hangs = _fuzz_seed(finished, folder, victim, seed, n_entrances)
        if hangs:
            seed_faults, _ = _fuzz_seed(finished, folder, victim, seed, n_entrances)
        faults += seed_faults
        if _hashes(outside) | _hashes(folder / "undamaged") != before:
            faults.append(f"{seed}: touched a file outside of the run")
    return faults


@pytest.mark.usefixtures("no_execution")
@pytest.mark.parametrize("read", ENTRANCES)
def test_an_undamaged_folder_is_read_in_time(
    read: Callable[[Path], None], finished: Path, tmp_path: Path
) -> None:
    boat(9).to_csv(tmp_path / "new.csv", index=False)
    for copy in (tmp_path / "undamaged", run := tmp_path / "runs" / "stranger"):
        shutil.copytree(finished, copy)
    begin = time.monotonic()
    with limited():
        read(run)
    assert time.monotonic() > begin


@pytest.mark.usefixtures("no_execution")
def test_mutated_folders_end_in_one_line(finished: Path, tmp_path: Path) -> None:
    # each entrance once; the long test reads hundreds of other mutations by two entrances each
    faults = fuzz(finished, tmp_path, range(len(ENTRANCES)), n_entrances=1)
    assert not faults, "\n".join(faults)


@pytest.mark.long
@pytest.mark.usefixtures("no_execution")
def test_a_thousand_mutated_folders_end_in_one_line(finished: Path, tmp_path: Path) -> None:
    faults = fuzz(finished, tmp_path, range(1_000, 1_334), n_entrances=2)
    assert not faults, "\n".join(faults)


# ------------------------------------------------------------------------- single attacks


@pytest.fixture
def stranger(tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy a finished run; reports of the copy are written without drawings."""
    omit_drawings(monkeypatch)
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    shutil.copytree(tiny_run, tmp_path / "stranger")
    return tmp_path / "stranger"


@pytest.mark.parametrize("absolute", [pytest.param(True, marks=pytest.mark.long), False])
def test_a_report_deletes_no_file_of_the_user(
    absolute: bool, command: Command, stranger: Path, tmp_path: Path
) -> None:
    thesis = tmp_path / "thesis.png"
    thesis.write_text("years of work")
    figure = sorted((stranger / "figures").glob("*.json"))[0]
    name = str(thesis) if absolute else "../../thesis.png"
    figure.write_text(json.dumps({**read_json(figure), "stills": [name]}))
    ended = command("report", stranger, "--quiet")
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    forge_sums(stranger)
    command("report", stranger, "--quiet")
    assert thesis.read_text() == "years of work"


@pytest.mark.parametrize("name", ["metrics.json", "resolved.yaml", "summary.json", "figures"])
def test_a_link_or_fifo_is_refused_by_every_command(
    name: str, command: Command, stranger: Path, tmp_path: Path
) -> None:
    place = stranger / name
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    for plant in (lambda: place.symlink_to("/dev/zero"), lambda: os.mkfifo(place)):
        plant()
        for words in (["report"], ["export"], ["plan-trial"], ["compare", stranger]):
            with limited(SECONDS):
                ended = command(words[0], *words[1:], stranger)
            assert (ended.code, ended.err.count("\n")) == (2, 1), words
        with limited(SECONDS):
            assert command("runs", tmp_path).code == 0
        place.unlink()


def test_a_missing_manifest_is_refused_until_it_is_accepted(
    command: Command, stranger: Path
) -> None:
    for manifest in stranger.rglob("checksums.json"):
        manifest.unlink()
    ended = command("export", stranger)
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "has no checksums.json; if you trust where it comes from" in ended.err
    accepted = command("trust", stranger)
    assert accepted.code == 0
    assert "metrics.json: " in accepted.out
    assert "files were new or changed" in accepted.out
    assert command("trust", stranger).out.startswith(f"{stranger}: accepted, 0 files")
    assert residnet.load(stranger, "ridge").name == "ridge"


def test_an_unlisted_file_is_refused_until_it_is_accepted(command: Command, stranger: Path) -> None:
    shutil.copytree(stranger / "models" / "ridge", stranger / "models" / "planted")
    (stranger / "models" / "planted" / "checksums.json").unlink()
    ended = command("export", stranger, "--model", "planted")
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "is not listed in checksums.json" in ended.err
    assert any("planted" in line for line in residnet.trust(stranger))


def test_a_folder_that_is_no_run_is_not_accepted(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(UsageError, match="neither the folder of a run nor that of a model"):
        accept_run(tmp_path)


@pytest.mark.parametrize(
    ("file", "keys", "value"),
    [
        ("models/ridge/fit.json", ["seconds"], "soon"),
        ("provenance.json", ["seconds"], "soon"),
        ("metrics.json", ["rows", 0, "rmse"], "small"),
    ],
)
def test_a_value_of_the_wrong_type_is_named(
    file: str, keys: list[Any], value: Any, command: Command, stranger: Path
) -> None:
    content = read_json(stranger / file)
    parent = content
    for key in keys[:-1]:
        parent = parent[key]
    parent[keys[-1]] = value
    (stranger / file).write_text(json.dumps(content))
    forge_sums(stranger)
    ended = command("report", stranger, "--quiet")
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert f"{stranger / file}: key '{'.'.join(map(str, keys))}" in ended.err


def test_files_of_the_user_in_a_run_folder_disturb_no_command(
    command: Command, stranger: Path
) -> None:
    (stranger / "notes.json").write_text("not JSON")
    (stranger / "figures" / "photo.png").write_bytes(b"no picture")
    (stranger / "sub").mkdir()
    (stranger / "sub" / "table.parquet").write_bytes(b"no table")
    assert command("export", stranger, "--model", "ridge", "--anyway", "--quiet").code == 0


def test_a_planted_result_is_refused(command: Command, stranger: Path) -> None:
    """A report reads results by their name, whether the run wrote them or not."""
    (stranger / "currents.json").write_text('{"a": 1}')
    ended = command("report", stranger, "--quiet")
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "currents.json: is not listed in checksums.json" in ended.err


def test_a_main_figure_that_is_no_number_makes_a_damaged_run(
    command: Command, stranger: Path
) -> None:
    summary = read_json(stranger / "summary.json")
    name = next(iter(summary["figures"]))
    summary["figures"][name]["value"] = "small"
    (stranger / "summary.json").write_text(json.dumps(summary))
    forge_sums(stranger)
    ended = command("runs", stranger.parent)
    assert ended.code == 0
    assert "damaged" in ended.out
    ended = command("report", stranger)
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert f"summary.json: key 'figures.{name}.value" in ended.err


def test_a_picture_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(UsageError, match=r"a\.png: not readable as a picture"):
        page._image_size_attributes(tmp_path / "a.png")
