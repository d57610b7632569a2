"""Reading a run folder back: metrics, rollouts and what stands beside them; parts that a folder
does not have are empty.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from residnet.core.errors import DataError, UsageError

Row = Mapping[str, Any]
COLUMNS = ("u", "v", "r", "psi", "x", "y")
_FOCUS = ("test", "external", "validation", "train")


@dataclass(frozen=True)
class StoredWindow:
    """One free run of a log under every model: t [T] s, usable [T], measured and predicted [T, 6] =
    (u, v, r, psi, x, y), SI and rad.
    """

    log: str
    manoeuvre: str
    protocol: str
    number: int
    t: np.ndarray
    usable: np.ndarray
    measured: np.ndarray
    predicted: dict[str, np.ndarray]
    diverged: dict[str, bool]

    def rmse(self, model: str) -> np.ndarray:
        """Root mean square errors [3] of u, v (usable samples) and r (all), as in metrics.json."""
        error = self.predicted[model][:, :3] - self.measured[:, :3]
        good = self.usable if self.usable.any() else np.ones_like(self.usable)
        return np.sqrt(
            [np.mean(error[good, 0] ** 2), np.mean(error[good, 1] ** 2), np.mean(error[:, 2] ** 2)]
        )


class RunFiles:
    """Contents of a run folder, or of what `residnet evaluate` writes.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where metrics.json cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not (path / "metrics.json").is_file():
            raise UsageError(f"{path}: no metrics.json here; give the folder of a finished run")
        self.metrics: Mapping[str, Any] = _json(path / "metrics.json", {})
        if not isinstance(self.metrics, dict) or not self.metrics.get("rows"):
            raise DataError(f"{path / 'metrics.json'}: holds no rows")
        self.rows: Sequence[Row] = self.metrics["rows"]
        self.quality: Sequence[Row] = _json(path / "data_quality.json", [])
        self.provenance: Row = _json(path / "provenance.json", {})
        self.limits: Row = _json(path / "limits.json", {})
        self.goodness: Row = _json(path / "goodness.json", {})
        self.doctor: Row = _json(path / "doctor.json", {})
        self.booklet: Row = _json(path / "booklet.json", {})
        resolved = path / "resolved.yaml"
        self.resolved_text = resolved.read_text() if resolved.is_file() else ""
        self.resolved: Row = yaml.safe_load(self.resolved_text) or {}

    @cached_property
    def kinds(self) -> dict[str, str]:
        """Kind (zero, baseline, head, truth, ...) of each model, in the order of metrics.json.

        Only the first baseline is one here, what reductions refer to; others are `further` models,
        judged like heads.
        """
        kinds = {row["model"]: row.get("kind", "head") for row in self.rows}
        first = next((model for model, kind in kinds.items() if kind == "baseline"), None)
        return {
            model: "further" if kind == "baseline" and model != first else kind
            for model, kind in kinds.items()
        }

    @cached_property
    def selected(self) -> str | None:
        """The model chosen on validation data, if any."""
        chosen = [row["model"] for row in self.rows if row.get("selected")]
        return self.metrics.get("selected") or (chosen[0] if chosen else None)

    @cached_property
    def baseline(self) -> str | None:
        """The model that reductions refer to."""
        return next((model for model, kind in self.kinds.items() if kind == "baseline"), None)

    @cached_property
    def truth(self) -> str | None:
        """The plant that made the data, where they are simulated."""
        return next((model for model, kind in self.kinds.items() if kind == "truth"), None)

    @cached_property
    def heads(self) -> list[str]:
        """Models that are neither zero, baseline nor truth; the selected one first."""
        heads = [
            model for model, kind in self.kinds.items() if kind not in ("zero", "baseline", "truth")
        ]
        return sorted(heads, key=lambda model: model != self.selected)

    @cached_property
    def splits(self) -> list[str]:
        """Splits of the rows, in their order."""
        return list(dict.fromkeys(row["split"] for row in self.rows))

    @cached_property
    def focus(self) -> str:
        """The split that the report speaks of: test where there is one."""
        return next((split for split in _FOCUS if split in self.splits), self.splits[0])

    @cached_property
    def sides(self) -> list[str]:
        """Splits that stand side by side: train, where there is one, and the focus."""
        return [split for split in ("train",) if split in self.splits and split != self.focus] + [
            self.focus
        ]

    @cached_property
    def protocols(self) -> list[str]:
        """Protocols of the rows, the one that selects first."""
        names = list(dict.fromkeys(row["protocol"] for row in self.rows))
        return sorted(names, key=lambda name: name != self.evaluation.get("selection"))

    @property
    def evaluation(self) -> Row:
        """The section `evaluation` of the configuration."""
        return self.resolved.get("evaluation") or {}

    @cached_property
    def channels(self) -> list[str]:
        """Channels that are scored."""
        return [name for name in self.rows[0]["rmse"] if name != "mean"]

    def row(
        self, model: str | None, split: str, protocol: str, manoeuvre: str = "all"
    ) -> Row | None:
        """The row of metrics.json, None where there is none."""
        wanted = (model, split, protocol, manoeuvre)
        return next(
            (
                row
                for row in self.rows
                if (row["model"], row["split"], row["protocol"], row.get("manoeuvre", "all"))
                == wanted
            ),
            None,
        )

    def manoeuvres(self, split: str, protocol: str) -> list[str]:
        """Kinds and named groups of manoeuvres that have rows; without `all`."""
        names = [
            row.get("manoeuvre", "all")
            for row in self.rows
            if row["split"] == split and row["protocol"] == protocol
        ]
        return [name for name in dict.fromkeys(names) if name != "all"]

    def card(self, model: str) -> Row:
        """models/<model>/model.json."""
        return _json(self.path / "models" / model / "model.json", {})

    def fit(self, model: str) -> Row:
        """models/<model>/fit.json."""
        return _json(self.path / "models" / model / "fit.json", {})

    def manoeuvre_of(self, log: str) -> str:
        """Kind of manoeuvre of a log: as recorded, else the kind that its name begins with, else
        its name without a number.
        """
        recorded = {entry["log"]: entry.get("manoeuvre") for entry in self.quality}
        if recorded.get(log):
            return str(recorded[log])
        known = {str(row.get("manoeuvre", "all")) for row in self.rows} - {"all"}
        fitting = sorted((name for name in known if log.startswith(name)), key=len)
        return fitting[-1] if fitting else re.sub(r"[_-]?\d+$", "", log) or log

    def windows(self, split: str) -> list[StoredWindow]:
        """All stored free runs of a split, by file name; empty where none are stored."""
        import pandas as pd

        out: list[StoredWindow] = []
        for path in sorted((self.path / "rollouts" / split).glob("*.parquet")):
            table = pd.read_parquet(path)
            for (protocol, number), group in table.groupby(["protocol", "window"], sort=True):
                parts = {str(model): part for model, part in group.groupby("model", sort=False)}
                first = next(iter(parts.values()))
                out.append(
                    StoredWindow(
                        log=path.stem,
                        manoeuvre=self.manoeuvre_of(path.stem),
                        protocol=str(protocol),
                        number=int(str(number)),
                        t=first["t"].to_numpy(float),
                        usable=first["usable"].to_numpy(bool),
                        measured=first[list(COLUMNS)].to_numpy(float),
                        predicted={
                            model: part[[f"{name}_hat" for name in COLUMNS]].to_numpy(float)
                            for model, part in parts.items()
                        },
                        diverged={
                            model: bool(part["diverged"].any()) for model, part in parts.items()
                        },
                    )
                )
        return out


def _json(path: Path, absent: Any) -> Any:
    if not path.is_file():
        return absent
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise DataError(f"{path}: not readable as JSON ({error})") from None
