"""Exported modules of every head kind, found from the union itself: the model's answers, the flags,
the card, and refusal of what differs.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from exported_models import HIGH, KINDS, LOW, VARIANTS, built, spec_of
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.core.names import STATE
from residnet.dynamics.ensemble import mean_of
from residnet.export import contract, torchscript
from residnet.export.torchscript import check_parity, export_torchscript
from residnet.heads import HeadConfig
from residnet.testing import check_bad_inputs

ROW = {
    "model": "mine",
    "split": "test",
    "protocol": "T30",
    "manoeuvre": "all",
    "nrmse": {"mean": 0.1},
}


# the full length is run by the tests of the task `fit`
FULL, STEPS = contract.PARITY_STEPS, 120


@pytest.fixture(scope="module", autouse=True)
def short_parity() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contract, "PARITY_STEPS", STEPS)
        yield


class Exported:
    """A model, its file loaded back, and its card as returned."""

    def __init__(self, variant: str, folder: Path) -> None:
        self.spec, self.model = built(variant)
        self.file = folder / "deep" / f"{variant}.pt"
        self.card = export_torchscript(self.spec, self.model, self.file, [ROW])
        extra = {"card.json": ""}
        self.module: Any = torch.jit.load(str(self.file), _extra_files=extra)
        self.stored = json.loads(extra["card.json"])


@pytest.fixture(scope="module", params=VARIANTS)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return Exported(request.param, tmp_path_factory.mktemp("export"))


@pytest.fixture(scope="module")
def lstm(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return Exported("lstm", tmp_path_factory.mktemp("export"))


def drives(batch: int, steps: int) -> tuple[Tensor, Tensor]:
    """Initial states and jumping inputs, float32."""
    random = np.random.default_rng(1)
    x = random.normal(size=(batch, 6)) * [50, 50, 3, 0.5, 0.1, 0.1] + [0, 0, 0, 1, 0, 0]
    w = random.uniform(LOW[3:], HIGH[3:], size=(batch, steps, 4))
    return torch.from_numpy(x).float(), torch.from_numpy(w).float()


def test_the_union_is_covered() -> None:
    assert set(KINDS) <= set(VARIANTS)
    assert len(KINDS) == len(get_args(get_args(HeadConfig)[0])) >= 4


def test_parity_is_stated_and_small(exported: Exported) -> None:
    parity = exported.card["parity"]
    assert parity["steps"] == STEPS
    assert FULL == 2000
    assert list(parity["share_of_range"]) == list(STATE)
    assert all(0 <= share <= 1e-5 for share in parity["share_of_range"].values())


def test_steps_rollout_and_warm_up_are_those_of_the_model(exported: Exported) -> None:
    """Random jumps instead of the sines of the export's own check."""
    module, model, batch, steps = exported.module, exported.model, 3, 30
    x0, w = drives(batch, steps)
    past = torch.cat(
        (
            x0[:, None, :3].expand(-1, 8, -1),
            torch.linspace(0.1, 0.3, 8)[None, :, None].expand(batch, -1, 3),
        ),
        dim=-1,
    )
    with torch.no_grad():
        s = model.warmup(past, w[:, :8])
        theirs = module.warmup(past, w[:, :8])
        torch.testing.assert_close(theirs, s, rtol=1e-5, atol=1e-6)
        x, y, memory = x0, x0, s
        path = [x0]
        for k in range(steps):
            x, memory = model.step(x, w[:, k], memory)
            y, theirs, _ = module.step(y, w[:, k], theirs)
            path.append(y)
        torch.testing.assert_close(y, x, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(theirs, memory, rtol=1e-4, atol=1e-5)
        together, last, outside = module.rollout(x0, w, s)
        torch.testing.assert_close(together, torch.stack(path, dim=1), rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(last, theirs, rtol=1e-4, atol=1e-5)
        assert outside.shape == (batch, steps)
        empty = module.initial_state(batch)
    assert torch.equal(empty, torch.zeros(batch, exported.card["memory"]))


def test_bad_inputs_and_memories_give_a_flag_and_finite_numbers(exported: Exported) -> None:
    check_bad_inputs(exported.module, exported.spec, exported.model, cases=100)


def test_everything_is_single_precision(exported: Exported) -> None:
    module = exported.module
    x, w = drives(2, 4)
    with torch.no_grad():
        s = module.initial_state(2)
        after, memory, outside = module.step(x, w[:, 0], s)
        path, _, _ = module.rollout(x, w, s)
        warm = module.warmup(x[:, None].expand(-1, 4, -1), w)
    assert {tensor.dtype for tensor in (s, after, memory, path, warm)} == {torch.float32}
    assert outside.dtype == torch.bool
    numbers = [value for value in exported.model.state_dict().values() if value.is_floating_point()]
    assert {value.dtype for value in numbers} == {torch.float32}
    assert exported.card["dtype"] == "float32"


def test_outside_flags_each_channel_beyond_its_range(lstm: Exported) -> None:
    module = lstm.module
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    middle = 0.5 * (low + high)
    # rows: the middle, both corners, then each channel just below and just above its range
    seen = [middle, low, high]
    for i in range(len(LOW)):
        for edge, step in ((low, -1e-3), (high, 1e-3)):
            row = middle.clone()
            row[i] = edge[i] + step
            seen.append(row)
    rows = torch.stack(seen)
    x = torch.cat((torch.full((len(rows), 3), 6e3), rows[:, :3]), dim=1)
    _, _, outside = module.step(x, rows[:, 3:], module.initial_state(len(rows)))
    assert outside.tolist() == [False] * 3 + [True] * (2 * len(LOW)), (
        "position and heading have no training range"
    )


def test_the_card_says_what_a_controller_needs(exported: Exported) -> None:
    card, spec = exported.stored, exported.spec
    assert card == json.loads(json.dumps(exported.card)), (
        "the file holds the card that was returned"
    )
    assert card["schema"] == "residnet.card/1"
    units = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
    assert card["states"] == [{"name": name, "unit": unit} for name, unit in units.items()]
    assert card["inputs"] == [
        {"name": "n_port", "unit": "1/s", "role": "command"},
        {"name": "n_stbd", "unit": "1/s", "role": "command"},
        {"name": "wind_speed", "unit": "m/s", "role": "exogenous"},
        {"name": "wind_dir", "unit": "rad", "role": "exogenous"},
    ]
    assert (card["dt"], card["integrator"], card["model"]) == (0.1, "rk4", "mine")
    names = ("u", "v", "r", "n_port", "n_stbd", "wind_speed", "wind_dir")
    assert card["training_range"] == {
        name: [low, high] for name, low, high in zip(names, LOW, HIGH, strict=True)
    }
    assert card["metrics"] == [ROW]
    assert card["memory"] == exported.model.n_state
    assert card["head"]["kind"] == spec.head.kind  # type: ignore[union-attr]
    assert card["baseline"]["kind"] == "regressors"
    assert card["members"] == []
    assert card["versions"]["torch"] == torch.__version__
    assert "code" in card["safety"]
    assert "start" in card["inputs_held"]


def test_an_ensemble_exports_and_names_its_members(tmp_path: Path) -> None:
    parts = [built("mlp"), built("lstm")]
    members = [
        spec.model_copy(update={"name": name})
        for (spec, _), name in zip(parts, ("one", "two"), strict=True)
    ]
    spec = spec_of(None, role="ensemble", baseline={"kind": "still"}).model_copy(
        update={"members": tuple(members)}
    )
    card = export_torchscript(
        spec, mean_of([model for _, model in parts]), tmp_path / "mean.pt", []
    )
    assert [(member["name"], member["head"]["kind"]) for member in card["members"]] == [
        ("one", "mlp"),
        ("two", "lstm"),
    ]
    assert max(card["parity"]["share_of_range"].values()) <= 1e-5


def test_a_changed_weight_is_found(lstm: Exported) -> None:
    assert max(check_parity(lstm.spec, lstm.model, lstm.module).values()) <= 1e-5
    other = copy.deepcopy(lstm.model)
    with torch.no_grad():
        other.head.networks[0].readout[0].bias[2] += 1e-3  # type: ignore[union-attr, index]
    with pytest.raises(
        ExportError, match=r"model mine: the exported module differs .* allowed 1e-05"
    ) as caught:
        check_parity(lstm.spec, other, lstm.module)
    assert "\n" not in str(caught.value)


class NotFinite:
    """An exported module whose rollout alone goes wrong, in the last channel."""

    def __init__(self, module: Any) -> None:
        self.warmup, self.step, self.good = module.warmup, module.step, module.rollout

    def rollout(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        out, s, outside = self.good(x, w, s)
        out[:, -1, 5] = torch.nan
        return out, s, outside


def test_a_value_that_is_not_finite_is_found(lstm: Exported) -> None:
    with pytest.raises(ExportError, match="differs from the model"):
        check_parity(lstm.spec, lstm.model, NotFinite(lstm.module))


def test_a_file_that_differs_from_its_model_does_not_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is written is read back and compared before it takes its place."""
    spec, model = built("mlp")
    _, other = built("mlp_mirror")
    wrong = torch.jit.script(torchscript.ExportedModel(other.float().eval(), spec).eval())
    save = torch.jit.save
    monkeypatch.setattr(
        torch.jit,
        "save",
        lambda module, path, _extra_files: save(wrong, path, _extra_files=_extra_files),
    )
    with pytest.raises(ExportError, match="model mine"):
        export_torchscript(spec, model, tmp_path / "mine.pt", [])
    assert not (tmp_path / "mine.pt").exists()
