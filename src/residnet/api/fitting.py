"""The fit in Python: baselines, heads and ensembles by name, judged in free run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, final

import torch

from residnet.api.data import Data, prepare
from residnet.api.logs import LogsGiven
from residnet.api.models import Model
from residnet.api.runs import FreeRuns, free_run
from residnet.api.values import PartGiven, described, hearing, named_parts, part, plain
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.processes import spread
from residnet.core.progress import ProgressCallback
from residnet.identification.fit import fit as identify
from residnet.identification.identified import Identified
from residnet.identification.prepared import require_window, through_currents
from residnet.identification.settings import FitSettings
from residnet.judge.band import BandsConfig
from residnet.judge.metrics import metrics_table
from residnet.judge.selection import Selection
from residnet.judge.verdict import Evidence, verdict

if TYPE_CHECKING:
    import pandas as pd


_BANDS = BandsConfig()


@final
class Models(Mapping[str, Model]):
    """Fitted models by name: zero, the baselines, heads and ensembles, in this order.

    Attributes:
        data: what they were fitted on and are judged on.
        settings: of the fit, as YAML would have them.

    Example:
        models["lstm"].step(x, w)
    """

    def __init__(self, identified: Identified, data: Data) -> None:
        self.identified = identified
        self.data = data
        self.settings: FitSettings = identified.settings
        self._models = {name: Model(fitted) for name, fitted in identified.items()}

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
        """Name of the simplest sound model that validation does not tell from the best."""
        return self.selection.selected

    @cached_property
    def verdict(self) -> list[str]:
        """The verdict on the selected model in whole sentences, the most important first.

        It speaks of the test logs where they are judged, else of the validation logs.
        """
        split = "test" if "test" in self.runs else "validation"
        judged, protocol = self.runs[split].evaluation, self.settings.evaluation.selection
        whole = [
            row for row in judged.rows if (row["protocol"], row["manoeuvre"]) == (protocol, "all")
        ]
        return verdict(
            Evidence(
                self.selected,
                split,
                {row["model"]: row for row in whole},
                "baseline",
                self.selection.content(),
                judged.limits.get(protocol, {}),
            )
        )

    @property
    def metrics(self) -> pd.DataFrame:
        """Free-run errors of all models over all splits, see `residnet.metrics`."""
        rows = [
            {**row, "selected": row["model"] == self.selected}
            for runs in self.runs.values()
            for row in runs.rows
        ]
        return metrics_table(rows)

    def __getitem__(self, name: str) -> Model:
        if name not in self._models:
            raise UsageError(f"no model '{name}'{nearest(str(name), self._models)}")
        return self._models[name]

    def get(self, name: str, default: Any = None) -> Any:
        """Return the model of that name, or the default."""
        return self._models.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._models

    def __iter__(self) -> Iterator[str]:
        return iter(self._models)

    def __len__(self) -> int:
        return len(self._models)

    def __repr__(self) -> str:
        return f"Models({', '.join(self._models)})"


def fit(
    data: Data | LogsGiven,
    baseline: PartGiven | None = None,
    heads: PartGiven | Sequence[str] | Mapping[str, PartGiven] = (),
    *,
    recipe: str | None = None,
    effort: float = 1.0,
    baselines: Mapping[str, PartGiven] | None = None,
    base_of: Mapping[str, str] | None = None,
    ensembles: Mapping[str, Sequence[str]] | None = None,
    gates: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
    refit: Mapping[str, Any] | None = None,
    current: Mapping[str, Any] | None = None,
    bands: Mapping[str, Any] | BandsConfig | None = _BANDS,
    integrator: str | None = None,
    seed: int = 0,
    threads: int = 1,
    workers: int = 1,
    progress: ProgressCallback | None = None,
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
        recipe: `standard`, in place of all parts.
        effort: how long the recipe trains its networks, 1 for usual, less for a quick look.
        baselines: further baselines by name.
        base_of: the baseline that a head stands on, by the head's name.
        ensembles: models whose mean acceleration makes another model, by its name.
        gates: models that fade the residual `of` another one to its baseline outside the data.
        training: of network heads by the name of the head; `epochs` and so on, as YAML has them.
        refit: baselines whose coefficients are moved through rollouts.
        current: the logs ran in constant currents that are estimated first.
        bands: how far free runs may be off, calibrated over logs that were left out: `level`,
            `folds` and so on, as YAML has them; None for none.
        integrator: of the models: rk4, heun, euler or semi_implicit_euler; by default the last for
            the recipe, else the first.
        seed: of weights and batches.
        threads: of PyTorch; one is fastest for these small products, and part of what makes a fit
            repeatable.
        workers: models that may be fitted side by side, each in a process of its own, where they
            take long; the numbers stay the same. With more than one, a script has to keep its calls
            under `if __name__ == "__main__":`, since each process imports it again.
        progress: is told what is being fitted, and how far it is.

    Raises:
        ConfigError: where a setting is wrong.
        FitError: where the data do not determine a part.
        DataError: where a split holds no sample or no window.

    Example:
        models = residnet.fit(logs); models.selected, models.metrics
    """
    parts: dict[str, Any] = {
        "baselines": {} if not baselines else named_parts(baselines, "baseline"),
        "refit": refit or {},
        "heads": {} if _empty(heads) else named_parts(heads, "head"),
        "base_of": base_of or {},
        "ensembles": ensembles or {},
        "gates": gates or {},
        "training": training or {},
    }
    given = {key: value for key, value in parts.items() if value}
    if baseline is not None:
        given["baseline"] = part(baseline, "baseline")
    if recipe is None and not given:
        recipe = "standard"
    if recipe is None:
        given.setdefault("baseline", part("regressors", "baseline"))
    else:
        given |= {"recipe": recipe, "effort": effort}
    usual = "rk4" if recipe is None else "semi_implicit_euler"
    if not isinstance(data, Data):
        if not isinstance(data, str | PathLike | Log | list | tuple | Mapping):
            raise UsageError(
                f"fit: expected logs, or data from residnet.prepare, given {described(data)}"
            )
        data = prepare(data)
    settings: FitSettings = validate(
        plain(
            {
                "seed": seed,
                "prepare": data.prepare,
                "signals": data.signals,
                "integrator": integrator or usual,
                "current": current,
                "evaluation": data.evaluation,
                "bands": bands,
                **given,
            }
        ),
        FitSettings,
        "fit",
    )
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with hearing(progress), spread(workers):
            for split in ("validation", "test"):
                for log in data.logs(split):
                    require_window(log, settings)
            logs, _ = through_currents(data.splits, settings)
            moved = Data(logs, data.signals, data.prepare, data.evaluation, data.source)
            return Models(identify(logs, settings), moved)
    finally:
        torch.set_num_threads(before)


def _empty(heads: Any) -> bool:
    return isinstance(heads, list | tuple | Mapping) and not heads


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
    if not isinstance(models, Models):
        raise UsageError(f"metrics: expected models from residnet.fit, given {described(models)}")
    with hearing(progress):
        if data is None:
            table = models.metrics
        else:
            runs = free_run(models, data, split).rows
            marked = [{**row, "selected": row["model"] == models.selected} for row in runs]
            table = metrics_table(marked)
    for column, wanted in (("split", split), ("manoeuvre", manoeuvre)):
        if wanted is not None:
            if wanted not in set(table[column]):
                known = nearest(str(wanted), map(str, table[column].unique()))
                raise UsageError(f"metrics: no {column} '{wanted}'{known}")
            table = table[table[column] == wanted]
    return table.reset_index(drop=True)


def select(models: Models) -> Model:
    """Return the simplest sound model that validation does not tell from the best.

    Free runs over the validation logs decide; `models.selection.reason` says why.

    Example:
        residnet.select(models).name
    """
    if not isinstance(models, Models):
        raise UsageError(f"select: expected models from residnet.fit, given {described(models)}")
    return models[models.selected]
