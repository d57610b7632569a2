"""Trained models in their run folder, each kept as it is done, so that a broken run can go on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import nn

from residnet.core.files import read_json
from residnet.dynamics.store import Stored, load_model, model_names, read_weights, save_model
from residnet.evaluation.band import read_bands
from residnet.identification.fitter import FitStore, FittedModel
from residnet.runs.folder import RunFolder, verify_checksums, write_checksums


class RunModelStore(FitStore):
    """Vessel models and policies in `models/<name>` of a run folder.

    Attributes:
        training_folder: the run folder, where checkpoints and the TensorBoard log stand.
    """

    def __init__(self, folder: RunFolder) -> None:
        super().__init__(folder.path)
        self.folder = folder

    def names(self) -> list[str]:
        """Return the names of the models that are there."""
        return list(model_names(self.folder.models))

    def load_finished(self, name: str) -> FittedModel | None:
        """Return a model that is there whole; None if it is not."""
        return self.load(name) if (self.folder.models / name / "model.json").is_file() else None

    def load(self, name: str) -> FittedModel:
        """Return a model with its notes.

        Raises:
            UsageError: if there is none of that name, or a file of it has changed since.
        """
        verify_checksums(self.folder.models / name)
        content = read_json(self.folder.bands) if self.folder.bands.is_file() else {}
        return FittedModel(
            *load_model(self.folder.models / name),
            notes=self.folder.read_fit_notes(name),
            bands=read_bands(content).get(name, {}),
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
        """Fill a module with the weights that an interrupted run had trained, and freeze it.

        Returns:
            The notes of its training; None if it had not ended.

        Raises:
            UsageError: if the weights or the notes are not as they were written.
        """
        folder = self.folder.models / name
        if not (folder / "model.json").is_file():
            return None
        verify_checksums(folder)
        read_weights(folder, module)
        module.eval().requires_grad_(False)
        return self.folder.read_fit_notes(name)

    def save(self, fitted_model: FittedModel) -> None:
        """Write a model and its notes; the model's description comes last and marks it whole."""
        self.save_module(
            fitted_model.name, fitted_model.spec, fitted_model.model, fitted_model.notes
        )
