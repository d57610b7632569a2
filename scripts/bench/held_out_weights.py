"""Compare weights of ensemble members that follow from their errors on left-out logs.

    python scripts/bench/held_out_weights.py [--logs measured|boats|shipped] [--vessels NAME ...]
        [--first 0] [--count 2] [--seed S] [--save FILE]
    python scripts/bench/held_out_weights.py --summary FILE ...

Draws are those of `recurrent.py`: four logs of five minutes together are fitted, four are
predicted. Members are the hull, four recurrent networks on it, and four with an encoder of the
measured past. Network k is trained without log k (cross-validation committee: Parmanto, Munro and
Doyle 1996, Improving committee diagnosis with resampling techniques), and hulls are fitted without
each log, so that every member has free runs over logs that it was not trained on. Both committees
take as many batches as the six networks of the recipe. Weights are for each velocity:

| rule | weights |
|---|---|
| inverse | inverse mean squares of the errors (Bates and Granger 1969) |
| stacked | smallest mean square error of the mean, not negative, sum 1 (Breiman 1996) |
| shrunk | the same with a penalty on the distance to the weights of the recipe |
| two, three | equal weights of hull and networks on it, and of all three |

Errors are relative to those of the recipe, whose networks are trained on all logs.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from itertools import combinations
from typing import Any
from unittest import mock

import bench
import numpy as np
import recurrent
import torch
from numpy.typing import NDArray
from recipe import SOURCES, STRETCHES, split
from torch import Tensor, nn

import residnet
from residnet.core.errors import FitError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification import fit, settings
from residnet.identification.fitter import (
    FitStore,
    FittedModel,
    Fitter,
    HeadFit,
    ValidationScorer,
)
from residnet.preprocessing import data_module
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.windows import WindowSampler, WindowStore

N_NETWORKS = 4
EFFORT = 0.75
"""Batches of a committee, as a share of those of the recipe, which trains six networks."""
COMMITTEES = ("hull_network", "encoder_margin")
MEMBERS = ("hull", *COMMITTEES)
SHRINKAGE = 1.0
"""Penalty of the rule `shrunk`, in units of the members' mean square error."""
Array = NDArray[np.float64]


class CommitteeSampler(WindowSampler):
    """Windows of a batch, of which network k has none of log k."""

    def __init__(self, sampler: WindowSampler, store: WindowStore) -> None:
        n_windows = sampler.batch_size // N_NETWORKS
        super().__init__(sampler.starts, sampler.batch_size, sampler.n_batches)
        log_index = store.log_index[sampler.starts]
        n_logs = int(store.log_index.max()) + 1
        self.parts = [
            WindowSampler(sampler.starts[log_index != k % n_logs], n_windows, sampler.n_batches)
            for k in range(N_NETWORKS)
        ]

    def draw_epoch(self, seed: int, epoch: int) -> Tensor:
        starts = [part.draw_epoch(seed + 17 * k, epoch) for k, part in enumerate(self.parts)]
        return torch.cat(starts, dim=1)


def select_network(model: HybridDynamics, index: int, baseline: Any = None) -> HybridDynamics:
    """Return one network of an ensemble, on a baseline with other parameters if given."""
    network = copy.deepcopy(model)
    for name, parameter in list(network.head.named_parameters(recurse=False)):
        values = parameter.detach()[index : index + 1].clone()
        setattr(network.head, name, nn.Parameter(values, requires_grad=False))
    network.head.batch_ensemble_size = 1
    if baseline is not None:
        network.baseline.load_state_dict(baseline.state_dict())
    return network.to(torch.float64)


class Draw:
    """The fits of a draw and their errors in units of the scales, NaN where not scored.

    Args:
        splits: logs by split.
    """

    def __init__(self, splits: dict[str, Any]) -> None:
        self.networks: dict[str, HybridDynamics] = {}
        finish_head = Fitter.finish_head
        fit_head = Fitter.fit_head

        def keep_networks(fitter: Fitter, head: HeadFit, notes: dict[str, Any]) -> FittedModel:
            self.networks[head.spec.name] = copy.deepcopy(head.model)
            return finish_head(fitter, head, notes)

        def skip_encoder(fitter: Fitter, name: str, baseline: FittedModel) -> FittedModel:
            if name != "hull_network":
                raise FitError("trained as a committee only")
            return fit_head(fitter, name, baseline)

        def make_plan(summary: Any, **_: Any) -> dict[str, Any]:
            return recurrent.make_plan(summary, list(COMMITTEES))

        with (
            mock.patch.object(settings, "make_portfolio", make_plan),
            mock.patch.object(fit, "count_parallel_heads", return_value=1),
            mock.patch.object(Fitter, "finish_head", keep_networks),
        ):
            with mock.patch.object(Fitter, "fit_head", skip_encoder):
                self.models = residnet.fit(splits, bands=None)
            data = self.models.data
            self.settings = self.models.settings
            self.test_logs = data.logs("test")
            self.validation_logs = data.logs("validation")
            self.logs = [*data.logs("train"), *self.validation_logs]
            self.recipe_network = self.models["hull_network"].fitted_model.model
            self._train_committees()
        self.hulls = [
            self._make_fitter([log for i, log in enumerate(self.logs) if i != left_out])
            .fit_baseline("hull")
            .model
            for left_out in range(len(self.logs))
        ]

    def _make_fitter(self, logs: Sequence[PreparedLog]) -> Fitter:
        return Fitter(
            {"train": logs, "validation": self.validation_logs},
            self.settings,
            FitStore(),
            resolve_recipe=False,
            validation_in_training=True,
        )

    def _train_committees(self) -> None:
        heads = dict(self.settings.heads)
        training = dict(self.settings.training)
        for name in COMMITTEES:
            n_recipe = heads[name].members
            heads[name] = heads[name].model_copy(update={"members": N_NETWORKS})
            stages = tuple(
                stage.model_copy(update={"batch": stage.batch // n_recipe * N_NETWORKS})
                for stage in training[name].multi_step
            )
            n_batches = max(1, round(training[name].steps * EFFORT))
            training[name] = training[name].model_copy(
                update={"steps": n_batches, "multi_step": stages}
            )
        self.settings = self.settings.model_copy(update={"heads": heads, "training": training})
        make_samplers = data_module.make_samplers

        def make_committee(stage: Any, store: WindowStore, n_batches: int) -> list[WindowSampler]:
            (sampler,) = make_samplers(stage, store, n_batches)
            return [CommitteeSampler(sampler, store)]

        fitter = self._make_fitter(self.logs)
        with mock.patch.object(data_module, "make_samplers", make_committee):
            for name, baseline in zip(COMMITTEES, ("hull", "constant_velocity"), strict=True):
                fitter.fit_head(name, self.models[baseline].fitted_model)

    def run(
        self, model: HybridDynamics, logs: Sequence[PreparedLog], *, overlap: bool
    ) -> tuple[Array, Array]:
        """Return errors [N, n] of free runs over windows, and the first samples of the windows."""
        scorer = ValidationScorer(
            logs,
            self.settings.evaluation,
            self.settings.prepare.grid.step,
            self.models.identified.velocity_limits,
            use_overlapping_windows=overlap,
        )
        errors = scorer.run(model)[1]
        values = np.where(errors.is_scored, errors.velocity_errors, np.nan)
        scaled = values / self.settings.evaluation.scales.to_array()
        return scaled[:, list(errors.dof.active_indices)], errors.window_starts

    def compute_left_out_moments(self) -> Array:
        """Return mean products of the members' errors on left-out logs, by velocity [n, M, M]."""
        moments = []
        for left_out, log in enumerate(self.logs):
            hull = self.hulls[left_out]
            models = [[hull]]
            for name in COMMITTEES:
                baseline = hull.baseline if name == "hull_network" else None
                models.append(
                    [
                        select_network(self.networks[name], k, baseline)
                        for k in range(N_NETWORKS)
                        if k % len(self.logs) == left_out
                    ]
                )
            errors = np.stack(
                [
                    np.mean([self.run(one, [log], overlap=True)[0] for one in group], axis=0)
                    for group in models
                ]
            )
            is_scored = np.isfinite(errors).all(axis=0)
            errors = np.where(is_scored, errors, 0.0)
            products = np.einsum("itn,jtn->nij", errors, errors)
            moments.append(products / is_scored.sum(axis=0)[:, None, None])
        return np.asarray(np.mean(moments, axis=0))


def stack(moments: Array, target: Array, penalty: float) -> Array:
    """Return weights [M] of the smallest mean square error, not negative and with a sum of 1.

    Args:
        moments: mean products of the errors of the members [M, M].
        target: weights to which the penalty draws [M].
        penalty: weight of the squared distance to them, in units of the mean square error.
    """
    n = len(moments)
    scale = penalty * np.trace(moments) / n
    matrix = moments + scale * np.eye(n)
    best = (np.inf, target)
    # the solution is that of the equality constraint on one of the few subsets of members
    for size in range(1, n + 1):
        for subset in map(list, combinations(range(n), size)):
            system = np.block(
                [[matrix[np.ix_(subset, subset)], np.ones((size, 1))], [np.ones(size), 0.0]]
            )
            solution = np.linalg.solve(system, np.append(scale * target[subset], 1.0))[:size]
            weights = np.zeros(n)
            weights[subset] = solution
            value = weights @ matrix @ weights - 2.0 * scale * target @ weights
            if solution.min() >= 0.0 and value < best[0]:
                best = (value, weights)
    return best[1]


def compute_weights(moments: Array) -> dict[str, Array]:
    """Return weights by rule [n, M]."""
    two = np.array([0.5, 0.5, 0.0])
    three = np.full(3, 1.0 / 3.0)
    precision = 1.0 / np.einsum("nii->ni", moments)
    return {
        "two": np.tile(two, (len(moments), 1)),
        "three": np.tile(three, (len(moments), 1)),
        "inverse": precision / precision.sum(axis=1, keepdims=True),
        "stacked": np.array([stack(one, three, 0.0) for one in moments]),
        "shrunk": np.array([stack(one, two, SHRINKAGE) for one in moments]),
    }


def compare_rules(splits: dict[str, Any]) -> dict[str, Any]:
    """Fit the members to a draw, and return test errors and weights by rule."""
    draw = Draw(splits)
    hull, begins = draw.run(draw.models["hull"].fitted_model.model, draw.test_logs, overlap=False)
    recipe_network = draw.run(draw.recipe_network, draw.test_logs, overlap=False)[0]
    test = [hull]
    for name in COMMITTEES:
        networks = [select_network(draw.networks[name], k) for k in range(N_NETWORKS)]
        runs = [draw.run(one, draw.test_logs, overlap=False)[0] for one in networks]
        test.append(np.mean(runs, axis=0))
    errors = {
        "recipe": recurrent.mean_error(0.5 * (hull + recipe_network), begins),
        "hull_network of the recipe": recurrent.mean_error(recipe_network, begins),
    }
    for name, values in zip(MEMBERS, test, strict=True):
        errors[f"{name} alone"] = recurrent.mean_error(values, begins)
    moments = draw.compute_left_out_moments()
    weights = compute_weights(moments)
    for rule, by_velocity in weights.items():
        total = np.einsum("mtn,nm->tn", np.stack(test), by_velocity)
        errors[rule] = recurrent.mean_error(total, begins)
    left_out = np.sqrt(np.einsum("nii->ni", moments))
    return {
        "errors": errors,
        "weights": {rule: values.round(2).tolist() for rule, values in weights.items()},
        "left_out": dict(zip(MEMBERS, left_out.T.round(3).tolist(), strict=True)),
    }


def summarize(records: Sequence[dict[str, Any]]) -> str:
    """Return geometric means of the errors relative to the recipe, with paired standard errors."""
    lines = [f"{len(records)} draws: {', '.join(record['name'] for record in records)}"]
    for name in records[0]["errors"]:
        ratios = np.log([r["errors"][name] / r["errors"]["recipe"] for r in records])
        ratio, standard_error = bench.summarize_log_ratios(ratios)
        by_draw = " ".join(f"{value:.2f}" for value in np.exp(ratios))
        lines.append(f"  {name:28} {ratio:.3f} ± {standard_error:.3f}  {by_draw}")
    return "\n".join(lines)


def main() -> None:
    """Print a line for each draw, and the table."""
    given = bench.options(
        __doc__, logs="measured", vessels=[], first=0, count=2, seed=7901, minutes=5.0,
        save=None, summary=[],
    )  # fmt: skip
    records = bench.read_records(given.summary)
    source, names = SOURCES[given.logs]
    names = given.vessels or names
    for number in range(given.first, given.first + given.count if not given.summary else 0):
        name = names[number % len(names)]
        random = np.random.default_rng([given.seed, number])
        begin = time.process_time()
        logs = source(name, 60.0 * given.minutes / STRETCHES, given.seed + number // 2, random)
        record = {"name": name, "seed": given.seed, "draw": number, **compare_rules(split(logs))}
        record["cpu"] = round(time.process_time() - begin, 1)
        records.append(record)
        bench.report_record(record, given.save)
    print(summarize(records))


if __name__ == "__main__":
    main()
