"""What README and documentation show is valid: YAML is read, commands and files exist, links lead.

The long stage carries out each page's blocks of shell, Python and C in their order, on logs of the
demo and with less training, but for those that `NOT_RUN` names.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import readability
import short_configs
import yaml
from tiny import call
from typer.main import get_command

import residnet
from residnet.cli import app
from residnet.core.config import load_config, load_mapping, validate_config
from residnet.physics.vessel import VesselConfig
from residnet.tasks.registry import TaskConfig

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"```(?P<kind>\w+)\n(?P<text>.*?)```", re.S)
TEXT = "\n".join(page.read_text() for page in PAGES)
NAMED = set(re.findall(r"residnet run ((?!configs\b|examples\b)[a-z_0-9]+)\b(?!\.)", TEXT))


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    number: int
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.number}"


BLOCKS = [
    Block(page.relative_to(ROOT).as_posix(), number, match["kind"], match["text"])
    for page in PAGES
    for number, match in enumerate(FENCE.finditer(page.read_text()))
]


def of_kind(kind: str) -> list[Any]:
    return [pytest.param(block, id=str(block)) for block in BLOCKS if block.kind == kind]


def test_pages_show_what_they_should() -> None:
    assert {"sh", "yaml", "python"} <= {block.kind for block in BLOCKS}
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90
    assert {path.stem for path in (ROOT / "configs").rglob("*.yaml")} >= NAMED
    assert all(re.search(rf"^{re.escape(line)}", TEXT, re.M) for line in NOT_RUN)


def test_the_data_flow_lies_within_its_picture() -> None:
    text = (ROOT / "docs" / "chain.svg").read_text()
    size = re.search(r'viewBox="0 0 (\d+) (\d+)"', text)
    assert size is not None
    width, height = map(float, size.groups())
    boxes = re.findall(r'<rect x="(\d+)" y="(\d+)" width="(\d+)" height="(\d+)"', text)
    assert len(boxes) == 6
    for x, y, box_width, box_height in (map(float, box) for box in boxes):
        # half the width of the outline, and the same margin on both sides
        assert 20 <= x <= width - box_width - 20
        assert 20 <= y <= height - box_height - 20


MAX_DOCUMENTATION_WORDS = 30_000
"""Of the pages written by hand: those of `docs/reference` are generated from code."""


def test_the_documentation_is_short_enough_to_read() -> None:
    pages = [page for page in (ROOT / "docs").rglob("*.md") if page.parent.name != "reference"]
    n_words = sum(len(page.read_text().split()) for page in pages)
    assert len(pages) > 40
    assert n_words <= MAX_DOCUMENTATION_WORDS


GUIDES = [page for page in PAGES if page.parent.name in ("howto", "tutorials", "results")]
MAX_WORDS = 60
"""Of prose above the first table, picture or example."""


@pytest.mark.parametrize("page", [pytest.param(page, id=page.stem) for page in GUIDES])
def test_guide_begins_with_table_picture_or_example(page: Path) -> None:
    _, _, body = page.read_text().partition("\n\n")
    prose = re.split(r"(?m)^(?:\||!\[|```)", body)[0]
    assert prose != body
    assert len(re.sub(r"<!--.*?-->", "", prose).split()) <= MAX_WORDS


@pytest.mark.parametrize("block", of_kind("yaml"))
def test_yaml_is_read(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT / "configs")  # a config that names another means a shipped one
    path = tmp_path / "shown.yaml"
    path.write_text(block.text)
    content = load_mapping(path)
    if "task" in content:
        if content.get("data", {}).get("kind") == "measured":
            content["data"]["split"]["root"] = str(tmp_path)  # the logs are the reader's own
        assert validate_config(content, TaskConfig, str(block)).task == content["task"]
    elif block.text.startswith("# fragment: "):
        assert fragment(block.text).task == "fit"
    else:
        assert load_config(path, [], VesselConfig).build().n_commands > 0


@pytest.mark.long
@pytest.mark.parametrize("command", ["check", "run"])
def test_the_short_config_of_the_readme_is_complete(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    block = next(b for b in BLOCKS if b.page == "README.md" and b.kind == "yaml")
    (tmp_path / "short.yaml").write_text(block.text)
    words = (
        ("run", "short.yaml", "-s", "effort=0.05") if command == "run" else ("check", "short.yaml")
    )
    assert call(monkeypatch, *words) == 0
    if command == "run":
        rows = json.loads((tmp_path / "runs" / "my_boat" / "metrics.json").read_text())["rows"]
        assert {"plsr", "mlp", "lstm"} <= {row["model"] for row in rows}


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
    return validate_config(whole, TaskConfig, text)


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
        # commands of a wing are imported when they are asked for
        command = group.get_command(None, words[1])  # type: ignore[attr-defined]
        assert command is not None, f"{block}: residnet has no command {words[1]}"
        options = {name for parameter in command.params for name in parameter.opts}
        for word in words[2:]:
            if re.match(r"-{1,2}[a-z]", word):
                assert word in options, f"{block}: {words[1]} has no option {word}"


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


CONTRIBUTED_PARTS = {
    "head": ("brake", "BrakeConfig", "check_head(BrakeConfig())"),
    "baseline": ("drag", "DragConfig", "check_baseline(DragConfig())"),
    "reader": (
        "keel",
        "KeelConfig",
        "check_reader(KeelConfig(channels=channels), Path('log.keel'))",
    ),
}
KEEL_CHANNELS = {"u": ("u", "kn"), "r": ("r", "deg/s"), "n": ("n", "1/min")}


@pytest.mark.long
@pytest.mark.parametrize("kind", CONTRIBUTED_PARTS)
def test_example_of_contributing_fulfils_its_contract(kind: str, tmp_path: Path) -> None:
    name, config, check = CONTRIBUTED_PARTS[kind]
    block = next(b for b in BLOCKS if b.page == "CONTRIBUTING.md" and f"class {config}" in b.text)
    (tmp_path / f"{name}.py").write_text(block.text)
    about = tmp_path / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[residnet.{kind}s]\n{name} = {name}:{config}\n")
    rows = [f"{0.1 * k},{3 + 0.1 * (k % 7)},0.1,{k % 5},{100 + k}" for k in range(100)]
    (tmp_path / "log.keel").write_text("\n".join(rows))
    source = Path(residnet.__file__).parents[1]
    lines = [
        "from pathlib import Path",
        f"from {name} import {config}",
        "from residnet.io.readers.quantities import FieldMap",
        "from residnet.testing import check_baseline, check_head, check_reader",
        f"fields = {KEEL_CHANNELS}",
        "channels = {n: FieldMap(field=f, unit=u) for n, (f, u) in fields.items()}",
        check,
    ]
    path = os.pathsep.join((str(source), str(tmp_path)))
    run = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr


NOT_RUN = {
    "bash scripts/quickstart.sh": "installs packages from a registry; .ci/run and wheel.sh do",
    "bash scripts/test.sh": "runs the tests, and so itself",
    "sim_vehicle.py": "comes with ArduPilot",
    "colcon build": "comes with ROS 2; a test compiles the node and steps it",
    "from my_package": "is the reader's own; examples/residnet_sample is tested in its place",
}
"""Beginning of a line -> why the block with it is not carried out."""
ELSEWHERE = {
    "docs/tutorials/first_hour.md": "a test of its own follows it and compares its numbers",
    "docs/howto/extend.md": "its only blocks need a package of the reader",
    **dict.fromkeys(
        (page for page in {block.page for block in BLOCKS} if page.startswith("docs/results/")),
        "hours of runs, each beside its figures; the stage `configs` runs their configs",
    ),
}
"""Page -> why its blocks are not carried out here."""
PAGES_RUN = sorted(
    {block.page for block in BLOCKS if block.kind in ("sh", "python")} - set(ELSEWHERE)
)
FIRST = next(block for block in BLOCKS if "residnet new trials/" in block.text)
"""The block of README that makes the run which other pages begin from."""
SHORTER = {"--count 40": "--count 1", "--chains 20": "--chains 1"}
"""Options of the scripts that take many minutes."""
SMALL = (
    *("~recipe", "bands=null", "baseline={kind: regressors, sets: [linear], ridge: 0.01}"),
    "baselines={hull: {kind: regressors, sets: [linear], ridge: 0.01}}",
    "refit={hull: {horizon: 10 s, iterations: 2}}",
    "heads={network: {kind: lstm, hidden_size: 4}}",
    "training.network={steps: 2, one_step: {epochs: 1, window: 2 s, batch: 32},"
    " multi_step: [{horizon: 2 s, epochs: 1, batch: 32}]}",
)
"""A linear hull and a small network in place of the portfolio of the recipe."""
COMMAND = """#!{python}
import shutil
import subprocess
import sys
from pathlib import Path

words, shorter = sys.argv[1:], {shorter!r}


def residnet(*words):
    code = subprocess.call([sys.executable, "-m", "residnet", *words])
    # the doctor and the monitor say with 1 that they found something
    if code > (words[0] in ("inspect", "monitor")):
        sys.exit(code)


if words[0] == "new":
    # another page's draft of the same name, and its run
    out = Path(words[words.index("--out") + 1])
    out.unlink(missing_ok=True)
    shutil.rmtree(Path("runs", out.stem), ignore_errors=True)
if words[0] == "autopilot":
    residnet(*words, "--draft")
    words = ["run", words[words.index("--out") + 1]]
if words[0] == "run":
    name = words[1].split("/")[-1].removesuffix(".yaml")
    # before the block's own, which have the last word
    words[2:2] = [word for key in shorter.get(name, ()) for word in ("-s", key)]
    out = Path(words[words.index("--out") + 1]) if "--out" in words else Path("runs", name)
    # what stands there is of the same command
    words += ["--resume"] if out.exists() else []
if words[0] == "export":
    # what has hardly been trained may be worse than nothing
    words += ["--anyway"]
residnet(*words)
"""


def short_runs() -> dict[str, tuple[str, ...]]:
    """Return the overrides with which the stage `configs` shortens runs, by a config's name."""
    short = {
        name.split("/")[-1]: tuple(
            key.replace("{runs}", "runs") for key in short_configs.shorten_config(name).overrides
        )
        for name in short_configs.list_shipped_configs()
    }
    own = [key for key in short["autopilot_ship"] if not key.startswith("policies.constants")]
    return {
        **short,
        "my_boat": SMALL,
        **dict.fromkeys(("my_autopilot", "from_run", "from_k_and_t"), tuple(own)),
    }


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of the demo in the folders that the pages name, a config and a finished run of them."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "bin").mkdir()
    command = folder / "bin" / "residnet"
    command.write_text(COMMAND.format(python=sys.executable, shorter=short_runs()))
    command.chmod(0o755)
    for name in ("configs", "examples", "scripts"):
        (folder / name).symlink_to(ROOT / name)
    assert carry_out(Block("", 0, "sh", "residnet demo demo"), folder) == 0
    (folder / "demo" / "two_files").rename(folder / "trips")
    zigzags = sorted((folder / "demo" / "csv").glob("zigzag_*.csv"))
    for name in (
        ".",
        "trials",
        "my_logs",
        "my_logs/zigzag",
        "my_recordings",
        "more_logs",
        "new_logs",
    ):
        (folder / name).mkdir(exist_ok=True)
        # of runs at constant commands nothing is learned; five are divided by the log
        for log in zigzags[: 6 if name == "new_logs" else 5]:
            shutil.copy(log, folder / name)
    for log in (folder / "new_logs").iterdir():
        # the propeller does at seven tenths of its revolutions what it did before
        table = pd.read_csv(log)
        table["propeller [rpm]"] *= 0.7
        table.to_csv(log, index=False)
    assert carry_out(FIRST, folder) == 0, f"{FIRST}: fails"
    return folder


def carry_out(block: Block, folder: Path) -> int:
    """Carry out a block in a folder and return its exit code; a failing test shows its output."""
    text = block.text
    for option, shorter in SHORTER.items():
        text = text.replace(option, shorter)
    if block.kind == "python":
        # of the run that it begins, too, the shortened form
        run = f"functools.partial(residnet.run, overrides={short_runs()['quickstart']})"
        page = f"exec(compile({text!r}, {str(block)!r}, 'exec'))"
        text = f"import functools, residnet\nresidnet.run = {run}\n{page}"
    source = Path(residnet.__file__).parents[1]
    programs = (str(folder / "bin"), str(Path(sys.executable).parent), os.environ["PATH"])
    env = {**os.environ, "PATH": os.pathsep.join(programs), "PYTHONPATH": str(source)}
    words = {
        "sh": ["bash", "-euo", "pipefail", "-c", text],
        "python": [sys.executable, "-c", text],
    }[block.kind]
    done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, check=False)
    print(text, done.stdout[-800:], done.stderr[-800:], sep="\n")
    return done.returncode


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES_RUN)
def test_the_blocks_of_a_page_run(page: str, workspace: Path, tmp_path: Path) -> None:
    shutil.copytree(workspace, tmp_path, symlinks=True, dirs_exist_ok=True)
    shown = [block for block in BLOCKS if block.page == page]
    n_blocks = 0
    for block in shown:
        if block.kind == "yaml" and block.text.startswith("kind:"):
            # a vessel lies in the file of its name
            name = yaml.safe_load(block.text)["name"]
            (tmp_path / f"{name}.yaml").write_text(block.text)
        if block.kind == "c":
            # its first line names its file
            (tmp_path / block.text.split()[1]).write_text(block.text)
        left_out = any(re.search(rf"^{re.escape(line)}", block.text, re.M) for line in NOT_RUN)
        if block.kind in ("sh", "python") and block != FIRST and not left_out:
            assert carry_out(block, tmp_path) == 0, f"{block}: fails"
            n_blocks += 1
    assert n_blocks > 0, f"{page}: has no block that runs"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_and_links_exist_and_sentences_are_short(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"`((?:configs|scripts|src|examples)/[\w./-]+)`", text):
        assert (ROOT / name).exists(), f"{page.name} names {name}"
    if page.name in ("README.md", "CONTRIBUTING.md"):
        for link in re.findall(r"\]\((?!http)([^)#]+)", text):
            assert (page.parent / link).exists(), f"{page.name} links to {link}"
    counts = readability.count_words(text)
    assert sum(counts) <= 20 * len(counts), "words of a sentence in the mean"
