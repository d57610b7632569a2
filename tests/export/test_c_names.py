"""C exports by the names of their files: linked side by side, told apart by build, measured before
they are written.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from exported_models import built

from residnet.core.errors import UsageError
from residnet.core.progress import Progress, on_progress
from residnet.core.version import __version__
from residnet.engine import c_code
from residnet.engine.c_code import find_compiler
from residnet.evaluation.assessment import Assessment, CardFinding, name_splits
from residnet.export import c, get_exporter
from residnet.export import vessel as exported_vessel
from residnet.export.c import (
    STRICT_FLAGS,
    measure_c_export,
    measure_footprint,
    to_c_identifier,
)
from residnet.export.vessel import ExportedVessel
from residnet.tasks.fit import execute

pytestmark = pytest.mark.usefixtures("short_parity")


def vessel(scale: float = 1.0) -> ExportedVessel:
    """A model called mine, as that of another run is, with other coefficients."""
    spec, model = built("plsr")
    with torch.no_grad():
        model.baseline.theta.mul_(scale)  # type: ignore[operator, union-attr]
    return ExportedVessel(spec, model)


MAIN = """
#include <stdio.h>
#include "steer.h"
#include "2nd Öl.h"

int main(void)
{
    float x[STEER_STATES] = {0, 0, 0, 1, 0, 0}, w[STEER_INPUTS] = {9, 9, 3, 1}, s[1] = {0};
    float y[M_2ND__L_STATES] = {0, 0, 0, 1, 0, 0};
    steer_step(x, w, s, x, s);
    m_2nd__l_step(y, w, s, y, s);
    printf("%.9g %.9g %s %s", x[3], y[3], STEER_BUILD, M_2ND__L_BUILD);
    return 0;
}
"""
LINKS = {
    "objects": [["{cc}", "-c", "steer.c", "2nd Öl.c"],
                ["{cc}", "main.c", "steer.o", "2nd Öl.o", "-o", "main", "-lm"]],
    "static libraries": [["{cc}", "-c", "steer.c", "2nd Öl.c"],
                         ["ar", "rcs", "liba.a", "steer.o"],
                         ["ar", "rcs", "libb.a", "2nd Öl.o"],
                         ["{cc}", "main.c", "-L.", "-la", "-lb", "-o", "main", "-lm"]],
    "one translation unit": [["{cc}", "all.c", "-o", "main", "-lm"]],
}  # fmt: skip


MODELS = {"steer.c": 1.0, "2nd Öl.c": 0.5}
"""Scale of the coefficients of the model in each file."""
WARNED = "2nd Öl.c"
"""File whose export exceeds the limits of stack and code."""


class TwoExports(NamedTuple):
    """The folder of the C files of `MODELS`, their cards, and the messages of each export.

    A message has a flag that says whether the file existed by then.
    """

    folder: Path
    cards: dict[str, dict[str, Any]]
    messages: dict[str, list[tuple[str, bool]]]


@pytest.fixture(scope="module")
def two_exports(tmp_path_factory: pytest.TempPathFactory) -> TwoExports:
    """The exports of `MODELS`; the limits of the second one are so small that it warns."""
    folder = tmp_path_factory.mktemp("two_exports")
    exports = TwoExports(folder, {}, {})
    for name, scale in MODELS.items():
        messages: list[tuple[str, bool]] = []

        def add_message(
            progress: Progress,
            messages: list[tuple[str, bool]] = messages,
            file: Path = folder / name,
        ) -> None:
            messages.append((progress.message, file.exists()))

        with pytest.MonkeyPatch.context() as patch, on_progress(add_message):
            if name == WARNED:
                patch.setattr(c, "STACK_LIMIT", 10)
                patch.setattr(c, "CODE_LIMIT", 20)
            exports.cards[name] = export_quickly(vessel(scale), folder / name)
        exports.messages[name] = messages
    return exports


@pytest.fixture(scope="module")
def lstm_export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C file of a model with a memory."""
    file = tmp_path_factory.mktemp("lstm") / "boat.c"
    export_quickly(ExportedVessel(*built("lstm")), file)
    return file


def export_quickly(made: ExportedVessel, file: Path) -> dict[str, Any]:
    """Write a C file, compared with the model over few steps as in `short_parity`.

    Returns:
        The card of the file.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exported_vessel, "PARITY_STEPS", 60)
        return dict(get_exporter("c").export(made, file))


@pytest.mark.parametrize("way", LINKS)
def test_two_exports_of_one_model_name_serve_one_program(
    way: str, two_exports: TwoExports, tmp_path: Path
) -> None:
    shutil.copytree(two_exports.folder, tmp_path, dirs_exist_ok=True)
    models = [vessel(scale) for scale in MODELS.values()]
    cards = [json.loads((tmp_path / name).with_suffix(".card.json").read_text()) for name in MODELS]
    (tmp_path / "main.c").write_text(MAIN)
    parts = ("steer.c", "2nd Öl.c", "main.c")
    (tmp_path / "all.c").write_text("".join(f'#include "{part}"\n' for part in parts))
    for command in LINKS[way]:
        call = [word.format(cc=find_compiler()) for word in command]
        flags = STRICT_FLAGS if command[0] == "{cc}" else ()
        subprocess.run([*call, *flags], cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "main"], capture_output=True, text=True).stdout.split()
    x, w = torch.tensor([[0.0, 0, 0, 1, 0, 0]]), torch.tensor([[9.0, 9, 3, 1]])
    for found, made in zip(printed[:2], models, strict=True):
        with torch.no_grad():
            after, _ = made.to_precision(torch.float32).step(x, w, x[:, :0])
        assert float(found) == pytest.approx(float(after[0, 3]), rel=1e-6)
    assert printed[0] != printed[1]
    assert printed[2:] == [card["build"]["identity"] for card in cards]
    assert printed[2] != printed[3]


def defined_symbols(library: Path) -> set[str]:
    lines = subprocess.run(["nm", "-g", library], capture_output=True, text=True).stdout
    return set(re.findall(r" [TDBRC] (\w+)", lines))


def test_every_name_begins_with_that_of_the_file(two_exports: TwoExports, tmp_path: Path) -> None:
    call = [find_compiler(), "-c", "2nd Öl.c", "-o", str(tmp_path / "boat.o")]
    subprocess.run(call, cwd=two_exports.folder, check=True)
    symbols = defined_symbols(tmp_path / "boat.o")
    assert f"{to_c_identifier('2nd Öl')}_step" in symbols
    assert all(name.startswith("m_2nd__l_") for name in symbols)
    header = (two_exports.folder / "2nd Öl.h").read_text()
    assert "#ifndef M_2ND__L_H\n#define M_2ND__L_H\n" in header
    macros = re.findall(r"^#define (\w+)", header, re.M)
    assert all(name.startswith("M_2ND__L_") for name in macros)
    with pytest.raises(UsageError, match=r"math\.c: its header math\.h would hide"):
        get_exporter("c").export(vessel(), tmp_path / "math.c")
    assert not (tmp_path / "math.c").exists()


def test_the_build_identity_is_of_the_model_and_the_version(
    two_exports: TwoExports, tmp_path: Path
) -> None:
    first = vessel().build()
    second = vessel(0.5).build()
    assert first == vessel().build()
    assert first["model_sha256"] != second["model_sha256"]
    assert first["identity"] == f"{__version__}+{first['model_sha256'][:16]}"
    for name, build in zip(MODELS, (first, second), strict=True):
        file = two_exports.folder / name
        stored_card = json.loads(file.with_suffix(".card.json").read_text())
        assert stored_card["build"] == two_exports.cards[name]["build"] == build
        for suffix in (".c", ".h"):
            assert build["identity"] in file.with_suffix(suffix).read_text()
    # a header of another export is refused by the compiler
    header = (two_exports.folder / "2nd Öl.h").read_text()
    header = header.replace("M_2ND__L_", "STEER_").replace("m_2nd__l_", "steer_")
    (tmp_path / "steer.h").write_text(header)
    shutil.copy(two_exports.folder / "steer.c", tmp_path)
    call = [find_compiler(), "-c", "steer.c"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode != 0
    assert "steer.h belongs to another export than this file" in done.stderr


def test_stack_and_size_are_reported_before_the_file_is_written(
    two_exports: TwoExports,
) -> None:
    heard = two_exports.messages["steer.c"]
    assert len(heard) == 1
    card = two_exports.cards["steer.c"]["size"]
    stack = card["largest_stack_bytes"]
    code = card["code_bytes"]
    for word in (f"{stack:,} bytes of stack", f"{code:,} bytes of code", "-fstack-usage", "size"):
        assert word in heard[0][0]
    # a step of a small model takes between a nanosecond and a millisecond
    assert 1e-9 < card["step_seconds"] < 1e-3
    assert " us per step" in heard[0][0]
    assert not heard[0][1]
    assert card["warnings"] == []
    # warmup calls measured and step, when there is a memory; here step alone is the deepest
    assert stack == max(card["stack_bytes"].values())
    heard = two_exports.messages[WARNED]
    assert [stood for _, stood in heard] == [False] * 3
    assert "bytes of stack exceed 10" in heard[1][0]
    assert "of code and constants exceed 20" in heard[2][0]
    warnings = two_exports.cards[WARNED]["size"]["warnings"]
    assert [f"  warning: {warning}" for warning in warnings] == [text for text, _ in heard[1:]]


def test_the_stack_of_a_call_holds_that_of_the_functions_that_it_calls(lstm_export: Path) -> None:
    size = measure_footprint(lstm_export)
    own = size["stack_bytes"]
    called = max(own["boat_step"], own["boat_measured"])
    assert size["largest_stack_bytes"] == own["boat_warmup"] + called


def tools(folder: Path, wanted: Sequence[str]) -> str:
    """A path with a compiler that does not know -fstack-usage, and with `size` where wanted."""
    folder.mkdir()
    check = 'for word; do [ "$word" != -fstack-usage ] || exit 1; done'
    script = f'#!/bin/sh\n{check}\nexec {find_compiler()} "$@"\n'
    for name in wanted:
        if name == "cc":
            (folder / "cc").write_text(script)
            (folder / "cc").chmod(0o755)
        else:
            found = shutil.which(name)
            assert found is not None
            (folder / name).symlink_to(found)
    return str(folder)


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (0.98, r"2.0 % higher than the ensemble's \(within one"),
        (0.5, r"100.0 % higher .* \(beyond one"),
    ],
)
def test_the_single_model_is_proposed_with_its_size(
    ratio: float, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = {"hull": built("ridge")}
    row = SimpleNamespace(model="ensemble", ratio=ratio, standard_error=0.05)
    selection = SimpleNamespace(models=[row])
    monkeypatch.setattr(execute, "load_model", lambda path: models[path.name])
    monkeypatch.setattr(execute, "RunFiles", lambda path: SimpleNamespace(selection=selection))
    run: Any = SimpleNamespace(path=tmp_path / "my_boat", models=tmp_path / "my_boat" / "models")
    text = execute.describe_single_model(run, "ensemble", "hull", 1_000_000)
    size = measure_c_export(ExportedVessel(*models["hull"]))
    assert f"{size['code_bytes']:,} bytes of code" in text
    assert f"(1/{1_000_000 / size['code_bytes']:.0f} of the ensemble)" in text
    # float state of six numbers, and the memory of the model
    n_memory = models["hull"][1].n_state
    assert size["memory_bytes"] == 4 * (6 + n_memory)
    assert re.search(words, text)
    assert text.endswith("my_boat --format c --model selected")


@pytest.mark.parametrize("known", [["cc", "size"], ["cc"], []])
def test_what_the_tools_do_not_measure_is_estimated_and_said_so(
    known: list[str], lstm_export: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = measure_footprint(lstm_export)
    path = tools(tmp_path / "bin", known)
    found = {name: f"{path}/{name}" for name in known}
    monkeypatch.delenv("CC", raising=False)
    for module in (c, c_code):
        monkeypatch.setattr(module.shutil, "which", found.get)
    size = measure_footprint(lstm_export)
    assert size["stack_from"] == "estimate"
    assert (size["code_from"] == "estimate") == ("size" not in known)
    assert size["stack_bytes"].keys() == measured["stack_bytes"].keys()
    # within a factor of four of what a compiler measures, never far below it
    for key in ("largest_stack_bytes", "code_bytes"):
        assert 0.5 * measured[key] <= size[key] <= 4.0 * measured[key], key


KNOWN = Assessment(
    level="limited",
    verdict=("After a 40 s free run the position error is 8.6 m.", "Two logs were checked."),
    findings=(
        CardFinding(log="zigzag_1", level="will mislead", code="lag", text="r lags", action=""),
    ),
    split=name_splits(
        [
            ("train", "zigzag_1"),
            ("train", "zigzag_2"),
            ("validation", "turn_1"),
            ("test", "turn_2"),
        ]
    ),
)


def test_a_card_has_verdict_findings_and_split() -> None:
    """Of an assessment; `test_cards` reads them in the file of every format."""
    made = vessel()
    made.assessment = KNOWN
    card = made.build_card()
    assert (card["level"], card["verdict"]) == ("limited", list(KNOWN.verdict))
    assert card["findings"] == [dict(row) for row in KNOWN.findings or ()]
    assert card["split"] == {
        "identification": ["zigzag_1", "zigzag_2"],
        "validation": ["turn_1"],
        "test": ["turn_2"],
    }
    made.assessment = None
    assert (made.build_card()["level"], made.build_card()["verdict"]) == (None, [])
    assert (made.build_card()["findings"], made.build_card()["split"]) == (None, None)
