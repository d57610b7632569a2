"""Page builder: writes `report.html` of every task and links glossary terms."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, final

from markupsafe import Markup, escape

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write
from residnet.core.format import format_exponents
from residnet.core.run_records import ExportRow, ExportsFile, ProvenanceFile
from residnet.evaluation.verdict import LEVEL_TEXTS
from residnet.report.blocks import (
    Block,
    Bullets,
    Cell,
    Code,
    Column,
    Facts,
    Section,
    build_table,
    flag_cell,
)
from residnet.report.browser import InteractiveFigures, render_bokeh
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles
from residnet.report.still import draw_svg

if TYPE_CHECKING:
    from jinja2 import Template

_UNIT_SPACE = re.compile(r"(?<=\d) (?=(?:%|m|s|deg|m/s|deg/s|1/s|N|kN)(?![\w/]))")
"""Matches the space between a number and its unit."""
_MIN_BREAKABLE_LENGTH = 20
"""Minimum length of a name that may be broken."""


def render_figures(sections: Sequence[Section]) -> InteractiveFigures | None:
    """Render the interactive figures of the sections; None without figures.

    Drawings are not interactive. Rendering takes most of the time of a page. A page that is
    written twice renders once.
    """
    return render_bokeh([figure for figure in _collect_figures(sections) if not figure.is_drawing])


def write_page(
    run: Path,
    title: str,
    description: str,
    verdict: Sequence[str],
    sections: Sequence[Section],
    rendered: InteractiveFigures | None = None,
    level: str = "",
) -> Path:
    """Write `report.html` of a run folder atomically.

    The page is self-contained: images, styles and scripts are embedded. Without JavaScript, and in
    print, static images replace the interactive figures. The drawings of the first screen
    need no JavaScript. Glossary terms link to their definitions
    at the end of the page. Provenance and configuration follow if the folder holds
    `provenance.json` and `resolved.yaml`.

    Args:
        title: title of the page; empty for the name of the run.
        description: subtitle; empty for the description of the run.
        verdict: sentences at the top of the page; the first one is bold.
        sections: sections from top to bottom. A section without a title belongs to the first
            screen; its first block is placed next to the others on wide screens.
        rendered: result of `render_figures` for the sections; None to render them now.
        level: level of the verdict, a key of `LEVEL_TEXTS`; empty if there is no verdict.

    Returns:
        Path of the page.

    Raises:
        OSError: if a figure cannot be read or the page cannot be written.
    """
    files = RunFiles(run)
    provenance = files.provenance
    glossary = Glossary()
    all_sections = [*sections, *_provenance_sections(run, provenance)]
    text = _load_template().render(
        title=title or files.title,
        description=description or files.description,
        version="" if provenance is None else provenance.residnet,
        date="" if provenance is None else provenance.started[:10],
        verdict=[sentence for sentence in verdict if sentence],
        level=level and (level.replace(" ", "-"), LEVEL_TEXTS[level]),
        opening=[section for section in sections if not section.title],
        sections=[section for section in all_sections if section.title],
        glossary=glossary,
        interactive=rendered or render_figures(sections),
    )
    path = run / "report.html"
    with atomic_write(path) as file:
        file.write_text(text, encoding="utf-8")
    return path


@cache
def _load_template() -> Template:
    """Compile the template of a page once per process."""
    # jinja2 is only needed where a page is written, not where a config is checked
    from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context
    from jinja2.runtime import Context

    environment = Environment(
        loader=PackageLoader("residnet.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    @pass_context
    def link_words(context: Context, text: object) -> Markup:
        glossary: Glossary = context["glossary"]
        return glossary.link_words(_break_long_names(str(text)))

    environment.filters |= {
        "breakable": _break_long_names,
        "embedded": lambda path: base64.b64encode(path.read_bytes()).decode("ascii"),
        "pixels": _image_size_attributes,
        "drawn": lambda figure: Markup(draw_svg(figure)),
        "deflated": lambda text: base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii"),
        "anchor": lambda title: re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-"),
        "linked": link_words,
    }
    return environment.get_template("page.html.j2")


def _collect_figures(blocks: Sequence[Block]) -> list[Figure]:
    """Return the figures among blocks, including the figures of nested sections."""
    figures: list[Figure] = []
    for block in blocks:
        if isinstance(block, Figure):
            figures.append(block)
        elif isinstance(block, Section):
            figures += _collect_figures(block.present_blocks)
    return figures


def exports_section(run: Path) -> Section | None:
    """Return the section on exported models and failed exports; None without exports.

    Raises:
        DataError: if exports.json is not readable.
    """
    file = ExportsFile.read_optional(run, "exports.json")
    if file is None or not file.exports:
        return None
    faults = [f"Not exported: {row.fault}." for row in file.exports if row.fault]

    def result(row: ExportRow) -> Cell:
        if row.fault:
            return flag_cell("not exported", True)
        return Cell("verified against the model", mark="text")

    columns: list[Column[ExportRow]] = [
        ("model", lambda row: row.model),
        ("file", lambda row: row.file or ""),
        ("result", result),
    ]
    blocks: list[Block] = [Bullets(faults, is_warning=True)] if faults else []
    return Section("Exports for controllers", [*blocks, build_table(file.exports, columns)])


def _provenance_sections(run: Path, provenance: ProvenanceFile | None) -> list[Section]:
    """Return the section on provenance and configuration; empty if the folder holds neither."""
    blocks: list[Block] = []
    if provenance is not None:
        facts = Facts(provenance_facts(provenance))
        blocks.append(Section("Origin of the run", [facts], is_folded=True))
        if inputs := provenance.inputs:
            title = f"SHA-256 of {len(inputs)} input file{'' if len(inputs) == 1 else 's'}"
            checksums = Facts(list(inputs.items()), is_code=True)
            blocks.append(Section(title, [checksums], is_folded=True))
    resolved = run / "resolved.yaml"
    if resolved.is_file():
        text = resolved.read_text(encoding="utf-8")
        blocks.append(Section("Resolved configuration", [Code(text)], is_folded=True))
    return [Section("Provenance", blocks)] if blocks else []


def provenance_facts(provenance: ProvenanceFile) -> list[tuple[str, str]]:
    """Return title and text of each entry of `provenance.json` that the report shows."""
    packages = provenance.packages.items()
    facts = {
        "residnet": provenance.residnet,
        "git revision": provenance.git or "",
        "seed": str(provenance.seed),
        "Python": provenance.python,
        "machine": provenance.machine,
        "started (UTC)": provenance.started,
        "duration": f"{provenance.seconds:.0f} s",
        "packages": ", ".join(f"{name} {version}" for name, version in packages if version),
        "packages of parts": ", ".join(
            f"{name} {version}" for name, version in provenance.part_packages.items()
        ),
        "configuration": provenance.config or "",
        "overrides": " ".join(provenance.overrides),
    }
    return [(title, text) for title, text in facts.items() if text]


def _break_long_names(text: str) -> Markup:
    """Return escaped text in which long names and paths may break after underscores and slashes.

    A number and its unit are kept on one line, exponents are raised, and text in backticks becomes
    code.
    """

    def add_breaks(match: re.Match[str]) -> str:
        return re.sub(r"([_/])", r"\1<wbr>", match[0])

    with_unit_spaces = format_exponents(_UNIT_SPACE.sub("\u00a0", str(escape(text))))
    with_code = re.sub(r"`([^`]+)`", r"<code>\1</code>", with_unit_spaces)
    return Markup(re.sub(rf"[^\s<>]{{{_MIN_BREAKABLE_LENGTH},}}", add_breaks, with_code))


def _image_size_attributes(path: Path) -> Markup:
    """Return the width and height attributes of an image, which reserve its space while loading.

    An image that is nearly as high as wide or higher has the class `tall`, which allows it most of
    a printed page.
    """
    from PIL import Image

    try:
        with Image.open(path) as picture:
            width, height = picture.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UsageError(
            f"{path}: not readable as a picture ({error}); restore the folder or run it again"
        ) from None
    tall = ' class="tall"' if height > 0.8 * width else ""
    return Markup(f' width="{width}" height="{height}"{tall}')


_GLOSSARY_ENTRY = re.compile(r"^(?P<terms>\S.*)\n:\s+(?P<text>.*)$", re.MULTILINE)
_MARKUP = re.compile(r"`([^`]*)`|\*([^*]*)\*")


def read_glossary() -> Mapping[str, str]:
    """Read the glossary: definitions by term; synonyms are separated by commas."""
    file = resources.files("residnet.report") / "templates" / "glossary.md"
    matches = _GLOSSARY_ENTRY.finditer(file.read_text(encoding="utf-8"))
    return {_strip_markup(entry["terms"]): _strip_markup(entry["text"]) for entry in matches}


def _strip_markup(text: str) -> str:
    return _MARKUP.sub(lambda found: found[1] or found[2], text)


@final
class Glossary:
    """Glossary links of one page and the definitions for the end of the page."""

    def __init__(self) -> None:
        self._meanings = read_glossary()
        self._key_of_word = {
            term.lower(): key for key in self._meanings for term in key.split(", ")
        }
        sorted_words = sorted(self._key_of_word, key=len, reverse=True)
        alternatives = "|".join(
            re.escape(term).replace(r"\ ", r"[ \u00a0]") for term in sorted_words
        )
        self._word_pattern = re.compile(
            rf"(?<![\w/.-])(?:{alternatives})(?=s?(?![\w/-]|\.\w))", re.IGNORECASE
        )
        self._linked_in_section: set[str] = set()
        self._linked_keys: set[str] = set()

    def start_section(self) -> str:
        """Reset the linked terms at the start of a section; returns an empty string for the
        template.
        """
        self._linked_in_section.clear()
        return ""

    def link_words(self, text: Markup) -> Markup:
        """Link the first occurrence of each glossary term in the current section."""

        def link_match(match: re.Match[str]) -> str:
            key = self._key_of_word[match[0].lower().replace("\u00a0", " ")]
            if key in self._linked_in_section:
                return match[0]
            self._linked_in_section.add(key)
            self._linked_keys.add(key)
            meaning = escape(self._meanings[key])
            return (
                f'<a class="term" href="#{glossary_anchor(key)}" title="{meaning}">{match[0]}</a>'
            )

        return Markup(self._word_pattern.sub(link_match, str(text)))

    def linked_terms(self) -> list[tuple[str, str, str]]:
        """Return name, terms and meaning of each word that was linked, in alphabetical order."""
        return [
            (glossary_anchor(key), key, self._meanings[key])
            for key in self._meanings
            if key in self._linked_keys
        ]


def glossary_anchor(key: str) -> str:
    """Return the HTML anchor of a glossary term."""
    return "word-" + re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-")
