"""A plain report: one self-contained HTML file of a title, words and tables, the run's figures and
its configuration.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from residnet.core.config import load_mapping
from residnet.report.figures.files import read_figures

_STYLE = (
    "body{margin:0 auto;max-width:60rem;padding:1rem;font:1rem/1.5"
    " system-ui,sans-serif;color:#1a1f24}"
    "pre{background:#f4f6f8;padding:.8rem;overflow-x:auto;font-size:.8rem}img{width:100%}figcaption{color:#59636e}"
)


class Part(NamedTuple):
    """Words, then a table in text; either may be empty. A heading stands above them where it is
    given.
    """

    words: str
    table: str = ""
    heading: str = ""


def _html(part: Part) -> str:
    return (
        (f"<h2>{html.escape(part.heading)}</h2>" if part.heading else "")
        + (f"<p>{html.escape(part.words)}</p>" if part.words else "")
        + (f"<pre>{html.escape(part.table)}</pre>" if part.table else "")
    )


def write_page(run: Path, before: Sequence[Part], after: Sequence[Part] = ()) -> Path:
    """Write `report.html` of a run folder, whole or not at all: parts before and after its figures,
    then its configuration.

    Returns:
        The report's path.
    """
    config = load_mapping(run / "resolved.yaml")
    title = html.escape(config["name"])
    figures = "".join(
        f'<figure><img alt="{html.escape(f.title)}"'
        f' src="data:image/png;base64,{base64.b64encode(f.path.read_bytes()).decode("ascii")}">'
        f"<figcaption><b>{html.escape(f.title)}.</b>"
        f" {html.escape(f.caption)}</figcaption></figure>"
        for f in read_figures(run / "figures")
    )
    last = Part("", (run / "resolved.yaml").read_text(), "Configuration")
    text = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}: residnet'
        f" report</title><style>{_STYLE}</style></head><body>"
        f"<h1>{title}</h1><p>{html.escape(str(config.get('description') or ''))}</p>"
        f"{''.join(map(_html, before))}{figures}{''.join(map(_html, (*after, last)))}</body></html>"
    )
    path = run / "report.html"
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
    return path
