"""Fit baselines, heads (residual models) and ensembles by name, evaluated in free run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, final

import numpy as np

from residnet.api.data import Dataset, LogsLike, prepare
from residnet.api.models import Model, require_instance
from residnet.api.values import (
    PartLike,
    describe_type,
    forward_progress,
    parse_named_parts,
    parse_part,
    to_builtin,
)
from residnet.baselines import BaselineConfig
from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import suggest_name
from residnet.core.processes import worker_limit
from residnet.core.progress import ProgressCallback
from residnet.core.trust import trusting
from residnet.evaluation.data_records import ExcitationFile
from residnet.evaluation.metrics_file import build_metrics_table, mark_selected
from residnet.evaluation.protocol import WindowProtocol
from residnet.evaluation.records import MetricsRow
from residnet.evaluation.rollout_tables import iterate_rollout_columns
from residnet.evaluation.selection import Selection
from residnet.evaluation.verdict import VerdictEvidence, order_protocols, write_verdict
from residnet.heads import HeadConfig
from residnet.identification.excitation import assess_excitation
from residnet.identification.fit import fit_models as identify
from residnet.identification.identified import (
    IdentifiedModels,
    SplitEvaluation,
    evaluate_splits,
    make_candidates,
)
from residnet.identification.prepared import (
    check_window_fits,
    compute_velocity_limits,
    convert_to_motion_through_water,
)
from residnet.identification.recipe import choose_integrator
from residnet.identification.settings import FitSettings, ModelPartsConfig
from residnet.report.run_reader import StoredWindow, read_windows
from residnet.runs.task import torch_threads

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from residnet.training.current_config import CurrentConfig
    from residnet.training.records import CurrentRow
    from residnet.training.trainer import Callback, Logger


@final
class FreeRuns:
    """Free runs of models along logs: measured and predicted states of every window.

    Attributes:
        rows: errors as rows of metrics.json.
        logs: names of the logs.
        protocols: names of the protocols with at least one window.

    Example:
        runs.plot_track("zigzag_01").savefig("track.png")
    """

    def __init__(self, evaluation: SplitEvaluation) -> None:
        self.evaluation = evaluation
        self.rows: Sequence[MetricsRow] = evaluation.rows
        self.logs = [log.log.name for log in evaluation.logs]
        self.protocols = [run.protocol for run in evaluation.free_runs]

    @property
    def metrics(self) -> pd.DataFrame:
        """The errors as a table, see `residnet.metrics`."""
        return build_metrics_table(self.rows)

    @cached_property
    def windows(self) -> list[StoredWindow]:
        """All windows, in the form that `RunFiles` reads from a run folder."""
        logs = self.evaluation.logs
        tables = self.table.groupby("log", sort=False)
        kinds = {log.log.name: log.log.manoeuvre for log in logs}
        return [
            window
            for name, table in tables
            for window in read_windows(table, str(name), kinds[str(name)], logs[0].dof)
        ]

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row for each log, protocol, model, window and time step.

        Columns: log, protocol, model, window, t (s, clock of the log), usable, diverged; measured
        states u, v (m/s), r (rad/s), psi (rad), x, y (m); predicted ones with the suffix `_hat`.
        """
        import pandas as pd

        columns_of_logs = iterate_rollout_columns(self.evaluation.free_runs, self.evaluation.logs)
        tables = [
            pd.DataFrame({"log": log.log.name, **columns}) for log, columns in columns_of_logs
        ]
        return pd.concat(tables, ignore_index=True)

    def plot_track(
        self,
        log: str | None = None,
        *,
        ax: Axes | None = None,
        width: float | None = None,
        **selection: Any,
    ) -> Figure:
        """Plot the measured and predicted tracks; north up, equal scales.

        Args:
            log: name of the log; None for the first.
            ax: matplotlib axes to draw on, in the caller's style and without a legend; None for a
                new figure.
            width: width of a new figure in inches; None for the text width of an A4 page.
            selection: `models`, names of models, by default all but `constant_velocity`;
                `protocol`, by default `manoeuvre` if it exists, else the first; `window`, number of
                the window in the log, by default the longest.

        Raises:
            UsageError: if there is no such log, model, protocol or window.
        """
        axes = None if ax is None else [ax]
        return self._plot(log, True, axes, width, **selection)

    def plot_history(
        self,
        log: str | None = None,
        *,
        ax: Sequence[Axes] | None = None,
        width: float | None = None,
        **selection: Any,
    ) -> Figure:
        """Plot measured and predicted velocities and heading against time.

        Args:
            log: name of the log; None for the first.
            ax: matplotlib axes to draw on, one for each quantity, in the caller's style and without
                a legend; None for a new figure.
            width: width of a new figure in inches; None for the text width of an A4 page.
            selection: see `plot_track`.

        Raises:
            UsageError: if there is no such log, model, protocol or window, or if the number of axes
                differs from the number of quantities.
        """
        axes = None if ax is None else list(np.ravel(np.asarray(ax, dtype=object)))
        return self._plot(log, False, axes, width, **selection)

    def _plot(
        self,
        log: str | None,
        is_track: bool,
        axes: Sequence[Axes] | None,
        width: float | None,
        models: str | Sequence[str] = (),
        protocol: str | None = None,
        window: int | None = None,
    ) -> Figure:
        """Return a figure of one window: its track, or its velocities over time."""
        from residnet.report.sections.runs import plot_window
        from residnet.report.still import FIGURE_WIDTH, draw_on_axes, render_matplotlib

        default_protocol = "manoeuvre" if "manoeuvre" in self.protocols else self.protocols[0]
        protocol_name = _require_known(protocol or default_protocol, self.protocols, "protocol")
        windows_of_log = [
            stored_window
            for stored_window in self.windows
            if stored_window.protocol == protocol_name
        ]
        log_name = _require_known(log or windows_of_log[0].log, self.logs, "log")
        windows_of_log = [
            stored_window for stored_window in windows_of_log if stored_window.log == log_name
        ]
        if not windows_of_log:
            raise UsageError(f"log {log_name} has no window of the protocol {protocol_name}")
        if window is not None and not 0 <= window < len(windows_of_log):
            raise UsageError(
                f"log {log_name} has {len(windows_of_log)} windows of {protocol_name}, no number"
                f" {window}"
            )
        stored_window = (
            max(windows_of_log, key=lambda candidate: len(candidate.t))
            if window is None
            else windows_of_log[window]
        )
        requested_models = [models] if isinstance(models, str) else models
        model_names = [
            _require_known(model, stored_window.predicted, "model") for model in requested_models
        ]
        model_names = model_names or [
            model for model in stored_window.predicted if model != CONSTANT_VELOCITY
        ]
        predicted = {model: stored_window.predicted[model] for model in model_names}
        stored_window = replace(stored_window, predicted=predicted, diverged={})
        window_plot = plot_window(stored_window, f"{log_name}, {protocol_name}")
        panels = [
            i for i, panel in enumerate(window_plot.panels) if (panel.kind == "map") == is_track
        ]
        if not panels:
            raise UsageError(
                f"log {log_name} has no track: {stored_window.dof.description}; draw its history"
            )
        if axes is not None:
            quantities = [window_plot.panels[i].y_label or "track" for i in panels]
            if len(axes) != len(panels):
                raise UsageError(
                    f"ax: expected {len(panels)} axes, one each for {', '.join(quantities)}; got"
                    f" {len(axes)}"
                )
            draw_on_axes(window_plot, axes, panels)
            return axes[0].figure  # type: ignore[return-value]
        figure: Figure = render_matplotlib(
            window_plot, panel_numbers=panels, width=FIGURE_WIDTH if width is None else width
        )
        return figure


def _require_known(name: Any, valid_names: Any, description: str) -> str:
    if name not in valid_names:
        raise UsageError(f"no {description} '{name}'{suggest_name(str(name), valid_names)}")
    return str(name)


def free_run(
    models: Model | Sequence[Model] | Mapping[str, Model],
    data: Dataset,
    split: str | None = None,
    *,
    progress: ProgressCallback | None = None,
) -> FreeRuns:
    """Predict logs in free run: from a measured state on, with the measured inputs only.

    A prediction that is not finite, or far outside of the training envelope, has diverged. Its
    errors are replaced by those of the constant-velocity prediction.

    Args:
        models: model or models from `fit` or `load`.
        data: dataset from `prepare`.
        split: split of the data; None for `test` if it exists, else the first.
        progress: called with the progress of the free runs.

    Raises:
        UsageError: if the data have no such split, or a model has other inputs or another step.

    Example:
        runs = residnet.free_run(models, data); runs.metrics
    """
    require_instance(data, Dataset, "free_run: expected data from residnet.prepare")
    model_list: Any = [models] if isinstance(models, Model) else models
    model_list = list(model_list.values()) if isinstance(model_list, Mapping) else model_list
    if not isinstance(model_list, list | tuple) or not model_list:
        raise UsageError(f"free_run: expected one or several models, given {describe_type(models)}")
    step = data.prepare.grid.step
    for model in model_list:
        require_instance(model, Model, "free_run: expected a model")
        if model.inputs != data.signals.input_columns:
            raise UsageError(
                f"free_run: model {model.name} has the inputs {', '.join(model.inputs)}, the data"
                f" have {', '.join(data.signals.input_columns)}; prepare them with the model's"
                f" inputs"
            )
        if abs(model.dt - step) > 1e-9:
            raise UsageError(
                f"free_run: model {model.name} steps by {model.dt:g} s, the data by {step:g} s;"
                f" prepare them with step={model.dt:g}"
            )
    split = split or ("test" if "test" in data.splits else next(iter(data.splits)))
    spec = model_list[0].spec
    divergence = data.evaluation.divergence
    velocity_bounds = compute_velocity_limits(
        np.array(spec.low), np.array(spec.high), divergence, spec.signals.dof
    )
    with forward_progress(progress):
        evaluations = evaluate_splits(
            make_candidates([model.fitted_model for model in model_list], data.source),
            {split: data.logs(split)},
            data.evaluation,
            step,
            velocity_bounds,
        )
        return FreeRuns(evaluations[split])


@final
class Models(dict[str, Model]):
    """Fitted models by name: constant_velocity, the baselines, heads and ensembles, in this order.

    Attributes:
        identified: results of the identification.
        data: dataset of the fit and of the evaluation; with `current` the motion through the water.
        settings: settings of the fit.

    Example:
        models["lstm"].step(x, w)
    """

    def __init__(
        self, identified: IdentifiedModels, data: Dataset, currents: Sequence[CurrentRow] = ()
    ) -> None:
        self._currents = tuple(currents)
        super().__init__({name: Model(fitted_model) for name, fitted_model in identified.items()})
        self.identified = identified
        self.data = data
        self.settings: FitSettings = identified.settings

    @property
    def currents(self) -> pd.DataFrame:
        """The estimated current of each log, as in `currents.json`; no rows without `current`.

        Columns: log; fitted, whether the log is of training or validation; current_north and
            current_east, velocity of the water in m/s; standard_error_north, standard_error_east
            in m/s; p_value, probability of such an estimate without a current, NaN if not tested.
        """
        import pandas as pd

        columns = ("log", "fitted", "current_north", "current_east")
        errors = ("standard_error_north", "standard_error_east")
        rows = [
            {
                **{name: getattr(row, name) for name in columns},
                **dict(zip(errors, row.standard_error, strict=True)),
                "p_value": np.nan if row.p_value is None else row.p_value,
            }
            for row in self._currents
        ]
        return pd.DataFrame(rows, columns=[*columns, *errors, "p_value"])

    @cached_property
    def runs(self) -> dict[str, FreeRuns]:
        """Simulated windows of the logs with their errors, by split, of all models."""
        splits = self.settings.evaluation.splits
        return {split: free_run(self, self.data, split) for split in splits}

    @cached_property
    def selection(self) -> Selection:
        """Selected single model and ensemble, with the reason; selected on the validation logs."""
        return self.identified.select_models(
            {name: runs.evaluation for name, runs in self.runs.items()}
        )

    @property
    def selected_name(self) -> str:
        """Name of the selected single model: the hull of the recipe, else see `select_model`."""
        return self.selection.selected

    @property
    def predictor_name(self) -> str:
        """Name of the model reported first: the mean of the recipe, else the selected model."""
        return self.selection.default_model

    @property
    def verdict(self) -> list[str]:
        """The verdict on the predictor in complete sentences, the most important first."""
        return write_verdict(self.evidence)

    @cached_property
    def evidence(self) -> VerdictEvidence:
        """Errors and findings on which the verdict is based.

        They are those of the test logs if these are evaluated, else of the validation logs.
        """
        split = "test" if "test" in self.runs else "validation"
        evaluation = self.runs[split].evaluation
        settings = self.settings.evaluation
        fixed_length = [
            name
            for name, protocol in settings.protocols.items()
            if isinstance(protocol, WindowProtocol)
        ]
        protocol = order_protocols(evaluation.rows, split, settings.selection, fixed_length)[0]
        rows_by_model = {
            row.model: row
            for row in evaluation.rows
            if (row.protocol, row.manoeuvre) == (protocol, "all")
        }
        return VerdictEvidence(
            self.predictor_name,
            split,
            rows_by_model,
            "baseline",
            self.selection.to_record(),
            evaluation.limits_by_protocol,
            protocol=protocol,
            excitation=self.excitation,
        )

    @cached_property
    def excitation(self) -> ExcitationFile:
        """Excitation by the training logs, and feedback in training and test logs."""
        splits = {"train": self.identified.training_logs, "test": self.data.splits.get("test", ())}
        return assess_excitation(
            splits,
            self.data.signals,
            self.settings.prepare.grid.step,
            next(iter(self.values())).spec.domain,
            "fit",
        )

    @property
    def metrics(self) -> pd.DataFrame:
        """Free-run errors of all models over all splits, see `residnet.metrics`."""
        return self._table([row for runs in self.runs.values() for row in runs.rows])

    def _table(self, rows: Sequence[MetricsRow]) -> pd.DataFrame:
        return build_metrics_table(mark_selected(rows, self.selected_name))

    def __missing__(self, name: str) -> Model:
        return self[_require_known(name, self, "model")]

    def __repr__(self) -> str:
        return f"Models({', '.join(self)})"


def fit(
    data: Dataset | LogsLike,
    baseline: PartLike | None = None,
    heads: PartLike | Sequence[str] | Mapping[str, PartLike] = (),
    *,
    baselines: Mapping[str, PartLike] | None = None,
    current: Mapping[str, Any] | CurrentConfig | bool | None = None,
    threads: int = 1,
    workers: int = 1,
    trust: bool = False,
    progress: ProgressCallback | None = None,
    callbacks: Sequence[Callback] = (),
    logger: Logger | None = None,
    **settings: Any,
) -> Models:
    """Fit baselines, residual heads on the baselines, and ensembles.

    The arguments are the keys of a config of the task `fit`, with the same numerical results.
    Without a baseline, heads or other parts, the standard recipe fits its portfolio of models.

    Args:
        data: dataset from `prepare`; or logs, for which `prepare` is called without further
            arguments.
        baseline: baseline model: a kind, a mapping or a config object. `regressors` without
            settings is linear in every channel, and the default if heads are given.
        heads: learned residual models: kinds such as `["plsr", "lstm"]`, or a mapping from names to
            kinds, mappings, config objects or modules. A `torch.nn.Module` has
            `forward(z) -> rho`, or `forward(z, s) -> (rho, s)` and the number of memory values as
            `n_state`. It receives the channels z [B, nz], standardised over the training samples,
            and returns residual accelerations rho [B, n] in units of their standard deviations.
        baselines: further baselines by name.
        current: estimation of a constant current for each log, as the key `current` of a config: a
            mapping such as `{"baseline": "baseline", "spread": 0.5}`; `{}` or True take the
            defaults, None or False stand for still water. All models, the hull and the baselines
            among them, are then fitted to the motion through the water. The estimates are
            `models.currents`. The named baseline has regressors.
        threads: number of PyTorch threads; one is fastest for the small matrix products.
        workers: number of models fitted in parallel processes; the results do not change. With more
            than one worker, a script must call `fit` under `if __name__ == "__main__":`, since each
            process imports it.
        trust: allow classes of scikit-learn whose fitted state is not stored as data; they can run
            code, so only for sources that you trust.
        progress: called with the progress of the fit.
        callbacks: Lightning callbacks for the trainings of all networks, which then run in this
            process one after another.
        logger: Lightning logger for these trainings; None for none.
        settings: further keys of a fit, as in YAML: recipe, effort, base_of, forces, ensembles,
            means, training, refit, bands, seed, and integrator (default for the recipe: as
            `residnet new` chooses it).

    Raises:
        ConfigError: if a setting is wrong.
        FitError: if the data do not determine the coefficients of a model, or their currents.
        DataError: if a split contains no sample or no window.

    Example:
        models = residnet.fit(logs); models.selected, models.metrics
    """
    with trusting(trust):
        if not isinstance(data, Dataset):
            logs = (str, PathLike, Log, list, tuple, Mapping)
            require_instance(data, logs, "fit: expected logs, or data from residnet.prepare")
            data = prepare(data)
        if baselines:
            settings["baselines"] = parse_named_parts(baselines, "baseline", BaselineConfig)
        if current is not None and current is not False:
            settings["current"] = {} if current is True else current
        config = make_fit_settings(data, baseline, heads, settings)
        extensions = None
        if callbacks or logger is not None:
            # imports Lightning, which takes seconds and which a fit without networks does not need
            from residnet.training.trainer import make_extensions

            extensions = make_extensions(callbacks, logger)
        with torch_threads(threads), forward_progress(progress), worker_limit(workers):
            for split in ("validation", "test"):
                for log in data.logs(split):
                    check_window_fits(log, config)
            splits, currents = convert_to_motion_through_water(data.splits, config)
            identified = identify(splits, config, extensions=extensions)
            return Models(identified, replace(data, splits=splits), currents)


def make_fit_settings(
    data: Dataset,
    baseline: PartLike | None,
    heads: PartLike | Sequence[str] | Mapping[str, PartLike],
    settings: Mapping[str, Any],
) -> FitSettings:
    """Return the settings of a fit for the arguments of `fit`.

    Raises:
        ConfigError: if a setting is wrong.
        UsageError: if a part has the wrong type.
    """
    fit_settings = {
        key: value
        for key, value in settings.items()
        if (value or key not in ModelPartsConfig.model_fields)
        and (key, value) != ("integrator", None)
    }
    if not (isinstance(heads, list | tuple | Mapping) and not heads):
        fit_settings["heads"] = parse_named_parts(heads, "head", HeadConfig)
    if baseline is not None:
        fit_settings["baseline"] = parse_part(baseline, "baseline", BaselineConfig)
    if fit_settings.get("recipe") is None and not set(fit_settings) & set(
        ModelPartsConfig.model_fields
    ):
        fit_settings["recipe"] = "standard"
    if fit_settings.get("recipe") is None:
        fit_settings.setdefault("baseline", parse_part("regressors", "baseline"))
    else:
        fit_settings.setdefault("integrator", choose_integrator(data.signals.dof))
    sections = {"prepare": data.prepare, "signals": data.signals, "evaluation": data.evaluation}
    config: FitSettings = validate_config(
        to_builtin({**sections, **fit_settings}), FitSettings, "fit"
    )
    return config


def metrics(
    models: Models,
    data: Dataset | None = None,
    *,
    split: str | None = None,
    manoeuvre: str | None = "all",
    progress: ProgressCallback | None = None,
) -> pd.DataFrame:
    """Return the free-run errors of models, one row for each model, split and protocol.

    Args:
        models: models from `fit`.
        data: other logs, from `prepare(logs, settings_from=data)`; None for the logs of the fit.
        split: train, validation, test or external; None for all splits.
        manoeuvre: a kind of manoeuvre or a group; `all` for the errors over all manoeuvres, None
            for one row for each manoeuvre.
        progress: called with the progress of the free runs.

    Returns:
        Columns model, kind, split, protocol, manoeuvre, selected, windows, diverged, n, rmse_u,
        rmse_v (m/s), rmse_r (rad/s), the same for mae and nrmse, nrmse_mean, note (such as "2/12
        diverged"), position_error_end (m), heading_error_end (rad).

    Raises:
        UsageError: if there is no such split or manoeuvre.

    Example:
        residnet.metrics(models, split="test")
    """
    require_instance(models, Models, "metrics: expected models from residnet.fit")
    with forward_progress(progress):
        rows = None if data is None else free_run(models, data, split).rows
        table = models.metrics if rows is None else models._table(rows)
    for column, required_value in (("split", split), ("manoeuvre", manoeuvre)):
        if required_value is not None:
            if required_value not in set(table[column]):
                suggestion = suggest_name(str(required_value), map(str, table[column].unique()))
                raise UsageError(f"metrics: no {column} '{required_value}'{suggestion}")
            table = table[table[column] == required_value]
    return table.reset_index(drop=True)


def select_model(models: Models) -> Model:
    """Return the selected single model.

    For the standard recipe it is the model `hull`. Otherwise it is the simplest physically
    plausible model whose validation error in free run is within one standard error of the lowest
    one; `models.selection.reason` explains the selection.

    Example:
        residnet.select_model(models).name
    """
    require_instance(models, Models, "select_model: expected models from residnet.fit")
    return models[models.selected_name]
