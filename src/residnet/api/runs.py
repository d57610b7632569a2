"""Free runs along logs: tables of measured and predicted motion, errors, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from residnet.api.data import Data
from residnet.api.models import Model, require_model
from residnet.api.values import described, hearing
from residnet.core.errors import UsageError
from residnet.core.names import STATE, nearest
from residnet.core.progress import ProgressCallback
from residnet.data.prepare import Prepared
from residnet.identification.identified import Evaluation, candidates, evaluate
from residnet.identification.prepared import velocity_limit
from residnet.judge.metrics import metrics_table

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from residnet.report.figure import Figure as Drawing


_ORDER = ("u", "v", "r", "psi", "x", "y")


@final
class FreeRuns:
    """Models run freely along logs: every window of every protocol, measured beside predicted.

    Example:
        runs.plot_track("zigzag_01").savefig("track.png")
    """

    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation = evaluation

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Errors as rows of metrics.json."""
        return self.evaluation.rows

    @property
    def metrics(self) -> pd.DataFrame:
        """Errors as a table, see `residnet.metrics`."""
        return metrics_table(self.evaluation.rows)

    @property
    def logs(self) -> list[str]:
        """Names of the logs."""
        return [log.log.name for log in self.evaluation.logs]

    @property
    def protocols(self) -> list[str]:
        """Names of the protocols that have a window."""
        return [run.protocol for run in self.evaluation.runs]

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row for each log, protocol, model, window and time step.

        Columns log, protocol, model, window, t (s, the log's clock), usable, diverged, then u, v
        (m/s), r (rad/s), psi (rad), x, y (m) as measured, and with `_hat` as predicted.
        """
        import pandas as pd

        parts = []
        for run in self.evaluation.runs:
            for number, log in enumerate(self.evaluation.logs):
                of_log = [i for i, window in enumerate(run.windows) if window.log == number]
                for model, predictions in run.predictions.items():
                    for place, i in enumerate(of_log):
                        window = run.windows[i]
                        labels = {
                            "log": log.log.name,
                            "protocol": run.protocol,
                            "model": model,
                            "window": place,
                            "diverged": predictions[i].diverged,
                        }
                        rows = slice(window.start, window.stop)
                        parts.append(_columns(log, rows, predictions[i].states, labels))
        return pd.concat(parts, ignore_index=True)

    def plot_track(
        self,
        log: str | None = None,
        *,
        models: Sequence[str] = (),
        protocol: str | None = None,
        window: int | None = None,
    ) -> Figure:
        """Draw the measured track and those of models; north up, equal scales.

        Args:
            log: name of the log; the first where None.
            models: their names; all but `zero` where empty.
            protocol: `manoeuvre` where None and there is such a one, else the first.
            window: number of the window in the log; the longest where None.

        Raises:
            UsageError: where there is no such log, model, protocol or window.
        """
        from residnet.report.still import still

        figure: Figure = still(self._drawn(log, models, protocol, window), only=[0])
        return figure

    def plot_history(
        self,
        log: str | None = None,
        *,
        models: Sequence[str] = (),
        protocol: str | None = None,
        window: int | None = None,
    ) -> Figure:
        """Draw velocities and heading against time, measured and predicted.

        Args:
            log: name of the log; the first where None.
            models: their names; all but `zero` where empty.
            protocol: `manoeuvre` where None and there is such a one, else the first.
            window: number of the window in the log; the longest where None.

        Raises:
            UsageError: where there is no such log, model, protocol or window.
        """
        from residnet.report.still import still

        figure: Figure = still(self._drawn(log, models, protocol, window), only=[1, 2, 3, 4])
        return figure

    def _drawn(
        self, log: str | None, models: Sequence[str], protocol: str | None, window: int | None
    ) -> Drawing:
        from residnet.report.run_reader import StoredWindow
        from residnet.report.sections.runs import window_figure

        usual = "manoeuvre" if "manoeuvre" in self.protocols else self.protocols[0]
        kind = _named(protocol or usual, self.protocols, "protocol")
        run = self.evaluation.runs[self.protocols.index(kind)]
        name = _named(log or self.logs[run.windows[0].log], self.logs, "log")
        prepared = self.evaluation.logs[self.logs.index(name)]
        of_log = [i for i, w in enumerate(run.windows) if w.log == self.logs.index(name)]
        if not of_log:
            raise UsageError(f"log {name} has no window of the protocol {kind}")
        longest = max(
            range(len(of_log)),
            key=lambda i: run.windows[of_log[i]].stop - run.windows[of_log[i]].start,
        )
        place = longest if window is None else window
        if not 0 <= place < len(of_log):
            raise UsageError(f"log {name} has {len(of_log)} windows of {kind}, no number {place}")
        drawn = run.windows[of_log[place]]
        rows = slice(drawn.start, drawn.stop)
        given = [models] if isinstance(models, str) else models
        shown = [_named(model, run.predictions, "model") for model in given]
        order = [STATE.index(channel) for channel in _ORDER]
        stored = StoredWindow(
            log=name,
            manoeuvre=prepared.log.manoeuvre,
            protocol=kind,
            number=place,
            t=prepared.log.t[rows],
            usable=prepared.usable[rows],
            measured=prepared.y[rows][:, order],
            predicted={
                model: run.predictions[model][of_log[place]].states[:, order]
                for model in shown or [m for m in run.predictions if m != "zero"]
            },
            diverged={},
        )
        return window_figure(stored, f"{name}, {kind}")


def _named(name: Any, known: Any, what: str) -> str:
    if name not in known:
        raise UsageError(f"no {what} '{name}'{nearest(str(name), known)}")
    return str(name)


def _columns(
    log: Prepared, rows: slice, predicted: np.ndarray, labels: Mapping[str, Any]
) -> pd.DataFrame:
    import pandas as pd

    measured = log.y[rows]
    columns = {**labels, "t": log.log.t[rows], "usable": log.usable[rows]}
    columns |= {name: measured[:, STATE.index(name)] for name in _ORDER}
    columns |= {f"{name}_hat": predicted[:, STATE.index(name)] for name in _ORDER}
    return pd.DataFrame(columns)


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
    if not isinstance(data, Data):
        raise UsageError(f"free_run: expected data from residnet.prepare, given {described(data)}")
    found = _models(models)
    for model in found:
        _require_fit(model, data)
    chosen = split or ("test" if "test" in data.splits else next(iter(data.splits)))
    spec = found[0].spec
    limit = velocity_limit(np.array(spec.low), np.array(spec.high), data.evaluation.divergence)
    with hearing(progress):
        judged = candidates([model.fitted for model in found], data.source)
        return FreeRuns(evaluate(judged, data.logs(chosen), data.evaluation, spec.dt, limit))


def _models(models: Any) -> list[Model]:
    if isinstance(models, Model):
        return [models]
    fitted = list(models.values()) if isinstance(models, Mapping) else models
    if not isinstance(fitted, list | tuple) or not fitted:
        raise UsageError(f"free_run: expected one or several models, given {described(models)}")
    for model in fitted:
        require_model(model, "free_run")
    return list(fitted)


def _require_fit(model: Model, data: Data) -> None:
    if model.inputs != data.signals.columns:
        raise UsageError(
            f"free_run: model {model.name} has the inputs {', '.join(model.inputs)}, the data have"
            f" {', '.join(data.signals.columns)}; prepare them with the model's inputs"
        )
    if abs(model.dt - data.prepare.grid.step) > 1e-9:
        raise UsageError(
            f"free_run: model {model.name} steps by {model.dt:g} s, the data by"
            f" {data.prepare.grid.step:g} s; prepare them with step={model.dt:g}"
        )
