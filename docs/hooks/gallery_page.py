"""Add to the gallery the complete pages of the runs of the long stage `configs`."""

from __future__ import annotations

import json
from pathlib import Path

import mkdocs_gen_files

RUNS = Path(__file__).parents[2] / "build" / "runs"


def write_gallery() -> None:
    """Copy all pages into the site and list them with their verdicts; do nothing without pages."""
    rows = []
    for page in sorted(RUNS.glob("*/report.html")):
        name = page.parent.name
        summary = json.loads((page.parent / "summary.json").read_text(encoding="utf-8"))
        with mkdocs_gen_files.open(f"gallery/{name}.html", "w") as file:
            file.write(page.read_text(encoding="utf-8"))
        verdict = str(summary["verdict"][0]).replace("|", "&#124;").replace("<", "&lt;")
        rows.append(f"| [{name}](gallery/{name}.html) | {summary['task']} | {verdict} |")
    if rows:
        with mkdocs_gen_files.open("gallery.md", "a") as file:
            file.write("\n## Whole pages\n\nShortened runs of the shipped configs.\n\n")
            file.write("\n".join(["| run | task | verdict |", "| --- | --- | --- |", *rows]) + "\n")


write_gallery()
