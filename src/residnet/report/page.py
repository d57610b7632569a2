"""The one page builder: every task's `report.html` is written here, the field's words linked."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, final

from markupsafe import Markup, escape

from residnet.core.files import whole
from residnet.core.format import powers
from residnet.judge.verdict import LEVELS
from residnet.report.blocks import (
    EXPORTS,
    Block,
    Bullets,
    Cell,
    Code,
    Facts,
    Section,
    bad_where,
    table_of,
)
from residnet.report.browser import Drawn, draw
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles

_FACTS = {
    **{"residnet": "residnet", "git": "git revision", "seed": "seed", "python": "Python"},
    **{"machine": "machine", "started": "started (UTC)", "seconds": "duration"},
    **{"packages": "packages", "config": "configuration", "overrides": "overrides"},
}
"""What is told of provenance.json, and its title."""


_UNIT = re.compile(r"(?<=\d) (?=(?:%|m|s|deg|m/s|deg/s|1/s|N|kN)(?![\w/]))")
"""The space between a number and its unit."""
_LONG = 20
"""Least number of characters of a name that may break in the middle."""


def draw_sections(sections: Sequence[Section]) -> Drawn | None:
    """Return the interactive figures of a page's sections; None where there are none.

    Drawing them takes most of the time of a page: one that is written twice needs them once.
    """
    return draw(_figures(sections))


def write_page(
    run: Path,
    title: str,
    description: str,
    verdict: Sequence[str],
    sections: Sequence[Section],
    drawn: Drawn | None = None,
    level: str = "",
) -> Path:
    """Write `report.html` of a run folder, whole or not at all.

    The page stands alone: pictures, styles and scripts are inside, and nothing is loaded. Without
    JavaScript, and in print, pictures stand where interactive figures would.
    Words of the glossary are linked to its end, where they are explained.
    Provenance and configuration are added at its end where the folder holds `provenance.json` and
    `resolved.yaml`.

    Args:
        title: of the page, empty for the name of the run in the folder.
        description: what the page is of, empty for what the run was made for.
        verdict: sentences that stand first, the first of them in bold.
        sections: from top to bottom. One without a title is the rest of the first screen: its
            first block stands beside the others where there is room.
        drawn: what `draw_sections` returned for the sections; None to draw them now.
        level: of the verdict, a key of `LEVELS`; empty where none was passed.

    Returns:
        Path of the page.

    Raises:
        OSError: where a figure cannot be read or the page cannot be written.
    """
    # jinja2 is only needed where a page is written, not where a config is checked
    from jinja2 import Environment, PackageLoader, StrictUndefined

    files = RunFiles(run)
    record = files.provenance
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
        "embedded": lambda path: base64.b64encode(path.read_bytes()).decode("ascii"),
        "pixels": _pixels,
        "deflated": lambda text: base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii"),
        "anchor": lambda title: re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-"),
        "linked": lambda text: glossary.linked(_breakable(str(text))),
    }
    parts = [*sections, *_made_of(run, record)]
    text = environment.get_template("page.html.j2").render(
        title=title or files.title,
        description=description or files.description,
        version=str(record.get("residnet") or ""),
        date=str(record.get("started") or "")[:10],
        verdict=[sentence for sentence in verdict if sentence],
        level=level and (level.replace(" ", "-"), LEVELS[level]),
        opening=[part for part in sections if not part.title],
        sections=[part for part in parts if part.title],
        glossary=glossary,
        interactive=drawn or draw_sections(sections),
    )
    path = run / "report.html"
    with whole(path) as file:
        file.write_text(text, encoding="utf-8")
    return path


def _figures(blocks: Sequence[Block]) -> list[Figure]:
    """Return the figures among blocks and the sections that they hold."""
    found: list[Figure] = []
    for block in blocks:
        if isinstance(block, Figure):
            found.append(block)
        elif isinstance(block, Section):
            found += _figures(block.shown)
    return found


def exports_section(run: Path) -> Section | None:
    """Return what a run exported for controllers, and what it could not; None where nothing.

    Raises:
        DataError: where exports.json is not readable.
    """
    rows = RunFiles(run).json(EXPORTS).get("exports") or []
    if not rows:
        return None
    faults = [f"Not exported: {row['fault']}." for row in rows if row["fault"]]

    def result(row: Mapping[str, Any]) -> Cell:
        if row["fault"]:
            return bad_where("not exported", True)
        return Cell("the file gives the model's own answers", mark="text")

    columns = [("model", "model"), ("file", lambda row: row["file"] or ""), ("result", result)]
    blocks: list[Block] = [Bullets(faults, warning=True)] if faults else []
    return Section("Exports for controllers", [*blocks, table_of(rows, columns)])


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
    packages = (record.get("packages") or {}).items()
    told = {**record, "overrides": " ".join(record.get("overrides") or ())}
    if (seconds := record.get("seconds")) is not None:
        told["seconds"] = f"{seconds:.0f} s"
    told["packages"] = ", ".join(f"{name} {version}" for name, version in packages if version)
    known = {title: told.get(key) for key, title in _FACTS.items()}
    return [(title, str(value)) for title, value in known.items() if value not in (None, "")]


def _breakable(text: str) -> Markup:
    """Return escaped text whose long names and paths may break after underscores and slashes.

    A number and its unit stay in one line, powers are raised, and what stands in backticks is code.
    """

    def broken(found: re.Match[str]) -> str:
        return re.sub(r"([_/])", r"\1<wbr>", found[0])

    together = powers(_UNIT.sub("\u00a0", str(escape(text))))
    coded = re.sub(r"`([^`]+)`", r"<code>\1</code>", together)
    return Markup(re.sub(rf"[^\s<>]{{{_LONG},}}", broken, coded))


def _pixels(path: Path) -> Markup:
    """Return width and height of a picture, so that its place is kept until it is drawn."""
    from PIL import Image

    with Image.open(path) as picture:
        width, height = picture.size
    return Markup(f' width="{width}" height="{height}"')


_ENTRY = re.compile(r"^(?P<terms>\S.*)\n:\s+(?P<text>.*)$", re.MULTILINE)
_CODE = re.compile(r"`([^`]*)`|\*([^*]*)\*")


def entries() -> Mapping[str, str]:
    """Return terms, several of one meaning with commas between, and what they mean."""
    file = resources.files("residnet.report") / "templates" / "glossary.md"
    found = _ENTRY.finditer(file.read_text(encoding="utf-8"))
    return {_plain(entry["terms"]): _plain(entry["text"]) for entry in found}


def _plain(text: str) -> str:
    return _CODE.sub(lambda found: found[1] or found[2], text)


@final
class Glossary:
    """The words of one page: links to them, and what they mean for its end."""

    def __init__(self) -> None:
        self._meant = entries()
        self._of = {word.lower(): key for key in self._meant for word in key.split(", ")}
        words = sorted(self._of, key=len, reverse=True)
        several = "|".join(re.escape(word).replace(r"\ ", r"[ \u00a0]") for word in words)
        self._words = re.compile(rf"(?<![\w/.-])(?:{several})(?=s?(?![\w/-]|\.\w))", re.IGNORECASE)
        self._here: set[str] = set()
        self._used: set[str] = set()

    def fresh(self) -> str:
        """Begin a section, whose words are linked anew; returns nothing to print."""
        self._here.clear()
        return ""

    def linked(self, text: Markup) -> Markup:
        """Return escaped text with links at the first use of each word in the section."""

        def link(found: re.Match[str]) -> str:
            key = self._of[found[0].lower().replace("\u00a0", " ")]
            if key in self._here:
                return found[0]
            self._here.add(key)
            self._used.add(key)
            meant = escape(self._meant[key])
            return f'<a class="term" href="#{name_of(key)}" title="{meant}">{found[0]}</a>'

        return Markup(self._words.sub(link, str(text)))

    def used(self) -> list[tuple[str, str, str]]:
        """Return name, terms and meaning of each word that was linked, in alphabetical order."""
        return [(name_of(key), key, self._meant[key]) for key in self._meant if key in self._used]


def name_of(key: str) -> str:
    """Return the name by which a word is linked."""
    return "word-" + re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-")
