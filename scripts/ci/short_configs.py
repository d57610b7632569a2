"""Run every shipped config in a shortened form, to its report.

Each config under configs/ has a row in `SHORT`: overrides that keep every part of the run but
lessen the work. A config without a row fails. Configs whose data are absent are skipped visibly.

    python scripts/ci/short_configs.py [NAME...] [--jobs 2] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
LIMIT = 400
"""Seconds after which a run has failed."""


@dataclass(frozen=True)
class Short:
    """How a config is shortened.

    Attributes:
        overrides: of its keys; `{runs}` stands for the folder of all short runs.
        data: folder below RESIDNET_DATA that it needs; empty for none.
        after: config whose short run it uses.
    """

    overrides: tuple[str, ...] = ()
    data: str = ""
    after: str = ""


# fewer simulated sea trials
_TRIALS = (
    "data.trials=[{kind: constant, drive: [0.4, 0.9], steer: [-0.4, 0.0, 0.4]},"
    " {kind: zigzag, count: 5, heading: [20 deg]}, {kind: acceleration_deceleration, count: 3},"
    " {kind: three_two_one_one, count: 3}]",
    "data.identification={zigzag: 4, acceleration_deceleration: 2, three_two_one_one: 2}",
    "data.validation={zigzag: 1, acceleration_deceleration: 1, three_two_one_one: 1}",
)
# and of those under water
_DIVES = (
    "data.trials=[{kind: depth_step, count: 4, depth: [1], drive: [0.1, 0.2], dive: [0.1, 0.2]},"
    " {kind: random_steps, count: 4, drive: [0.1, 0.2], steer_amplitude: [0.0, 0.04],"
    " dive_amplitude: [0.0, 0.1], own_amplitude: [0.01, 0.04]}]",
    "data.identification={depth_step: 3, random_steps: 3}",
    "data.validation={depth_step: 1, random_steps: 1}",
    "refit={}",
    "bands=null",
)
_ONE_STEP = "{epochs: 1, window: 2 s, batch: 32}"
_MULTI_STEP = "[{horizon: 2 s, epochs: 1, batch: 32}]"


def _trained(*heads: str) -> tuple[str, ...]:
    """Return overrides for one short epoch of each stage."""
    return tuple(
        override
        for head in heads
        for override in (
            f"training.{head}.steps=2",
            f"training.{head}.one_step={_ONE_STEP}",
            f"training.{head}.multi_step={_MULTI_STEP}",
        )
    )


def _policy(name: str) -> tuple[str, ...]:
    short = ("epochs=1", "steps=1", "batch=16", "validation=16", "hold=0 s", "compiled=false")
    return tuple(f"policies.{name}.training.{key}" for key in short)


def _predictor(name: str) -> tuple[str, ...]:
    return (f"predictive.{name}.training={{states: 300, epochs: 5, batch: 50}}",)


# eight logs of the Esso Osaka model tanker are enough
_TANKER = (
    "refit={}",
    "baselines.physics={kind: regressors, terms: [u, v, r, n]}",
    "evaluation.splits=[validation, test]",
    "bands=null",
    *_trained("mlp", "lstm"),
)
_COARSE = (
    "prepare.grid={step: 0.5 s, held: [n, delta]}",
    "prepare.derivative={kind: savitzky_golay, window: 2.5 s, order: 2}",
    "evaluation.splits=[validation, test]",
    "bands=null",
)
_SWEPT = (
    "common=["
    + ", ".join(
        f"'{override}'"
        for override in (
            *_TRIALS,
            "heads={mlp: {kind: mlp, hidden: [8]}}",
            "~training.lstm",
            *_trained("mlp"),
            "bands=null",
            "export.models=[]",
        )
    )
    + "]",
)
_FERRY = ("course.interval=10 s",)
_STEP_TEST = ("test.plants=2", "test.dt=0.1 s")
_STATED = (
    "conditions.flights=8",
    "conditions.stated.dt=0.1 s",
    "conditions.stated.duration=6 s",
    "conditions.stated.hold=1 s",
    "conditions.evolution={flights: 2, population: 2, generations: 1}",
)
_ONE_POLICY = (
    *_STATED,
    *_STEP_TEST,
    *_policy("policy"),
    "policies.policy.training.dt=0.1 s",
    "policies.policy.training.steady={flights: 2}",
)
_TORPEDO = (
    *_STATED,
    *_STEP_TEST,
    *_policy("learned"),
    "policies.learned.training.dt=0.1 s",
    "policies.learned.training.steady={flights: 2}",
    "turning_time=8 s",
    "test.duration=8 s",
    "test.bias_time=8 s",
    "~conditions.beyond",
    "~peers.pd",
    "~peers.lqr",
)
_SLOW = ("conditions.stated.duration=12 s", "test.duration=26 s", "test.bias_time=26 s")

_CONDITIONS = (
    *_STATED,
    "conditions.beyond={delay: {dt: 0.1 s, duration: 6 s, hold: 1 s, delay: [0.6 s, 0.6 s]}}",
    *_policy("learned"),
    *_policy("constants"),
    "policies.learned.training.dt=0.1 s",
    "policies.learned.training.steady={flights: 2}",
    "policies.constants.training.dt=0.1 s",
    "test.dt=0.1 s",
    "test.plants=2",
    "test.bias_time=20 s",
)

SHORT: dict[str, Short] = {
    "quickstart": Short((*_TRIALS, *_trained("mlp", "lstm"))),
    "wam_v_s1": Short((*_TRIALS, *_trained("mlp", "lstm"))),
    "wam_v_s2": Short((*_TRIALS, *_trained("mlp", "lstm"), "bands=null")),
    "wam_v_s3": Short((*_TRIALS, *_trained("mlp", "lstm"), "bands=null")),
    "wam_v_equations": Short((*_TRIALS, "bands=null")),
    "wam_v_trials": Short(_TRIALS),
    "sweep_quickstart": Short(
        (
            *_SWEPT,
            "space={heads.mlp.hidden: {choices: [[8], [16]]}}",
            "search.trials=2",
            "runner.workers=1",
        )
    ),
    "simulate_wam_v": Short(("~programme.families",)),
    "rudder_boat_trials": Short(_TRIALS),
    "patrol_identified": Short(_trained("mlp")),
    "patrol_roll": Short((*_TRIALS, "refit={}", "bands=null", *_trained("network"))),
    "remus_100": Short((*_DIVES, *_trained("mlp", "lstm"))),
    "bluerov2_heavy": Short((*_DIVES, *_trained("lstm"))),
    "kvlcc2": Short(
        (
            "prepare.grid={step: 0.5 s, held: [n, delta]}",
            "prepare.derivative={kind: savitzky_golay, window: 2.5 s, order: 2}",
            "refit.mmg={horizon: 20 s, every: 40 s, prior: 0, robust: 0.3, iterations: 2}",
            "booklet.draws=20",
            "bands=null",
        ),
        data="kvlcc2",
    ),
    "esso_osaka": Short(_TANKER, data="esso_osaka"),
    "esso_osaka_standard": Short(
        (
            "data.split={root: '${RESIDNET_DATA}/esso_osaka', train:"
            " [{log: 'zigzag/*13_04_24.csv', from: 0 s, to: 150 s},"
            " {log: 'zigzag/*13_14_21.csv', from: 0 s, to: 150 s}], validation:"
            " [{log: 'zigzag/*13_29_19.csv', from: 0 s, to: 150 s}], test:"
            " [{log: 'zigzag/*13_42_53.csv', from: 0 s, to: 150 s}]}",
            "evaluation.selection=T10",
            "evaluation.protocols={T10: {kind: windows, length: 10 s}}",
            "prepare.grid={step: 1 s, held: [n, delta]}",
            "prepare.derivative={kind: savitzky_golay, window: 5 s, order: 2}",
            "effort=0.01",
            "bands=null",
        ),
        data="esso_osaka",
    ),
    "esso_osaka_no_wind": Short(_TANKER, data="esso_osaka"),
    "milliampere_raw": Short(data="milliampere"),
    "autopilot_nomoto": Short((*_ONE_POLICY, *_predictor("document"))),
    "autopilot_nomoto_rate": Short(_ONE_POLICY),
    "autopilot_conditions": Short(
        (
            *_CONDITIONS,
            *_policy("network"),
            "policies.network.training.dt=0.1 s",
            "policies.network.training.steady={flights: 2}",
            *_predictor("document"),
        )
    ),
    "autopilot_conditions_rate": Short(_CONDITIONS),
    "autopilot_ship": Short(_CONDITIONS),
    "autopilot_remus": Short(_TORPEDO),
    "autopilot_remus_depth": Short(_TORPEDO),
    "autopilot_conditions_patrol": Short(
        (
            *_CONDITIONS,
            "conditions.stated.duration=12 s",
            "policies.learned.training.duration=12 s",
            "policies.constants.training.duration=12 s",
            "test.sea_time=10 s",
        )
    ),
    "autopilot_patrol": Short(
        (
            *_ONE_POLICY,
            *_predictor("document"),
            *_SLOW,
            "policies.policy.training.duration=12 s",
            "test.sea_time=10 s",
        )
    ),
    "autopilot_patrol_learned": Short(
        (
            *_STATED,
            *_STEP_TEST,
            *_SLOW,
            *_policy("on_vessel"),
            *_policy("on_model"),
            "policies.on_vessel.training.duration=12 s",
            "policies.on_model.training.duration=12 s",
            "policies.on_vessel.training.steady={flights: 2}",
            "policies.on_model.training.steady={flights: 2}",
            "policies.on_model.learned.run={runs}/patrol_identified",
        ),
        after="patrol_identified",
    ),
    "studies/esso_osaka/ablation": Short(
        (
            "variants={recipe: [], no_mirror: ['heads.mlp.mirror=false']}",
            "common=['baselines.physics={kind: regressors, terms: [u, v, r, n]}', 'refit={}',"
            " 'heads={mlp: {kind: mlp, hidden: [8]}}', 'base_of={mlp: hull}', 'ensembles={}',"
            " '~training.lstm', 'training.mlp.steps=1', 'training.mlp.multi_step=[{horizon: 2 s,"
            " epochs: 1, batch: 32}]']",
            "seeds=[0]",
            "workers=1",
        ),
        data="esso_osaka",
    ),
    "studies/gouletas2020/heading_nomoto": Short(
        (
            "predictive={mlp_printed: {horizon: 0.01 s, training: {states: 300, epochs: 5}},"
            " mlp_3s_linear: {horizon: 3 s, linear: true, training: {states: 300, epochs: 5}}}",
            *_STEP_TEST,
        )
    ),
    "studies/gouletas2020/heading_patrol": Short(
        (
            "predictive={mlp_10s: {horizon: 10 s, hidden: [30],"
            " training: {states: 300, epochs: 5}}}",
            "test.plants=2",
            "test.dt=0.25 s",
            "test.duration=30 s",
        )
    ),
    "studies/gouletas2020/table_6_3": Short(
        (
            "autopilot={runs}/autopilot_nomoto",
            "spread.flights=2",
            "protocols=[enter]",
            "dt=0.1 s",
            "line_of_sight=[{kind: lookahead, distance: 17 m}]",
        ),
        after="autopilot_nomoto",
    ),
    "studies/gouletas2020/table_6_8": Short(
        (
            "autopilot={runs}/autopilot_patrol",
            "protocols=[enter]",
            "duration=300 s",
            "line_of_sight=[{kind: lookahead, distance: 123 m}]",
        ),
        after="autopilot_patrol",
    ),
    "studies/halvorsen2019/force_equations": Short(
        ("heads.genetic.evolution={population: 30, generations: 2}",)
    ),
    "studies/halvorsen2019/jet_equations": Short(
        ("heads.genetic.evolution={population: 30, generations: 2}",)
    ),
    "studies/halvorsen2019/noise": Short(("repeats=1",)),
    "studies/halvorsen2019/table_5_2": Short(
        ("repeats=1", "rows.values=[2]", "columns.values=[5]", "~published", "~published_error")
    ),
    "studies/halvorsen2019/table_5_3": Short(
        ("repeats=1", "rows.values=[0.2]", "columns.values=[0.2]", "~published")
    ),
    "studies/halvorsen2019/table_5_3_small": Short(
        ("repeats=1", "rows.values=[0.2]", "columns.values=[0.2]", "~published")
    ),
    "studies/halvorsen2019/delay": Short(
        ("repeats=1", "rows.values=[none]", "columns.values=[0.0, 0.5]")
    ),
    "studies/halvorsen2019/standard_model": Short(
        (
            "~trials.planing",
            *(
                f"trials.{name}.programme={{drives: [0.35, 0.55, 0.7, 1.0], steers: [0.3],"
                " zigzag: 40 s, hold: 10 s, courses: [0.0]}"
                for name in ("standard", "calm")
            ),
        )
    ),
    "studies/jervan2020/azimuth": Short(_FERRY),
    "studies/jervan2020/case": Short(_FERRY),
    "studies/jervan2020/disturbance": Short(_FERRY),
    "studies/jervan2020/force_residual": Short(_FERRY),
    "studies/jervan2020/measured": Short(("validation.folds=2",), data="milliampere"),
    "studies/jervan2020/noise": Short(_FERRY),
    "studies/jervan2020/operation": Short(_FERRY),
    "studies/jervan2020/update": Short(_FERRY),
    "studies/jervan2020/zigzag": Short(),
    "studies/moreno2019/moreno2019": Short(
        (
            "heads.gptips.evolution.population=30",
            "heads.gptips.evolution.generations=2",
            *_COARSE[:2],
            "bands=null",
        ),
        data="esso_osaka",
    ),
    "studies/moreno2019/polynomial_wind": Short(("refit={}", *_COARSE), data="esso_osaka"),
    "studies/woo2018/outside_terms": Short(
        (
            "data.trials=[{kind: zigzag, count: 6, heading: [10 deg], steer: [0.15, 0.9],"
            " drive: [1.0, 1.0]}]",
            "data.identification={zigzag: 5}",
            "data.validation={zigzag: 1}",
            *_trained("mlp", "lstm"),
        )
    ),
    "studies/woo2018/thrusters": Short(),
    "studies/woo2018/woo2018": Short((*_TRIALS, *_trained("lstm_printed", "lstm_rate", "lstm"))),
}


def shipped() -> list[str]:
    """Return the names of all configs of runs: their paths below configs/, without suffix."""
    files = (path for path in CONFIGS.rglob("*.yaml") if path.parent.name != "vessels")
    return sorted(path.relative_to(CONFIGS).with_suffix("").as_posix() for path in files)


@dataclass(frozen=True)
class Result:
    """How the short run of a config ended.

    Attributes:
        name: of the config.
        state: `ok`, `skipped` or `FAILED`.
        seconds: that it took.
        words: why.
    """

    name: str
    state: str
    seconds: float
    words: str = ""

    def line(self) -> str:
        """Return a line for the log."""
        return f"{self.state:8s} {self.seconds:6.1f} s  {self.name}  {self.words}".rstrip()


def carry_out(name: str, runs: Path) -> Result:
    """Run one config in its short form, and look for its report and finished mark.

    The run is a fork of this process, which has the libraries loaded: ten seconds less each.
    """
    short = SHORT[name]
    if short.data and not (Path(os.environ.get("RESIDNET_DATA", "")) / short.data).is_dir():
        return Result(name, "skipped", 0.0, f"no RESIDNET_DATA/{short.data}")
    runs.mkdir(parents=True, exist_ok=True)
    folder = runs / name.replace("/", "_")
    command = ["residnet", "run", str(CONFIGS / f"{name}.yaml"), "--out", str(folder)]
    for override in short.overrides:
        command += ["-s", override.replace("{runs}", str(runs))]
    said = folder.with_suffix(".txt")
    started = time.monotonic()
    process = multiprocessing.get_context("fork").Process(target=_command, args=(command, said))
    process.start()
    process.join(LIMIT)
    seconds = time.monotonic() - started
    if process.is_alive():
        process.kill()
        return Result(name, "FAILED", seconds, f"not done after {LIMIT} s")
    if process.exitcode:
        last = (said.read_text().strip().splitlines() or [""])[-1]
        return Result(name, "FAILED", seconds, f"exit {process.exitcode}: {last}")
    summary = json.loads((folder / "summary.json").read_text())
    for wrong, words in (
        (not summary["finished"], "summary.json does not say finished"),
        (not summary["verdict"], "summary.json has no verdict"),
        (not (folder / "report.html").is_file(), "no report.html"),
    ):
        if wrong:
            return Result(name, "FAILED", seconds, words)
    return Result(name, "ok", seconds)


def _command(command: list[str], said: Path) -> None:
    """Carry out a command line in this process, its output in a file."""
    from residnet.__main__ import main

    with said.open("w") as stream:
        for output in (sys.stdout, sys.stderr):
            os.dup2(stream.fileno(), output.fileno())
        sys.argv = command
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
        sys.stdout.flush()
        sys.stderr.flush()
    # the threads of the parent, which a fork of one cannot join, are not waited for
    os._exit(code if isinstance(code, int) else 0)


def carry_out_all(names: list[str], runs: Path, jobs: int) -> list[Result]:
    """Run configs side by side; one that uses another's run waits for it."""
    results: dict[str, Future[Result]] = {}
    lock = threading.Lock()

    def run(name: str) -> Result:
        before = SHORT[name].after
        result = (
            Result(name, "FAILED", 0.0, f"{before} failed")
            if before and results[before].result().state == "FAILED"
            else carry_out(name, runs)
        )
        with lock:
            print(result.line(), flush=True)
        return result

    # what others wait for comes first, so that waiting never blocks all jobs
    wanted = {*names, *(SHORT[name].after for name in names if SHORT[name].after)}
    order = sorted(wanted, key=lambda name: (bool(SHORT[name].after), name))
    with ThreadPoolExecutor(jobs) as pool:
        for name in order:
            results[name] = pool.submit(run, name)
    return [result.result() for result in results.values()]


def main() -> int:
    """Run the named configs, or all; return how many failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="configs below configs/, without suffix")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--out", type=Path, help="folder for the runs; a temporary one otherwise")
    given = parser.parse_args()
    rowless = sorted(set(shipped()) - set(SHORT))
    stale = sorted(set(SHORT) - set(shipped()))
    for name in rowless:
        print(f"FAILED   configs/{name}.yaml has no row in {Path(__file__).name}")
    for name in stale:
        print(f"FAILED   the row '{name}' names no config")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import lightning  # noqa: F401  (every run that trains loads it; forks have it already)

    import residnet.tasks.registry  # noqa: F401

    started = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        runs = given.out or Path(temporary)
        results = carry_out_all(given.names or sorted(set(SHORT) - set(stale)), runs, given.jobs)
    failed = len(rowless) + len(stale) + sum(result.state == "FAILED" for result in results)
    skipped = sum(result.state == "skipped" for result in results)
    print(
        f"{len(results)} configs: {failed} failed, {skipped} skipped for want of data,"
        f" {time.monotonic() - started:.0f} s"
    )
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
