"""A monitor in Python: it says when the vessel has changed, or its data have."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.face.data import Data
from residnet.face.models import Model, require_model
from residnet.face.values import described
from residnet.identification.monitoring.monitor import MonitorConfig, Verdict, Watch
from residnet.identification.monitoring.watcher import Watcher
from residnet.identification.monitoring.windows import past_of, pieces


@final
class Monitor:
    """A watch over a model in service.

    Short free runs of the model are compared with what is measured. Score tests say whether a
    change of mass, damping, thrust, rudder or of a sensor explains the last minutes better than
    clean logs ever asked for; wind and current have their part taken out first.

    Args:
        model: of the vessel as it was.
        clean: data of the unchanged vessel, as they were fitted.
        settings: of `residnet.identification.monitoring.monitor.MonitorConfig`: `window`,
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

    def restart(self) -> None:
        """Say that the next sample does not follow the last one."""
        self._watcher.restart()
