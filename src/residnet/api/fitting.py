"""The fit in Python: baselines, heads and ensembles by name, judged in free run along logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, final

import numpy as np

from residnet.api.data import Data, LogsGiven, prepare
from residnet.api.models import Model, require
from residnet.api.values import PartGiven, described, hearing, named_parts, part, plain
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.processes import spread
from residnet.core.progress import ProgressCallback
from residnet.core.trust import trusting
from residnet.identification.fit import fit as identify
from residnet.identification.identified import Evaluation, Identified, candidates, evaluate
from residnet.identification.prepared import require_window, through_currents, velocity_limit
from residnet.identification.recipe import integrator
from residnet.identification.settings import FitSettings, Parts
from residnet.judge.metrics import metrics_table, rollout_columns
from residnet.judge.selection import Selection
from residnet.judge.verdict import Evidence, by_windows, verdict
from residnet.report.run_reader import StoredWindow, windows_of
from residnet.runs.task import computing

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@final
class FreeRuns:
    """Models run freely along logs: every window of every protocol, measured beside predicted.

    Attributes:
        rows: errors as rows of metrics.json.
        logs: names of the logs.
        protocols: names of the protocols that have a window.

    Example:
        runs.plot_track("zigzag_01").savefig("track.png")
    """

    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation = evaluation
        self.rows: list[dict[str, Any]] = evaluation.rows
        self.logs = [log.log.name for log in evaluation.logs]
        self.protocols = [run.protocol for run in evaluation.runs]

    @property
    def metrics(self) -> pd.DataFrame:
        """Errors as a table, see `residnet.metrics`."""
        return metrics_table(self.rows)

    @cached_property
    def windows(self) -> list[StoredWindow]:
        """Every window, as `residnet.report.run_reader.RunFiles` reads them of a run."""
        logs, tables = self.evaluation.logs, self.table.groupby("log", sort=False)
        kinds = {log.log.name: log.log.manoeuvre for log in logs}
        return [
            window
            for name, table in tables
            for window in windows_of(table, str(name), kinds[str(name)], logs[0].live)
        ]

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row for each log, protocol, model, window and time step.

        Columns log, protocol, model, window, t (s, the log's clock), usable, diverged, then u, v
        (m/s), r (rad/s), psi (rad), x, y (m) as measured, and with `_hat` as predicted.
        """
        import pandas as pd

        found = rollout_columns(self.evaluation.runs, self.evaluation.logs)
        parts = [pd.DataFrame({"log": log.log.name, **columns}) for log, columns in found]
        return pd.concat(parts, ignore_index=True)

    def plot_track(self, log: str | None = None, **chosen: Any) -> Figure:
        """Draw the measured track and those of models; north up, equal scales.

        Args:
            log: name of the log; the first where None.
            chosen: `models`, their names, all but `zero` where there are none; `protocol`,
                `manoeuvre` where there is such a one, else the first; `window`, number of the
                window in the log, the longest where None.

        Raises:
            UsageError: where there is no such log, model, protocol or window.
        """
        return self._drawn(log, True, **chosen)

    def plot_history(self, log: str | None = None, **chosen: Any) -> Figure:
        """Draw velocities and heading against time, measured and predicted.

        Args:
            log: name of the log; the first where None.
            chosen: as of `plot_track`.

        Raises:
            UsageError: where there is no such log, model, protocol or window.
        """
        return self._drawn(log, False, **chosen)

    def _drawn(
        self,
        log: str | None,
        mapped: bool,
        models: str | Sequence[str] = (),
        protocol: str | None = None,
        window: int | None = None,
    ) -> Figure:
        from residnet.report.sections.runs import window_figure
        from residnet.report.still import still

        usual = "manoeuvre" if "manoeuvre" in self.protocols else self.protocols[0]
        kind = _named(protocol or usual, self.protocols, "protocol")
        found = [one for one in self.windows if one.protocol == kind]
        name = _named(log or found[0].log, self.logs, "log")
        found = [one for one in found if one.log == name]
        if not found:
            raise UsageError(f"log {name} has no window of the protocol {kind}")
        if window is not None and not 0 <= window < len(found):
            raise UsageError(f"log {name} has {len(found)} windows of {kind}, no number {window}")
        one = max(found, key=lambda one: len(one.t)) if window is None else found[window]
        given = [models] if isinstance(models, str) else models
        shown = [_named(model, one.predicted, "model") for model in given]
        shown = shown or [model for model in one.predicted if model != "zero"]
        predicted = {model: one.predicted[model] for model in shown}
        one = replace(one, predicted=predicted, diverged={})
        drawn = window_figure(one, f"{name}, {kind}")
        panels = [i for i, panel in enumerate(drawn.panels) if (panel.kind == "map") == mapped]
        if not panels:
            raise UsageError(f"log {name} has no track: {one.live.text}; draw its history")
        figure: Figure = still(drawn, only=panels)
        return figure


def _named(name: Any, known: Any, what: str) -> str:
    if name not in known:
        raise UsageError(f"no {what} '{name}'{nearest(str(name), known)}")
    return str(name)


def free_run(
    models: Model | Sequence[Model] | Mapping[str, Model],
    data: Data,
    split: str | None = None,
    *,
    progress: ProgressCallback | None = None,
) -> FreeRuns:
    """Run models freely along logs: from a measured state on, with the inputs alone.

    A window whose prediction is not finite, or leaves the training envelope by far, has diverged
    and counts with the prediction that holds the initial velocities.

    Args:
        models: from `fit` or `load`; one or several.
        data: from `prepare`.
        split: of the data; `test` where there is one, else the first.
        progress: is told how far the free runs are.

    Raises:
        UsageError: where the data have no such split, or a model has other inputs or another step.

    Example:
        runs = residnet.free_run(models, data); runs.metrics
    """
    require(data, Data, "free_run: expected data from residnet.prepare")
    found: Any = [models] if isinstance(models, Model) else models
    found = list(found.values()) if isinstance(found, Mapping) else found
    if not isinstance(found, list | tuple) or not found:
        raise UsageError(f"free_run: expected one or several models, given {described(models)}")
    step = data.prepare.grid.step
    for model in found:
        require(model, Model, "free_run: expected a model")
        if model.inputs != data.signals.columns:
            raise UsageError(
                f"free_run: model {model.name} has the inputs {', '.join(model.inputs)}, the data"
                f" have {', '.join(data.signals.columns)}; prepare them with the model's inputs"
            )
        if abs(model.dt - step) > 1e-9:
            raise UsageError(
                f"free_run: model {model.name} steps by {model.dt:g} s, the data by {step:g} s;"
                f" prepare them with step={model.dt:g}"
            )
    split = split or ("test" if "test" in data.splits else next(iter(data.splits)))
    spec, divergence = found[0].spec, data.evaluation.divergence
    limit = velocity_limit(np.array(spec.low), np.array(spec.high), divergence, spec.signals.live)
    with hearing(progress):
        judged = evaluate(
            candidates([model.fitted for model in found], data.source),
            {split: data.logs(split)},
            data.evaluation,
            step,
            limit,
        )
        return FreeRuns(judged[split])


@final
class Models(dict[str, Model]):
    """Fitted models by name: zero, the baselines, heads and ensembles, in this order.

    Attributes:
        identified: what the fit made.
        data: what they were fitted on and are judged on.
        settings: of the fit, as YAML would have them.

    Example:
        models["lstm"].step(x, w)
    """

    def __init__(self, identified: Identified, data: Data) -> None:
        super().__init__({name: Model(fitted) for name, fitted in identified.items()})
        self.identified, self.data = identified, data
        self.settings: FitSettings = identified.settings

    @cached_property
    def runs(self) -> dict[str, FreeRuns]:
        """Free runs of all models by split."""
        splits = self.settings.evaluation.splits
        return {split: free_run(self, self.data, split) for split in splits}

    @cached_property
    def selection(self) -> Selection:
        """Which single model and which ensemble the validation logs choose, and why."""
        return self.identified.select({name: runs.evaluation for name, runs in self.runs.items()})

    @property
    def selected(self) -> str:
        """Name of the single model: the recipe's hull, else the simplest that is alike the best."""
        return self.selection.selected

    @property
    def predictor(self) -> str:
        """Name of the model that is reported first: the recipe's mean, else the selected one."""
        return self.selection.predictor

    @property
    def verdict(self) -> list[str]:
        """The verdict on the predictor in whole sentences, the most important first."""
        return verdict(self.evidence)

    @cached_property
    def evidence(self) -> Evidence:
        """What the verdict is passed on.

        It is of the test logs where they are judged, else of the validation logs.
        """
        split = "test" if "test" in self.runs else "validation"
        judged = self.runs[split].evaluation
        protocol = by_windows(judged.rows, split, self.settings.evaluation.selection)[0]
        whole = {
            row["model"]: row
            for row in judged.rows
            if (row["protocol"], row["manoeuvre"]) == (protocol, "all")
        }
        return Evidence(
            self.predictor,
            split,
            whole,
            "baseline",
            self.selection.content(),
            judged.limits,
            protocol=protocol,
        )

    @property
    def metrics(self) -> pd.DataFrame:
        """Free-run errors of all models over all splits, see `residnet.metrics`."""
        return self._table([row for runs in self.runs.values() for row in runs.rows])

    def _table(self, rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
        return metrics_table([{**r, "selected": r["model"] == self.selected} for r in rows])

    def __missing__(self, name: str) -> Model:
        return self[_named(name, self, "model")]

    def __repr__(self) -> str:
        return f"Models({', '.join(self)})"


def fit(
    data: Data | LogsGiven,
    baseline: PartGiven | None = None,
    heads: PartGiven | Sequence[str] | Mapping[str, PartGiven] = (),
    *,
    baselines: Mapping[str, PartGiven] | None = None,
    threads: int = 1,
    workers: int = 1,
    trust: bool = False,
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Models:
    """Fit baselines, then heads on what each leaves, then ensembles.

    The arguments are the keys of a config of the task `fit`, and give the same numbers. Without a
    baseline, heads or other parts the standard recipe fits its portfolio of models.

    Args:
        data: from `prepare`; or logs, whose inputs, split, step, protocols and scales then follow
            from what they hold.
        baseline: the known part: its kind, a mapping or a config object. `regressors` alone is a
            line in every channel, and is taken where there are heads but no baseline.
        heads: what is learned on top: kinds such as `["plsr", "lstm"]`, or a mapping from names to
            kinds, mappings or config objects.
        baselines: further baselines by name.
        threads: of PyTorch; one is fastest for these small products, and part of what makes a fit
            repeatable.
        workers: models that may be fitted side by side, each in a process of its own, where they
            take long; the numbers stay the same. With more than one, a script has to keep its calls
            under `if __name__ == "__main__":`, since each process imports it again.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        progress: is told what is being fitted, and how far it is.
        settings: further keys of a fit, as YAML has them: recipe, effort, base_of, forces,
            ensembles, means, training, refit, current, bands, seed, and integrator, which is
            that of `residnet new` for the recipe where it is not given.

    Raises:
        ConfigError: where a setting is wrong.
        FitError: where the data do not determine a part.
        DataError: where a split holds no sample or no window.

    Example:
        models = residnet.fit(logs); models.selected, models.metrics
    """
    with trusting(trust):
        given = {
            key: value
            for key, value in settings.items()
            if (value or key not in Parts.model_fields) and (key, value) != ("integrator", None)
        }
        given |= {"baselines": named_parts(baselines, "baseline")} if baselines else {}
        if not (isinstance(heads, list | tuple | Mapping) and not heads):
            given["heads"] = named_parts(heads, "head")
        if baseline is not None:
            given["baseline"] = part(baseline, "baseline")
        if given.get("recipe") is None and not set(given) & set(Parts.model_fields):
            given["recipe"] = "standard"
        if given.get("recipe") is None:
            given.setdefault("baseline", part("regressors", "baseline"))
        if not isinstance(data, Data):
            logs = (str, PathLike, Log, list, tuple, Mapping)
            require(data, logs, "fit: expected logs, or data from residnet.prepare")
            data = prepare(data)
        if given.get("recipe") is not None:
            given.setdefault("integrator", integrator(data.signals.live))
        sections = {"prepare": data.prepare, "signals": data.signals, "evaluation": data.evaluation}
        config: FitSettings = validate(plain({**sections, **given}), FitSettings, "fit")
        with computing(threads), hearing(progress), spread(workers):
            for split in ("validation", "test"):
                for log in data.logs(split):
                    require_window(log, config)
            splits, _ = through_currents(data.splits, config)
            return Models(identify(splits, config), replace(data, splits=splits))


def metrics(
    models: Models,
    data: Data | None = None,
    *,
    split: str | None = None,
    manoeuvre: str | None = "all",
    progress: ProgressCallback | None = None,
) -> pd.DataFrame:
    """Return the free-run errors of models, one row for each model, split and protocol.

    Args:
        models: from `fit`.
        data: other logs, from `prepare(logs, like=data)`; those of the fit where None.
        split: train, validation, test or external; all where None.
        manoeuvre: a kind of manoeuvre or a group; `all` for all together, None for a row of each.
        progress: is told how far the free runs are.

    Returns:
        Columns model, kind, split, protocol, manoeuvre, selected, windows, diverged, n, rmse_u,
        rmse_v (m/s), rmse_r (rad/s), the same for mae and nrmse, nrmse_mean, note (such as "2/12
        diverged"), position_error_end (m), heading_error_end (rad).

    Raises:
        UsageError: where there is no such split or manoeuvre.

    Example:
        residnet.metrics(models, split="test")
    """
    require(models, Models, "metrics: expected models from residnet.fit")
    with hearing(progress):
        rows = None if data is None else free_run(models, data, split).rows
        table = models.metrics if rows is None else models._table(rows)
    for column, wanted in (("split", split), ("manoeuvre", manoeuvre)):
        if wanted is not None:
            if wanted not in set(table[column]):
                known = nearest(str(wanted), map(str, table[column].unique()))
                raise UsageError(f"metrics: no {column} '{wanted}'{known}")
            table = table[table[column] == wanted]
    return table.reset_index(drop=True)


def select(models: Models) -> Model:
    """Return the recipe's hull, else the simplest sound model that is alike the best.

    Free runs over the validation logs decide; `models.selection.reason` says why.

    Example:
        residnet.select(models).name
    """
    require(models, Models, "select: expected models from residnet.fit")
    return models[models.selected]
