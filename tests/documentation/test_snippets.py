"""What README and documentation show is valid: YAML is read, commands and files exist, links lead.

Python and shell blocks that a comment `not run: <reason>` precedes or begins are not carried out;
their commands and options are checked all the same. Shell blocks that a comment `run: a test does,
on the demo's logs` precedes are carried out in the long stage.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.main import get_command

import residnet
from residnet.cli import app
from residnet.core.config import load_config, load_mapping, validate
from residnet.physics.vessel import VesselConfig
from residnet.tasks.registry import TaskConfig, load_task

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"(?:<!-- (?P<mark>not run|run): (?P<why>[^>]*) -->\n)?```(?P<kind>\w+)\n(?P<text>.*?)```", re.S
)
TEXT = "\n".join(page.read_text() for page in PAGES)
NAMED = sorted(set(re.findall(r"residnet run ((?!configs\b)[a-z_0-9]+)\b(?!\.)", TEXT)))
FILES = sorted(set(re.findall(r"residnet (?:run|check) (configs/[\w./-]+\.yaml)", TEXT)))


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    number: int
    kind: str
    text: str
    why: str | None
    run: bool

    def __str__(self) -> str:
        return f"{self.page}:{self.number}"


def blocks() -> list[Block]:
    found = []
    for page in PAGES:
        for number, match in enumerate(FENCE.finditer(page.read_text())):
            first = re.match(r"# not run: (.*)", match["text"])
            why = match["why"] or (first[1] if first else None)
            name = page.relative_to(ROOT).as_posix()
            run = match["mark"] == "run"
            found.append(Block(name, number, match["kind"], match["text"], why, run))
    return found


BLOCKS = blocks()


def of_kind(kind: str) -> list[Any]:
    return [pytest.param(block, id=str(block)) for block in BLOCKS if block.kind == kind]


def test_pages_show_what_they_should() -> None:
    assert {"sh", "yaml", "python"} <= {block.kind for block in BLOCKS}
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90


@pytest.mark.parametrize("block", of_kind("yaml"))
def test_yaml_is_read(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT / "configs")  # a config that names another means a shipped one
    path = tmp_path / "shown.yaml"
    path.write_text(block.text)
    content = load_mapping(path)
    if "task" in content:
        if content.get("data", {}).get("kind") == "measured":
            content["data"]["split"]["root"] = str(tmp_path)  # the logs are the reader's own
        assert validate(content, TaskConfig, str(block)).task == content["task"]
    elif block.text.startswith("# fragment: "):
        assert fragment(block.text).task == "fit"
    else:
        assert load_config(path, [], VesselConfig).build().commands > 0


def fragment(text: str) -> Any:
    """Validate part of a fit's config inside a complete one."""
    place = re.match(r"# fragment: (.*)", text)
    assert place is not None
    whole = yaml.safe_load(
        next(b.text for b in BLOCKS if b.kind == "yaml" and "kind: measured" in b.text)
    )
    part = yaml.safe_load(text)
    if place[1] == "data.reader":
        joined = part["kind"] == "joined"
        for reader in part["parts"].values() if joined else [part]:
            whole["data"]["reader"]["channels"] |= reader["channels"]
            whole["data"]["reader"]["time"] = reader["time"]
        whole["data"]["reader"] = part if joined else whole["data"]["reader"]
    elif place[1] == "prepare":
        whole["prepare"] |= part
    else:
        whole |= part
        whole["signals"]["exogenous"] = ["wind_speed", "wind_dir"]
    return validate(whole, TaskConfig, text)


@pytest.mark.parametrize("block", of_kind("sh"))
def test_commands_exist(block: Block) -> None:
    group = get_command(app)
    for line in re.sub(r"\\\n", " ", block.text).splitlines():
        words = shlex.split(line, comments=True)
        for word in words:
            if re.fullmatch(r"(scripts|configs|examples|docs)/[\w./-]+", word) and "*" not in word:
                assert (ROOT / word).exists(), f"{block}: {word} does not exist"
        if words[:1] != ["residnet"]:
            continue
        command = group.commands.get(words[1])  # type: ignore[attr-defined]
        assert command is not None, f"{block}: residnet has no command {words[1]}"
        options = {name for parameter in command.params for name in parameter.opts}
        for word in words[2:]:
            if re.match(r"-{1,2}[a-z]", word):
                assert word in options, f"{block}: {words[1]} has no option {word}"


@pytest.mark.parametrize("name", NAMED)
def test_named_configs_come_with_residnet(name: str) -> None:
    assert any(path.stem == name for path in (ROOT / "configs").rglob("*.yaml"))


@pytest.mark.parametrize("name", FILES)
def test_config_files_that_are_named_are_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = "train: [a.csv]\nvalidation: [b.csv]\ntest: [c.csv]\n"
    (tmp_path / "esso_osaka").mkdir()
    (tmp_path / "esso_osaka" / "split.yaml").write_text(split)
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    assert load_task(ROOT / name, []).name


@pytest.mark.parametrize("block", of_kind("python"))
def test_python_is_right(block: Block) -> None:
    tree = ast.parse(block.text)
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "residnet"
    }
    assert used <= set(dir(residnet)), f"{block}: residnet has no {used - set(dir(residnet))}"


@pytest.mark.long
def test_the_head_of_contributing_keeps_the_contract(tmp_path: Path) -> None:
    block = next(b for b in BLOCKS if b.page == "CONTRIBUTING.md" and "BrakeConfig" in b.text)
    (tmp_path / "brake.py").write_text(block.text)
    about = tmp_path / "brake-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: brake\nVersion: 1.0\n")
    points = "[residnet.heads]\nbrake = brake:BrakeConfig\n"
    (about / "entry_points.txt").write_text(points)
    source = Path(residnet.__file__).parents[1]
    lines = [
        "from brake import BrakeConfig",
        "from residnet.testing import check_head",
        "check_head(BrakeConfig())",
    ]
    run = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(source), str(tmp_path)))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr


CARRIED_OUT = sorted({block.page for block in BLOCKS if block.run})


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of the demo in the folders that the pages name, a config and a finished run of them."""
    folder = tmp_path_factory.mktemp("pages")
    assert residnet_in(folder, "demo", "demo") == 0
    for name in ("trials", "my_logs", "my_logs/zigzag", "more_logs", "new_logs"):
        (folder / name).mkdir()
        # of runs at constant commands nothing is learned, and holding the velocities beats all
        for log in sorted((folder / "demo" / "csv").glob("zigzag_*.csv")):
            shutil.copy(log, folder / name)
    assert residnet_in(folder, "new", "trials", "--out", "my_boat.yaml") == 0
    quicken(folder / "my_boat.yaml")
    assert residnet_in(folder, "run", "my_boat.yaml") == 0
    return folder


def residnet_in(folder: Path, *words: str) -> int:
    """Return the exit code of a command; what it says is shown where a test fails."""
    command = [sys.executable, "-m", "residnet", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    print(shlex.join(words), done.stdout[-800:], done.stderr[-800:])
    return done.returncode


def quicken(config: Path) -> None:
    """Train for a third of the usual time: a mean that is worse than zero would not be exported."""
    config.write_text(f"{config.read_text()}\neffort: 0.3\n")


@pytest.mark.long
@pytest.mark.parametrize("page", CARRIED_OUT)
def test_commands_of_a_page_run_on_the_logs_of_the_demo(
    page: str, workspace: Path, tmp_path: Path
) -> None:
    shutil.copytree(workspace, tmp_path, dirs_exist_ok=True)
    shown = [block.text for block in BLOCKS if block.page == page and block.run]
    runs = "".join(shown)
    if "residnet new" in runs:
        (tmp_path / "my_boat.yaml").unlink()
    if "residnet run" in runs:
        shutil.rmtree(tmp_path / "runs")
    for line in "".join(shown).replace("\\\n", " ").splitlines():
        words = [
            str(path.relative_to(tmp_path))
            for word in shlex.split(line, comments=True)
            for path in (sorted(tmp_path.glob(word)) if "*" in word else [tmp_path / word])
        ]
        if words[:2] == ["residnet", "run"]:
            quicken(tmp_path / "my_boat.yaml")
        # the doctor and the monitor say with 1 that they found something
        found = {0, 1} if words[1:2] in (["inspect"], ["monitor"]) else {0}
        assert not words or residnet_in(tmp_path, *words[1:]) in found, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_and_links_exist(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"`((?:configs|scripts|src|examples)/[\w./-]+)`", text):
        assert (ROOT / name).exists(), f"{page.name} names {name}"
    if page.name in ("README.md", "CONTRIBUTING.md"):
        for link in re.findall(r"\]\((?!http)([^)#]+)", text):
            assert (page.parent / link).exists(), f"{page.name} links to {link}"
