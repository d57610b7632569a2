"""What every export format shares: its name, the ending of its files, how a model is written.

Whatever the format, a stepped model keeps this contract, with batches of rows B in all tensors:

- `initial_state(batch) -> s`: the memory [B, n_state] without a past, zeros.
- `warmup(y_history, w_history) -> s`: the memory that a measured past leaves, states [B, T, 6] and
  inputs [B, T, m], oldest first. A sample that is no measurement is left out.
- `step(x, w, s) -> (x, s, outside)`: state [B, 6], memory and flag [B] one step of `dt` later.
- `rollout(x0, w, s) -> (x, s, outside)`: states [B, T+1, 6] from x0 on under inputs w [B, T, m],
  the memory after the last step, and the flag of each step [B, T].
- `band(k) -> half widths [5]` of u, v, r, heading and position k steps after a measured state,
  where a format has methods; the table that it reads stands in every card as `band`.

`outside` is true where a velocity or an input lies beyond the training range, and where anything
was no number or beyond what is accepted; states and memories that come out are finite always. What
is accepted, and what stands in the place of the rest, is defined once, in `residnet.export.guard`;
its `GuardedDynamics` is the module that formats translate. A tensor of a wrong shape is refused
where the format can refuse, and never broadcast.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec


class Exporter(ABC):
    """A format that a model is written in for controllers, found by its name.

    Another package adds one with an entry point in the group `residnet.exporters` that leads to a
    subclass without arguments.

    Attributes:
        name: what `residnet export --format` knows it by.
        suffix: what follows the model's name in the file's name, for example `.pt`.
        about: one line for `residnet list formats`.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    about: ClassVar[str]

    @abstractmethod
    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write one model, after a parity check, and return what its card says.

        Args:
            spec: the model's description.
            model: the model; its precision may be changed.
            file: where to write; its folder may not exist yet.
            rows: of metrics.json of this model, for the card; empty where there are none.

        Raises:
            UsageError: where the format cannot hold such a model.
            ExportError: where what was written does not reproduce the model.
        """
