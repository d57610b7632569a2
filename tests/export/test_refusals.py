"""What no format writes: models that are no models, whatever file they would go into."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from exported_models import VARIANTS, built, spec_of
from tiny import TINY, call

from residnet.core.errors import ExportError, ResidnetError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, save_model
from residnet.export import FORMATS as REGISTERED
from residnet.export import exporter, vessel
from residnet.export.vessel import ExportedVessel

FORMATS = REGISTERED.names()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A folder that looks like a finished fit with one model."""
    import yaml

    spec, model = built("plsr")
    folder = tmp_path / "run"
    save_model(folder / "models" / "mine", spec, model)
    (folder / "resolved.yaml").write_text(yaml.safe_dump(TINY))
    (folder / "metrics.json").write_text(json.dumps({"selected": "mine", "rows": []}))
    (folder / "summary.json").write_text(
        json.dumps({"task": "fit", "finished": True, "verdict": ["made"], "figures": {}})
    )
    return folder


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_number_that_is_not_finite_is_refused(name: str, value: float, tmp_path: Path) -> None:
    spec, model = built("plsr")
    with torch.no_grad():
        model.baseline.theta[0, 1] = value  # type: ignore[index, operator]
    file = tmp_path / f"boat{exporter(name).suffix}"
    with pytest.raises(ResidnetError) as caught:
        exporter(name).export(ExportedVessel(spec, model), file)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def foreign(data: bytes) -> bytes:
    """Return a description of a schema to come, which nobody edited."""
    content = json.loads(data) | {"schema": "residnet.model/9"}
    del content["description_sha256"]
    return json.dumps(content).encode()


@pytest.mark.parametrize("name", ["torchscript", "c", "parameters"])
@pytest.mark.parametrize(
    ("part", "change", "words"),
    [
        ("model.safetensors", lambda data: data[:-1] + bytes([data[-1] ^ 1]), "SHA-256"),
        ("model.json", lambda data: foreign(data), "holds 'residnet.model/9'"),
        ("model.json", lambda data: data[: len(data) // 2], "model.json"),
    ],
    ids=["another hash", "another schema", "cut off"],
)
def test_an_edited_model_is_refused(
    name: str,
    part: str,
    change: object,
    words: str,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = run / "models" / "mine" / part
    file.write_bytes(change(file.read_bytes()))  # type: ignore[operator]
    out = run.parent / f"boat{exporter(name).suffix}"
    code = call(monkeypatch, "export", run, "--model", "mine", "--format", name, "--out", out)
    said = capsys.readouterr().err.strip()
    assert code in (1, 2)
    assert words in said
    assert len(said.splitlines()) == 1
    assert {path.name for path in run.parent.iterdir()} == {"run"}


@pytest.mark.exporters
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "aoti"])
@pytest.mark.parametrize("variant", [*VARIANTS, "none"])
def test_a_format_writes_a_model_or_says_why_not(
    name: str, variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 40)
    spec = spec_of(None)
    spec, model = (spec, spec.build()) if variant == "none" else built(variant)
    file, said = tmp_path / f"boat{exporter(name).suffix}", ""
    try:
        exporter(name).export(ExportedVessel(spec, model), file)
    except ResidnetError as error:
        said = str(error).splitlines()[-1]
        assert spec.name in said
    assert file.is_file() == (not said)
    assert bool(list(tmp_path.iterdir())) == (not said)


def swept(spec: ModelSpec, model: HybridDynamics) -> float:
    """Return the share of the training range that the inputs of the free run sweep at most."""
    _, w, _ = ExportedVessel(spec, model).free_run(torch.float64)
    n = spec.signals.live.size
    low, high = torch.tensor(spec.low[n:]), torch.tensor(spec.high[n:])
    return float(((w[0].amax(dim=0) - w[0].amin(dim=0)) / (high - low)).max())


def test_inputs_that_ask_for_too_much_together_sweep_less() -> None:
    """Inputs were logged one at a time; together they leave the states that logs hold."""
    spec, model = built("plsr")
    assert swept(spec, model) == pytest.approx(0.8, abs=0.01)
    n = spec.signals.live.size
    low, high = ((*b[:n], *(3.0 * value for value in b[n:])) for b in (spec.low, spec.high))
    wide = spec.model_copy(update={"low": low, "high": high})
    assert swept(wide, model) in (pytest.approx(0.4, abs=0.01), pytest.approx(0.2, abs=0.01))


def test_a_model_that_diverges_under_any_sweep_is_refused() -> None:
    spec, model = built("plsr")
    with torch.no_grad():
        model.baseline.theta[0].abs_()  # type: ignore[index, operator]
    with pytest.raises(ExportError, match=r"diverges .* accepted .* choose another model"):
        swept(spec, model)
