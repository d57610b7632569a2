"""What every export format shares: its name, the ending of its files, how a model is written."""

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
