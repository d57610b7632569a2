"""The one page builder: every task's `report.html` is written here."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from residnet.core.config import load_mapping
from residnet.core.files import read_json, whole
from residnet.report.blocks import Block, Code, Facts, Figure, Section
from residnet.report.figures.files import picture_alone
from residnet.report.glossary import Glossary
from residnet.report.interactive.drawing import Drawn, draw
from residnet.report.interactive.explorer import Explorer

_FACT_TITLES = {"git": "git revision", "python": "Python", "started": "started (UTC)"}
_FACTS = ("residnet", "git", "seed", "python", "machine", "started")


_UNIT = re.compile(r"(?<=\d) (?=(?:%|m|s|deg|m/s|deg/s|1/s|N|kN)(?![\w/]))")
"""The space between a number and its unit."""
_MOST_PANELS = 60
"""Most panels of interactive figures of one page, which a browser has to draw."""
_LONG = 20
"""Least number of characters of a name that may break in the middle."""


def draw_sections(sections: Sequence[Section]) -> Drawn | None:
    """Return the interactive figures of a page's sections; None where there are none.

    Drawing them takes most of the time of a page: one that is written twice needs them once.
    """
    return draw(_afforded(_explorers(sections)))


def write_page(
    run: Path,
    title: str,
    description: str,
    verdict: Sequence[str],
    sections: Sequence[Section],
    drawn: Drawn | None = None,
) -> Path:
    """Write `report.html` of a run folder, whole or not at all.

    The page stands alone: pictures, styles and scripts are inside, and nothing is loaded. Without
    JavaScript, and in print, pictures stand where interactive figures would.
    Words of the glossary are linked to its end, where they are explained.
    Provenance and configuration are added at its end where the folder holds `provenance.json` and
    `resolved.yaml`.

    Args:
        run: run folder.
        title: of the page.
        description: what the run was made for, empty where nothing is to be said.
        verdict: sentences that stand first, the first of them in bold.
        sections: from top to bottom.
        drawn: what `draw_sections` returned for the sections; None to draw them now.

    Returns:
        Path of the page.

    Raises:
        OSError: where a figure cannot be read or the page cannot be written.
    """
    # jinja2 is only needed where a page is written, not where a config is checked
    from jinja2 import Environment, PackageLoader, StrictUndefined

    record = _record(run)
    environment = Environment(
        loader=PackageLoader("residnet.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    glossary = Glossary()
    environment.filters |= {
        "breakable": _breakable,
        "embedded": _embedded,
        "pixels": _pixels,
        "anchor": _anchor,
        "linked": lambda text: glossary.linked(_breakable(str(text))),
    }
    parts = [*sections, *_made_of(run, record)]
    text = environment.get_template("page.html.j2").render(
        title=title,
        description=description,
        version=str(record.get("residnet") or ""),
        date=str(record.get("started") or "")[:10],
        verdict=[sentence for sentence in verdict if sentence],
        sections=parts,
        glossary=glossary,
        interactive=drawn or draw_sections(sections),
    )
    path = run / "report.html"
    with whole(path) as file:
        file.write_text(text, encoding="utf-8")
    return path


def title_and_description(run: Path) -> tuple[str, str]:
    """Return name and description of a run as its `resolved.yaml` gives them."""
    path = run / "resolved.yaml"
    resolved = load_mapping(path) if path.is_file() else {}
    return str(resolved.get("name") or run.name), str(resolved.get("description") or "")


def _explorers(blocks: Sequence[Block]) -> list[Explorer]:
    """Return the interactive figures among blocks and the sections that they hold."""
    found: list[Explorer] = []
    for block in blocks:
        if isinstance(block, Explorer):
            found.append(block)
        elif isinstance(block, Figure) and block.explorer is not None:
            found.append(block.explorer)
        elif isinstance(block, Section):
            found += _explorers(block.shown)
    return found


def _afforded(explorers: Sequence[Explorer]) -> list[Explorer]:
    """Return the interactive figures that a page has room for; others stay pictures."""
    out: list[Explorer] = []
    panels = 0
    for explorer in explorers:
        panels += len(explorer.panels)
        if panels <= _MOST_PANELS or not out:
            out.append(explorer)
    return out


def _record(run: Path) -> Mapping[str, Any]:
    path = run / "provenance.json"
    return read_json(path) if path.is_file() else {}


def _made_of(run: Path, record: Mapping[str, Any]) -> list[Section]:
    """Return the section on provenance and configuration, none where the folder holds neither."""
    blocks: list[Block] = []
    if facts := provenance_facts(record):
        blocks.append(Section("How this run was made", [Facts(facts)], folded=True))
    if inputs := record.get("inputs"):
        pairs = [(str(name), str(checksum)) for name, checksum in inputs.items()]
        title = f"SHA-256 of {len(inputs)} input file{'' if len(inputs) == 1 else 's'}"
        blocks.append(Section(title, [Facts(pairs, code=True)], folded=True))
    resolved = run / "resolved.yaml"
    if resolved.is_file():
        text = resolved.read_text(encoding="utf-8")
        blocks.append(Section("Resolved configuration", [Code(text)], folded=True))
    return [Section("Provenance", blocks)] if blocks else []


def provenance_facts(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and text of each fact of `provenance.json` that a reader may want."""
    facts = [
        (_FACT_TITLES.get(key, key), str(record[key]))
        for key in _FACTS
        if record.get(key) is not None
    ]
    if record.get("seconds") is not None:
        facts.append(("duration", f"{record['seconds']:.0f} s"))
    packages = record.get("packages") or {}
    if packages:
        known = [f"{name} {version}" for name, version in packages.items() if version]
        facts.append(("packages", ", ".join(known)))
    if record.get("config"):
        facts.append(("configuration", str(record["config"])))
    if record.get("overrides"):
        facts.append(("overrides", " ".join(record["overrides"])))
    return facts


def _anchor(title: str) -> str:
    """Return the name by which a section is linked."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _breakable(text: str) -> Markup:
    """Return escaped text whose long names and paths may break after underscores and slashes.

    A number and its unit stay in one line.
    """

    def broken(found: re.Match[str]) -> str:
        return re.sub(r"([_/])", r"\1<wbr>", found[0])

    together = _UNIT.sub("\u00a0", str(escape(text)))
    return Markup(re.sub(rf"\S{{{_LONG},}}", broken, together))


def _pixels(path: Path) -> Markup:
    """Return width and height of a picture, so that its place is kept until it is drawn."""
    from PIL import Image

    with Image.open(path) as picture:
        width, height = picture.size
    return Markup(f' width="{width}" height="{height}"')


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(picture_alone(path)).decode("ascii")
