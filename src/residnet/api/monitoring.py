"""A monitor in Python: it says when the vessel has changed, or its data have."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from residnet.api.data import Data
from residnet.api.models import Model, require_model
from residnet.api.values import described
from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.identification.monitoring import (
    MonitorConfig,
    Verdict,
    Watch,
    Watcher,
    past_of,
    pieces,
)
from residnet.identification.recursive_refit import Refit, recursive_refit, refitted


@final
class Monitor:
    """A watch over a model in service.

    Short free runs of the model are compared with what is measured. Score tests say whether a
    change of mass, damping, thrust, rudder or of a sensor explains the last minutes better than
    clean logs ever asked for; wind and current have their part taken out first.

    Args:
        model: of the vessel as it was.
        clean: data of the unchanged vessel, as they were fitted.
        settings: of `residnet.identification.monitoring.MonitorConfig`: `window`,
            `stretch`, `false_alarm`, `group` in s.

    Raises:
        UsageError: where an argument is of another kind.
        DataError: where the clean data are too few.

    Example:
        monitor = residnet.Monitor(models["baseline"], data); verdict = monitor.step(y, w)
    """

    def __init__(self, model: Model, clean: Data, **settings: Any) -> None:
        require_model(model, "Monitor")
        if not isinstance(clean, Data):
            raise UsageError(
                f"Monitor: expected data from residnet.prepare, given {described(clean)}"
            )
        config = validate(settings, MonitorConfig, "Monitor")
        module, past = copy.deepcopy(model.module), past_of(model.module)
        steps = round(config.window / model.dt)
        logs = [log for split in ("train", "validation") for log in clean.splits.get(split, ())]
        watch = Watch(model.spec, module, [pieces(log, steps, past) for log in logs], config)
        self._model, self._past = model, past
        self._watcher = Watcher(watch, past)
        self.verdict: Verdict | None = None

    @property
    def threshold(self) -> float:
        """The score at which a cause raises an alarm."""
        return self._watcher.watch.threshold

    def step(self, y: Sequence[float], w: Sequence[float]) -> Verdict | None:
        """Take one sample, and return the verdict where a window is complete, else None.

        Args:
            y: measured x, y, psi, u, v, r, psi without jumps.
            w: inputs held over the step after it, in the model's order.
        """
        found = self._watcher.step(np.asarray(y, dtype=float), np.asarray(w, dtype=float))
        self.verdict = found or self.verdict
        return found

    def refit(self, new: Data) -> tuple[Model, Refit]:
        """Put the changes that the monitor names into a copy of the model, log by log.

        The old model stays as it is. Judge both on logs that were not given here, for example by
        `residnet.free_run`, before the new one goes into service.

        Args:
            new: logs of the changed vessel in the order of time, as
                `residnet.prepare(logs, like=data)` gives them.

        Returns:
            The new model, named `<name>_refit`, and what was found: `moved` holds each change with
            size and standard error, `ended` says why no further one was taken. Where `moved` is
            empty the model is as it was.

        Raises:
            UsageError: where the data are of another kind, or the model has no parameters to move.
            DataError: where a log holds no window.
        """
        if not isinstance(new, Data):
            raise UsageError(
                f"Monitor.refit: expected data from residnet.prepare, given {described(new)}"
            )
        logs = [log for members in new.splits.values() for log in members]
        windows = [pieces(log, self._watcher.steps, self._past) for log in logs]
        for log, found in zip(logs, windows, strict=True):
            if not found:
                raise DataError(
                    f"log {log.log.name}: holds no window of"
                    f" {self._watcher.watch.config.window:g} s without a break; leave it out"
                )
        refit = recursive_refit(self._watcher.watch, windows)
        return Model(refitted(self._model.fitted, refit)), refit

    def restart(self) -> None:
        """Say that the next sample does not follow the last one."""
        self._watcher.restart()
