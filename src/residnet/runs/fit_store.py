"""Models of a fit in its run folder, each kept as it is done, so that a broken fit can go on."""

from __future__ import annotations

from pathlib import Path

from residnet.dynamics.store import load_model, model_names, save_model
from residnet.identification.models import FittedModel
from residnet.runs.folder import RunFolder


class FolderStore:
    """Models of a fit in `models/<name>` of a run folder.

    Attributes:
        training_folder: the run folder, where checkpoints and the TensorBoard log stand.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self.training_folder: Path | None = folder.path

    def names(self) -> list[str]:
        """Return the names of the models that are there."""
        return list(model_names(self.folder.models))

    def finished(self, name: str) -> FittedModel | None:
        """Return a model that is there whole; None where it is not."""
        return self.load(name) if (self.folder.models / name / "model.json").is_file() else None

    def load(self, name: str) -> FittedModel:
        """Return a model with its notes.

        Raises:
            UsageError: where there is none of that name.
        """
        return FittedModel(
            *load_model(self.folder.models / name), notes=self.folder.fit_notes(name)
        )

    def keep(self, fitted: FittedModel) -> None:
        """Write a model and its notes; the model's description comes last and marks it whole."""
        folder = self.folder.models / fitted.name
        self.folder.write_json(folder / "fit.json", fitted.notes)
        save_model(folder, fitted.spec, fitted.model)
