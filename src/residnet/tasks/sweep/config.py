"""The config of a sweep: what is varied, how it is searched, what is sought, and where it runs."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from residnet.core.config import BaseConfig, Config
from residnet.runs.task import Task
from residnet.tasks.sweep.objective import FreeRunObjective, ObjectiveConfig
from residnet.tasks.sweep.runners import ProcessesConfig, RunnerConfig
from residnet.tasks.sweep.space import Values, override

_MOST = 100_000


class GridSearch(Config):
    """Every combination of all values, once.

    Attributes:
        kind: of the search.
    """

    kind: Literal["grid"]


class RandomSearch(Config):
    """Values drawn at random, independently of what other trials found.

    Attributes:
        kind: of the search.
        trials: number of trials.
        seed: of the draws.
    """

    kind: Literal["random"]
    trials: int = Field(ge=1, le=_MOST)
    seed: int = Field(default=0, ge=0)


class TpeSearch(Config):
    """Values drawn where earlier trials did well: Optuna's tree-structured Parzen estimator.

    What a trial draws depends on which trials had ended by then, so that only one worker repeats
    a search exactly.

    Attributes:
        kind: of the search.
        trials: number of trials.
        startup: trials that are drawn at random first.
        seed: of the draws.
    """

    kind: Literal["tpe"]
    trials: int = Field(ge=1, le=_MOST)
    startup: int = Field(default=10, ge=1)
    seed: int = Field(default=0, ge=0)


SearchConfig = Annotated[GridSearch | RandomSearch | TpeSearch, Field(discriminator="kind")]


class PruningConfig(Config):
    """Ending a trial early: where its network validates worse than the median of trials by then.

    The validation error in free run that the training itself watches is compared, at the same
    epoch.

    Attributes:
        startup: trials that must have ended before any is ended early.
        warmup: epochs that every trial is given.
    """

    startup: int = Field(default=5, ge=1)
    warmup: int = Field(default=0, ge=0)


class SweepConfig(Task):
    """Keys of a config varied over a search space; every trial is a run of its own.

    Attributes:
        base: config of any task but a sweep, by its path or by the name of one that comes with
            residnet, such as `quickstart`; paths in it are taken from its own folder.
        common: overrides of the base for all trials.
        space: values by the key of the base that they are for, such as `heads.mlp.hidden`.
        search: how the space is searched.
        objective: what is sought.
        pruning: ends poor trials early; null lets each come to its end.
        runner: where trials run.
    """

    task: Literal["sweep"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    space: dict[str, Values] = Field(min_length=1)
    search: SearchConfig
    objective: ObjectiveConfig = FreeRunObjective()
    pruning: PruningConfig | None = None
    runner: RunnerConfig = ProcessesConfig()

    @model_validator(mode="after")
    def _combination(self) -> SweepConfig:
        if isinstance(self.search, GridSearch):
            for key, values in self.space.items():
                try:
                    values.grid()
                except ValueError as error:
                    raise ValueError(f"space.{key}: {error}") from None
            if self.trials > _MOST:
                raise ValueError(f"space: a grid of {self.trials} trials; at most {_MOST}")
        if self.pruning is not None and self.objective.watched is None:
            raise ValueError(
                "pruning: objective must be of kind free_run and name the network whose training"
                " is watched in objective.model"
            )
        return self

    @property
    def trials(self) -> int:
        """Number of trials that the search asks for; of a grid, all its combinations."""
        if not isinstance(self.search, GridSearch):
            return self.search.trials
        count = 1
        for values in self.space.values():
            count *= len(values.grid())
        return count

    def combinations(self) -> list[dict[str, Any]]:
        """Return every combination of a grid, the last key varying fastest."""
        grids = [values.grid() for values in self.space.values()]
        return [dict(zip(self.space, values, strict=True)) for values in itertools.product(*grids)]

    def overrides(self, values: Mapping[str, Any], name: str) -> list[str]:
        """Return the overrides of the base for one trial.

        Args:
            values: by key, as the distributions know them.
            name: of the trial's run.
        """
        drawn = [override(key, values[key]) for key in self.space]
        return [*self.common, *drawn, f"name={name}"]
