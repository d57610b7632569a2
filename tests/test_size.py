"""The map of modules in CONTRIBUTING.md is true."""

from __future__ import annotations

import re
from pathlib import Path

import residnet

ROOT = Path(residnet.__file__).parent


def test_the_page_on_how_data_flow_names_modules_that_exist() -> None:
    text = (ROOT.parents[1] / "CONTRIBUTING.md").read_text()
    section = text.split("## How data flow")[1].split("\n## ")[0]
    modules = re.findall(r"^\| \d+ \| `([\w/]+\.py)`", section, flags=re.MULTILINE)
    assert 8 <= len(modules) <= 12
    assert [name for name in modules if not (ROOT / name).is_file()] == []
