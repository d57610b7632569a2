"""Where residnet finds itself: no home, closed streams, full disks, odd clocks, hostile names."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from random_vessels import random_logs
from tiny import write_yaml

from residnet.tasks.drafting import write_new_config
from residnet.tasks.inspection import inspect_logs
from residnet.tasks.registry import load_task, open_finished_task

pytestmark = pytest.mark.long


def written(folder: Path, names: list[str]) -> Path:
    """Return a config of a baseline beside logs of a boat in canonical files, one of each name."""
    source = random_logs("boat", 3, 1)[0]
    logs = folder / "logs"
    files = list[str]()
    logs.mkdir()
    length = len(source[0]) // -(-len(names) // 3)
    for number, name in enumerate(names):
        log = source[number % 3].select_rows(
            slice(number // 3 * length, (number // 3 + 1) * length)
        )
        # pyarrow opens no file whose name is not UTF-8
        bare = name.replace("/", "_").replace("\0", "_").encode("utf-8", "replace")[:200]
        path = logs / os.fsdecode(b"%03d_%b.parquet" % (number, bare))
        log.replace(name=name, meta={**log.meta, "manoeuvre": name}).save(path)
        files.append(path.name)
    parts = {"train": files[::3], "validation": files[1::3], "test": files[2::3]}
    step = float(np.median(np.diff(source[0].t)))
    derivative = {"kind": "savitzky_golay", "window": 10 * step, "order": 2}
    windows = {"kind": "windows", "length": 100 * step, "first": 20 * step}
    split = {"root": "logs", **parts}
    config = {
        "task": "fit",
        "name": "bare",
        "data": {"kind": "measured", "reader": {"kind": "canonical"}, "split": split},
        "prepare": {"grid": {"step": step}, "derivative": derivative},
        "signals": {"inputs": ["n", "delta"]},
        "baseline": {"kind": "regressors", "sets": ["linear"], "ridge": 0.01},
        "evaluation": {
            "scales": {"u": 1.0, "v": 0.3, "r": 0.1},
            "protocols": {"T100": windows},
            "selection": "T100",
        },
        "export": {"models": []},
    }
    return write_yaml(folder / "bare.yaml", config)


PLAIN = r"""
.. . -rf --help ~ * ? [a] ' " `id` ;ls a:b ../../../escape /tmp/escape a/../../b a\b C:\x
CON nul.txt $ $x a$b$c $\frac{1}{0}$ \alpha %s%d {0} {{x}} <b>&amp;</b>
</script><script>alert(1)</script> é 日本語 عربي 🚤 $(reboot) |cat &&true >out <in !! # //host/x
\\host\x ~root =1+1 +1 -1 @SUM(A1) nan null true 0 1e9 inf t psi u ${HOME} %HOME% %n
{0.__class__} <!-- ]]> &#0; \n $$ COM1 LPT1.csv aux x. .hidden ... a,b;c a|b report.html
metrics.json models figures naïve %2e%2e%2fescape file:///escape
"""
"""What shells, formats, templates and tables take for more than a name."""
HOSTILE = [
    *PLAIN.split(),
    # blanks, control characters, what is no UTF-8, and what runs backwards
    *("", " ", "zigzag 10/10", "a\x00b", "\x00", "line\nbreak", "\r", "tab\there"),
    *("\x1b[31m", "K\xfcr \xdf", "\udce9t\udce9", "\u202eabc", "a\u0300", "\ufeffx"),
    *("x" * 300, "{% raw %}", "x ", "a\u2028b", "\x7f"),
]


@pytest.mark.parametrize("part", range(6))
def test_hostile_names_of_manoeuvres_logs_and_files(part: int, tmp_path: Path) -> None:
    """Each name is that of a log, of its manoeuvre and, where it can be, of its file."""
    # no file of others is asked for
    names = [name.replace("/tmp", str(tmp_path)) for name in HOSTILE[part::6]]
    work = tmp_path / "work"
    work.mkdir()
    config = written(work, names)
    before = set(tmp_path.rglob("*"))
    run = work / "run"
    load_task(config, []).run(output_folder=run)
    ended, task = open_finished_task(run, "evaluate")
    task.evaluate_on_logs(ended, [work / "logs"], work / "run" / "other")
    inspect_logs([work / "logs"], None)
    write_new_config([work / "logs"], work / "run" / "drafted.yaml", None, overwrite=False)
    made = set(tmp_path.rglob("*")) - before
    assert [path for path in made if path != run and run not in path.parents] == []
    assert (run / "report.html").is_file()


def limited(**limits: int) -> Callable[[], None]:
    def apply() -> None:
        for name, most in limits.items():
            resource.setrlimit(getattr(resource, name), (most, most))

    return apply


def closed(*streams: int) -> Callable[[], None]:
    def apply() -> None:
        for stream in streams:
            os.close(stream)

    return apply


def full(stream: int) -> Callable[[], None]:
    def apply() -> None:
        os.dup2(os.open("/dev/full", os.O_WRONLY), stream)

    return apply


ENVIRONMENTS: dict[str, tuple[dict[str, str | None], Callable[[], None] | None]] = {
    "no HOME": ({"HOME": None}, None),
    "HOME that is not there": ({"HOME": "/nowhere/at/all"}, None),
    "no environment": (dict.fromkeys(os.environ), None),
    "C locale": ({"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, None),
    "Turkish": ({"LC_ALL": "tr_TR.UTF-8"}, None),
    "ASCII streams": ({"PYTHONIOENCODING": "ascii"}, None),
    "TZ of a quarter": ({"TZ": "Asia/Kathmandu"}, None),
    "no PATH": ({"PATH": ""}, None),
    "no compiler": ({"CC": "/nowhere/cc", "CXX": "/nowhere/c++"}, None),
    "no DISPLAY": ({"DISPLAY": None, "MPLBACKEND": None}, None),
    "a backend with windows": ({"DISPLAY": ":99", "MPLBACKEND": "TkAgg"}, None),
    "caches that are files": (
        {"MPLCONFIGDIR": "/etc/passwd", "XDG_CACHE_HOME": "/etc/passwd"},
        None,
    ),
    "no TMPDIR": ({"TMPDIR": "/nowhere"}, None),
    "stdin closed": ({}, closed(0)),
    "stdout closed": ({}, closed(1)),
    "stderr closed": ({}, closed(2)),
    "all streams closed": ({}, closed(0, 1, 2)),
    "stdout full": ({}, full(1)),
    "stderr full": ({}, full(2)),
    "no file may grow": ({}, limited(RLIMIT_FSIZE=0)),
    "files of 20 kB": ({}, limited(RLIMIT_FSIZE=20_000)),
    "few open files": ({}, limited(RLIMIT_NOFILE=40)),
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("environments"), [f"log {i}" for i in range(6)])


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_no_environment_brings_a_traceback(name: str, logs: Path, tmp_path: Path) -> None:
    changes, before = ENVIRONMENTS[name]
    env = {**os.environ, **{key: value for key, value in changes.items() if value is not None}}
    env = {key: value for key, value in env.items() if changes.get(key, "") is not None}
    env["PYTHONPATH"] = os.environ.get("PYTHONPATH", "")
    # a run writes most; elsewhere a draft shows as much in a tenth of the time
    command = ["new", str(logs.parent / "logs"), "--out", str(tmp_path / "new.yaml")]
    if name in ("no HOME", "files of 20 kB"):
        command = ["run", str(logs), "--out", str(tmp_path / "run")]
    # standard streams of their own, so that those that are closed are its own
    with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
        done = subprocess.run(
            [sys.executable, "-m", "residnet", *command],
            cwd=tmp_path,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            preexec_fn=before,
            check=False,
        )
    said = (tmp_path / "out").read_text() + (tmp_path / "err").read_text()
    assert done.returncode in (0, 1, 2), said
    assert "Traceback" not in said
    assert "this is a defect" not in said
    made = {path.name for path in tmp_path.iterdir()}
    assert made <= {"out", "err", "run", "new.yaml"}
    assert {path.name for path in logs.parent.iterdir()} == {"logs", "bare.yaml"}
