"""Steps of a fit, each from the results of the one before: prepared logs, baseline, heads,
evaluation.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from residnet.baselines import BaselineConfig, Coefficient, ParametricBaseline, StillConfig
from residnet.core.errors import DataError, FitError
from residnet.core.log import Log
from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.data.prepare import Prepared, envelope, prepare, samples
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import MeasuredLogs
from residnet.data.windows import WindowStore
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.heads import ClosedFormHead
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import Candidate, FreeRun, free_run
from residnet.judge.limits import limits
from residnet.judge.metrics import rows, window_errors
from residnet.judge.protocol import all_windows
from residnet.judge.rollout_files import write_rollouts
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.tasks.choosing import choose
from residnet.tasks.fit import FitConfig
from residnet.tasks.references import references
from residnet.training.config import TrainingConfig
from residnet.training.refit import refit

PreparedSplits = dict[str, list[Prepared]]


def say(text: str) -> None:
    """A line about the progress of a run, on standard error."""
    print(text, file=sys.stderr, flush=True)


def prepare_logs(splits: Mapping[str, Sequence[Log]], config: FitConfig) -> PreparedSplits:
    """Prepare every log.

    Raises:
        DataError: where a log has nothing to learn from or to predict.
    """
    out = {
        split: [prepare(log, split, config.signals.columns, config.prepare) for log in logs]
        for split, logs in splits.items()
    }
    for logs in out.values():
        for log in logs:
            require_length(log, config)
    return out


def require_length(log: Prepared, config: FitConfig) -> None:
    """Check that a log holds something to learn from and, unless it is for training, at least one
    window of a protocol.

    Raises:
        DataError: where it does not.
    """
    if not log.good.any():
        seconds = len(log) * config.prepare.grid.step
        raise DataError(
            f"log {log.log.name}: its {seconds:.1f} s hold no stretch as long as the derivative's"
            " window; leave it out or shorten prepare.derivative.window"
        )
    if log.split != "train":
        require_window(log, config)


def require_window(log: Prepared, config: FitConfig) -> None:
    """Check that a log holds at least one window of some protocol.

    Raises:
        DataError: where it does not.
    """
    step, protocols = config.prepare.grid.step, config.evaluation.protocols
    if not any(protocol.windows(log, 0, step) for protocol in protocols.values()):
        raise DataError(
            f"log {log.log.name}: its {len(log) * step:.1f} s are shorter than a window of every"
            f" protocol ({', '.join(protocols)}); leave it out or shorten evaluation.protocols"
        )


class Bench:
    """Free-run validation of a model during training and selection: the windows are laid out once.
    """

    def __init__(
        self, logs: Sequence[Prepared], config: EvaluationConfig, step: float, limit: np.ndarray
    ) -> None:
        self.logs = logs
        self.step = step
        self.limit = limit
        self.scales = config.scales.array()
        self.windows = all_windows(config.protocols[config.selection], logs, step, config.selection)

    def __call__(self, model: HybridDynamics) -> float:
        """Mean nrmse over u, v, r of the validation windows; a diverged window counts with the
        error of `zero`.
        """
        candidate = Candidate("validated", "head", model)
        predictions = free_run(
            [candidate], self.windows, self.logs, self.step, self.limit, dtype=torch.float32
        )
        errors = window_errors(FreeRun("", "", self.windows, predictions), "validated", self.logs)
        return float((errors["rmse"].mean(0) / self.scales).mean())


@dataclass(frozen=True)
class Fitted:
    """A model with what there is to say about its fit, and where free runs told it the covariance
    [P, P] of what its baseline may move.
    """

    spec: ModelSpec
    model: HybridDynamics
    notes: dict[str, Any]
    covariance: torch.Tensor | None = None


class Fitter:
    """Identifies the baseline, then fits heads on what it leaves, and keeps each model in the run
    folder as it is done.
    """

    def __init__(self, config: FitConfig, logs: PreparedSplits, folder: RunFolder) -> None:
        self.config = config
        self.folder = folder
        self.train = logs["train"]
        self.signals = config.signals.build()
        self.low, self.high = envelope(self.train)
        self.limit = config.evaluation.divergence * np.maximum(
            np.abs(self.low[:3]), np.abs(self.high[:3])
        )
        self.samples = samples(self.train, self.signals)
        self.bench = Bench(
            logs["validation"], config.evaluation, config.prepare.grid.step, self.limit
        )

    def spec(self, name: str, role: str, baseline: BaselineConfig) -> ModelSpec:
        """The description of a model of this run."""
        config = self.config
        return ModelSpec.model_validate(
            {
                "schema": "residnet.model/1",
                "name": name,
                "role": role,
                "signals": config.signals.resolved().model_dump(),
                "baseline": baseline.resolved().model_dump(),
                "head": config.heads[name].model_dump() if role == "head" else None,
                "dt": config.prepare.grid.step,
                "integrator": config.integrator,
                "hold": config.prepare.hold,
                "low": self.low.tolist(),
                "high": self.high.tolist(),
            }
        )

    def zero(self) -> Fitted:
        """The model that holds the velocities."""
        spec = self.spec("zero", "zero", StillConfig())
        return self._keep(Fitted(spec, spec.build(), {}))

    def baseline(self, name: str = "baseline") -> Fitted:
        """An identified baseline, refitted through rollouts where the config asks for it."""
        spec = self.spec(name, "baseline", self.config.baselines.get(name, self.config.baseline))
        model = spec.build()
        started = time.perf_counter()
        chosen, tried = choose(
            model, model.baseline, spec.baseline.solutions(model.baseline, self.samples), self.bench
        )
        table, covariance = list(chosen.table), None
        notes: dict[str, Any] = {
            "samples": len(self.samples),
            **chosen.choice,
            **tried,
            "least_squares": self.bench(model),
        }
        if name in self.config.refit:
            scales = torch.from_numpy(self.config.evaluation.scales.array())
            refitted = refit(
                model,
                self.samples,
                WindowStore.gather(self.train, torch.float64),
                self.config.refit[name],
                scales,
            )
            assert isinstance(model.baseline, ParametricBaseline)
            notes["refit"], covariance = refitted.notes, refitted.covariance
            if refitted.offsets.axes:
                notes["offsets"] = refitted.offsets.table([p.log.name for p in self.train])
            table = model.baseline.updated_table(table, refitted.errors)
        notes |= {"coefficients": [_row(entry) for entry in table], "validation": self.bench(model)}
        notes["seconds"] = round(time.perf_counter() - started, 1)
        return self._keep(Fitted(spec, model, notes, covariance))

    def head(self, name: str, baseline: HybridDynamics) -> Fitted:
        """One head on top of a baseline; taken from the run folder where it is finished there."""
        folder = self.folder.models / name
        if (folder / "model.json").is_file():
            spec, model = load_model(folder)
            return Fitted(spec, model, json.loads((folder / "fit.json").read_text()))
        below = self.config.base_of.get(name, "baseline")
        spec = self.spec(name, "head", self.config.baselines.get(below, self.config.baseline))
        # seeded by the head's own name, so that adding a head changes no other
        seed = self.config.seed * 1_000 + sum(map(ord, name))
        torch.manual_seed(seed)
        model = spec.build()
        model.baseline.load_state_dict(copy.deepcopy(baseline.baseline.state_dict()))
        residual = self.residual(model, self.samples)
        started = time.perf_counter()
        if isinstance(model.head, ClosedFormHead):
            model.head.calibrate(residual)
            try:
                chosen, tried = choose(
                    model, model.head, model.head.solutions(residual), self.bench
                )
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
            notes = chosen.choice | chosen.notes | tried
        else:
            notes = self._train(name, model, residual, seed)
        notes |= {
            "baseline": below,
            "seconds": round(time.perf_counter() - started, 1),
            "validation": self.bench(model),
        }
        return self._keep(Fitted(spec, model, notes))

    def ensemble(self, name: str, members: Sequence[Fitted]) -> Fitted:
        """The mean of fitted models."""
        spec = self.spec(name, "ensemble", StillConfig()).model_copy(
            update={"members": tuple(member.spec for member in members)}
        )
        model = mean_of([copy.deepcopy(member.model).to(torch.float64) for member in members])
        return self._keep(
            Fitted(
                spec,
                model,
                {
                    "members": [member.spec.name for member in members],
                    "validation": self.bench(model),
                },
            )
        )

    def residual(self, model: HybridDynamics, of: Samples) -> Samples:
        """Samples whose target is what a model's baseline leaves of the acceleration (document 003
        (19)) or the force (document 002 (3.20)).
        """
        with torch.no_grad():
            return model.head.residual_target(of, model.baseline(of.z))

    def _train(
        self, name: str, model: HybridDynamics, residual: Samples, seed: int
    ) -> dict[str, Any]:
        from residnet.training.trainer import train

        store = WindowStore.gather(self.train)
        scales = torch.from_numpy(self.config.evaluation.scales.array())
        settings = self.config.training.get(name, TrainingConfig())
        return train(
            name, model, residual, store, settings, scales, self.bench, seed, self.folder.path
        )

    def _keep(self, fitted: Fitted) -> Fitted:
        folder = self.folder.models / fitted.spec.name
        self.folder.write_json(folder / "fit.json", fitted.notes)
        save_model(folder, fitted.spec, fitted.model)
        return fitted


def write_residuals(
    file: Path, fitter: Fitter, fitted: Sequence[Fitted], logs: Sequence[Prepared], most: int = 1500
) -> None:
    """Residual targets of one split against what each head says along the measured states: columns
    model, axis, target, predicted.

    Every head runs teacher-forced over each log; at most `most` samples of each axis are kept,
    evenly spaced.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    parts: dict[str, list[np.ndarray]] = {"model": [], "axis": [], "target": [], "predicted": []}
    for f in fitted:
        if f.spec.role != "head":
            continue
        model = f.model.to(torch.float64)
        pairs = []
        for log in logs:
            with torch.no_grad():
                x, w = (
                    torch.from_numpy(np.nan_to_num(log.smooth))[None],
                    torch.from_numpy(np.nan_to_num(log.w))[None],
                )
                z = model.signals(x, model.signals.prepare(w))
                known = model.baseline(z)[0].numpy()
                said = model.one_step(z)[0].numpy() - known
            pairs.append(np.stack((log.nu_dot - known, said), axis=-1)[log.good])
        joined = np.concatenate(pairs)
        joined = joined[:: max(len(joined) // most, 1)]
        for axis, name in enumerate(ACCELERATION):
            parts["model"].append(np.full(len(joined), f.spec.name))
            parts["axis"].append(np.full(len(joined), name))
            parts["target"].append(joined[:, axis, 0])
            parts["predicted"].append(joined[:, axis, 1])
    if parts["model"]:
        pq.write_table(
            pa.table({name: pa.array(np.concatenate(values)) for name, values in parts.items()}),
            file,
        )


def _row(entry: Coefficient) -> dict[str, Any]:
    return {
        "axis": entry.axis,
        "term": entry.term,
        "value": entry.value,
        "standard_error": entry.error,
    }


def candidates(fitted: Sequence[Fitted], data: MeasuredLogs | SimulatedTrials) -> list[Candidate]:
    """Models to evaluate: all that were fitted, and where the data are simulated the plant that
    made them.
    """
    to = references(
        {f.spec.name: f.spec.role for f in fitted}, {f.spec.name: f.notes for f in fitted}
    )
    out = [
        Candidate(f.spec.name, f.spec.role, f.model, reference=to.get(f.spec.name)) for f in fitted
    ]
    if isinstance(data, SimulatedTrials):
        plant = load_vessel(data.vessel).build()
        if any(name.startswith("_") for name in plant.state):
            # no log shows what is under way in a delay line, so that the plant could not start from
            # one
            return out
        known = plant.inputs[: plant.commands]
        model = PlantDynamics(plant, data.step, data.substeps)
        out.append(
            Candidate(
                "truth",
                "truth",
                model,
                plant.state,
                known,
                len(plant.inputs) - len(known),
                "baseline",
            )
        )
    return out


def evaluate(
    models: Sequence[Candidate],
    logs: Sequence[Prepared],
    config: EvaluationConfig,
    step: float,
    limit: np.ndarray,
    folder: RunFolder,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Free-run all models over all protocols of one split; writes the rollouts, returns the rows of
    metrics.json and, by protocol, of limits.json.
    """
    table: list[dict[str, Any]] = []
    limiting: dict[str, Any] = {}
    runs: list[FreeRun] = []
    split = logs[0].split
    for name, protocol in config.protocols.items():
        windows = [
            window
            for number, log in enumerate(logs)
            for window in protocol.windows(log, number, step)
        ]
        if not windows:
            continue
        run = FreeRun(name, split, windows, free_run(models, windows, logs, step, limit))
        runs.append(run)
        scales = {key: float(value) for key, value in config.scales.model_dump().items()}
        table += rows(run, models, logs, scales, config.groups)
        limiting[name] = limits(run, models, logs, scales, step)
    write_rollouts(folder.rollouts / split, runs, logs)
    return table, limiting
