"""Training of a neural network (head: residual model) by the user's own `lightning.Trainer`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

from residnet.api.data import Dataset
from residnet.api.fitting import Models, make_fit_settings
from residnet.api.models import require_instance
from residnet.api.values import PartLike, describe_type
from residnet.core.errors import UsageError
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.identification.fitter import FitStore, Fitter
from residnet.identification.identified import IdentifiedModels
from residnet.identification.prepared import convert_to_motion_through_water

if TYPE_CHECKING:
    from residnet.preprocessing.data_module import WindowsDataModule
    from residnet.training.heads import HeadTraining


@final
class HeadTrainingRun:
    """A network head on its fitted baseline, ready for a `lightning.Trainer`.

    Attributes:
        module: the Lightning module. It validates at the end of each epoch by free runs of the
            validation logs, logs their error as `validation`, and stops by itself.
        data: the windows of the training logs.
        max_epochs: number of epochs of the training.

    Example:
        training = residnet.head_training(data, "lstm")
        lightning.Trainer(max_epochs=training.max_epochs).fit(training.module, training.data)
        models = training.finish()
    """

    def __init__(self, dataset: Dataset, fitter: Fitter, name: str) -> None:
        # imports Lightning
        from residnet.training.heads import make_training

        self._dataset = dataset
        self._fitter = fitter
        self._models = {
            CONSTANT_VELOCITY: fitter.build_constant_velocity(),
            **{key: fitter.fit_baseline(key) for key in fitter.settings.all_baselines},
        }
        baseline = self._models[fitter.settings.get_baseline_name(name)]
        self._head_fit = fitter.start_head(name, baseline)
        module, data = make_training(fitter.make_training_setup(self._head_fit))
        self.module: HeadTraining = module
        self.data: WindowsDataModule = data
        self.max_epochs: int = module.settings.epochs

    def finish(self) -> Models:
        """Return constant-velocity model, baseline and trained head, with their free runs.

        The head has the weights of the epoch with the smallest validation error.

        Raises:
            UsageError: if the training has no finished epoch.
            FitError: if no epoch gave a finite free run.
        """
        if self.module.epoch == 0:
            raise UsageError(
                "head_training: the training has no finished epoch; fit it with your trainer first,"
                " and not with strategy='ddp_spawn', whose processes return no learning curve (use"
                " 'ddp')"
            )
        from residnet.training.heads import finish_training
        from residnet.training.trainer import make_training_notes

        model = self._head_fit.model
        notes = make_training_notes(self._head_fit.spec.name, self.module, model.head)
        self.module.cpu()
        self.module.model.load_state_dict(self.module.best_state)
        finish_training(model)
        fitter = self._fitter
        models = {
            **self._models,
            self._head_fit.spec.name: fitter.finish_head(self._head_fit, notes),
        }
        identified = IdentifiedModels(
            fitter.settings, models, fitter.velocity_limits, fitter.training_logs, False
        )
        return Models(identified, self._dataset)


def head_training(
    data: Dataset,
    head: PartLike,
    *,
    name: str | None = None,
    baseline: PartLike | None = None,
    **settings: Any,
) -> HeadTrainingRun:
    """Fit the baseline, and return the training of a network for the user's own trainer.

    The results are equal to the results of `fit` with the same arguments.

    Args:
        data: dataset from `prepare`.
        head: the network: a kind such as `lstm`, a mapping, a config object or an `nn.Module`.
        name: name of the head; None for its kind, or `head` for an `nn.Module`.
        baseline: see `fit`.
        settings: further keys of a fit, as in `fit`; `training` is the training of this head.

    Raises:
        ConfigError: if a setting is wrong.
        UsageError: if the head has a closed-form solution and no training.
        DataError: if no log is long enough for the windows.

    Example:
        training = residnet.head_training(data, "mlp", training={"steps": 100})
    """
    require_instance(data, Dataset, "head_training: expected data from residnet.prepare")
    if name is None:
        name = head if isinstance(head, str) else "head"
    if (training := settings.pop("training", None)) is not None:
        settings["training"] = {name: training}
    config = make_fit_settings(data, baseline, {name: head}, settings)
    splits, _ = convert_to_motion_through_water(data.splits, config)
    fitter = Fitter(splits, config, FitStore())
    if name not in fitter.settings.training:
        raise UsageError(
            f"head_training: a head of kind {describe_type(head)} is fitted in closed form and has"
            " no training; use residnet.fit"
        )
    return HeadTrainingRun(replace(data, splits=splits), fitter, name)
