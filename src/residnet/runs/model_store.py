"""Storage of trained models in a run folder, so that an interrupted run can be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import nn

from residnet.dynamics.store import Stored, load_model, model_names, read_weights, save_model
from residnet.evaluation.band import read_bands
from residnet.identification.fitter import FitStore, FittedModel
from residnet.runs.folder import RunFolder, verify_checksums, write_checksums


class RunModelStore(FitStore):
    """Vessel models and policies in `models/<name>` of a run folder.

    Attributes:
        training_folder: the run folder, for checkpoints and the TensorBoard log.
    """

    def __init__(self, folder: RunFolder) -> None:
        super().__init__(folder.path)
        self.folder = folder

    def names(self) -> list[str]:
        """Return the names of the subfolders of `models` that hold a model."""
        return list(model_names(self.folder.models))

    def load_finished(self, name: str) -> FittedModel | None:
        """Return a completely stored model; None if it is absent or incomplete."""
        return self.load(name) if (self.folder.models / name / "model.json").is_file() else None

    def load(self, name: str) -> FittedModel:
        """Return a model with its notes.

        Raises:
            UsageError: if there is no such model, or one of its files has changed.
        """
        verify_checksums(self.folder.models / name)
        return FittedModel(
            *load_model(self.folder.models / name),
            notes=self.folder.read_fit_notes(name),
            bands=read_bands(self.folder.path, name),
        )

    def save_module(
        self, name: str, spec: Stored, module: nn.Module, notes: Mapping[str, Any]
    ) -> None:
        """Write a trained module of any kind, such as a policy, with its notes."""
        folder = self.folder.models / name
        self.folder.write_json(folder / "fit.json", dict(notes))
        save_model(folder, spec, module)
        write_checksums(folder)

    def restore_module(self, name: str, module: nn.Module) -> dict[str, Any] | None:
        """Load the weights trained by an interrupted run into a module, and freeze it.

        Returns:
            The notes of the training; None if it was not complete.

        Raises:
            UsageError: if the weights or the notes have changed since they were written.
        """
        folder = self.folder.models / name
        if not (folder / "model.json").is_file():
            return None
        verify_checksums(folder)
        read_weights(folder, module)
        module.eval().requires_grad_(False)
        return self.folder.read_fit_notes(name)

    def save(self, fitted_model: FittedModel) -> None:
        """Write a model and its notes; the description is written last and marks it as complete."""
        self.save_module(
            fitted_model.name, fitted_model.spec, fitted_model.model, fitted_model.notes
        )
