"""The client report of a fit as a PDF: content, vector figures, and a Typst template.

Typst is installed by pip (`residnet[pdf]`) and brings its own fonts. The template reads
`report.json` and the SVG figures next to it. A template of the user's own gets the same files.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from residnet.core.config import Config, load_mapping, validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import write_owned
from residnet.evaluation.booklet_records import BookletFile
from residnet.evaluation.derivatives import DerivativeRow, DerivativesFile
from residnet.io.readers.base import optional_import
from residnet.report.client_content import build_sections
from residnet.report.figure import Figure
from residnet.report.run_reader import RunFiles
from residnet.report.sections import manoeuvres, runs
from residnet.report.still import RC_PARAMS, render_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

CLIENT_TEMPLATE = "client"
"""Name of the template that comes with residnet."""
_LOGO_SUFFIXES = (".svg", ".png", ".jpg", ".jpeg", ".pdf")
_MAX_LOGO_BYTES = 5_000_000
"""Size in bytes above which a logo is refused; it is copied into the report."""
_FIGURES = {
    "track": "Free runs on held-out records: measured track and track of the model.",
    "booklet_zigzags_1": (
        "Zigzags in closed loop: heading of the model with the band of the draws, measured heading"
        " where the test was run, and rudder angle (dotted)."
    ),
    "booklet_circles": (
        "Turning circles in hull lengths from the place of the order; thin lines are draws of the"
        " parameters."
    ),
}
"""Caption of each figure of the fit that the report contains, by its name."""
_MAP_HEIGHTS = {"track": 2.2, "booklet_circles": 3.0}
"""Heights of maps in inches."""


class ClientText(Config):
    """The user's own text of a client report.

    Attributes:
        title: title of the report.
        subtitle: line below the title, such as the name of the vessel.
        client: who receives it.
        author: who wrote it.
        reference: number of the project or report.
        introduction: paragraphs before the summary.
        conclusions: paragraphs at the end.
    """

    title: str = ""
    subtitle: str = ""
    client: str = ""
    author: str = ""
    reference: str = ""
    introduction: tuple[str, ...] = ()
    conclusions: tuple[str, ...] = Field(default=())


def write_client_report(
    folder: Path,
    output_file: Path,
    *,
    template: str = CLIENT_TEMPLATE,
    logo: Path | None = None,
    text: ClientText | None = None,
) -> Path:
    """Write the client report of a finished fit; returns the PDF file.

    Args:
        folder: folder of the run.
        output_file: the PDF file.
        template: `client`, or the path of a Typst file of the user's own.
        logo: image in the head of the first page.
        text: title, names and paragraphs of the user's own.

    Raises:
        UsageError: if the template or logo does not exist, or Typst is not installed.
        DataError: if the template cannot be compiled.
    """
    run = RunFiles(folder)
    _ = run.metrics
    template_file = _find_template(template)
    text = text or ClientText()
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        captions = {}
        for name, caption, canvas in _draw_figures(run):
            canvas.savefig(root / f"{name}.svg", format="svg")
            captions[f"{name}.svg"] = caption
        content: dict[str, Any] = {
            "title": text.title or f"Manoeuvring report: {run.title.replace('_', ' ')}",
            "subtitle": text.subtitle,
            "client": text.client,
            "author": text.author,
            "reference": text.reference,
            "date": "" if run.provenance is None else run.provenance.started[:10],
            "logo": None if logo is None else _copy_logo(logo, root),
            "introduction": list(text.introduction),
            "conclusions": list(text.conclusions),
            "sections": [section.to_data() for section in build_sections(run, captions)],
        }
        (root / "report.json").write_text(json.dumps(content), encoding="utf-8")
        shutil.copyfile(template_file, root / "report.typ")
        pdf = _compile(root / "report.typ", template_file)
    with write_owned(output_file) as file:
        file.write_bytes(pdf)
    return output_file


def read_client_text(file: Path) -> ClientText:
    """Read the user's text from a YAML file.

    Raises:
        ConfigError: if the file is missing, or a key is unknown or has another type.
    """
    return validate_config(load_mapping(file), ClientText, str(file))


def _find_template(template: str) -> Path:
    if template == CLIENT_TEMPLATE:
        return Path(__file__).with_name("templates") / "client.typ"
    path = Path(template)
    if path.suffix != ".typ" or not path.is_file():
        raise UsageError(
            f"--template {template}: expected '{CLIENT_TEMPLATE}' or an existing Typst file (.typ)"
        )
    return path


def _copy_logo(logo: Path, root: Path) -> str:
    """Copy a logo next to the template; returns its name.

    Raises:
        UsageError: if the file is missing, too large or of another type.
    """
    if logo.suffix.lower() not in _LOGO_SUFFIXES or not logo.is_file():
        raise UsageError(f"--logo {logo}: expected an existing image ({', '.join(_LOGO_SUFFIXES)})")
    if logo.stat().st_size > _MAX_LOGO_BYTES:
        raise UsageError(f"--logo {logo}: is larger than {_MAX_LOGO_BYTES / 1e6:.0f} MB")
    name = f"logo{logo.suffix.lower()}"
    shutil.copyfile(logo, root / name)
    return name


def _compile(source: Path, template_file: Path) -> bytes:
    with optional_import("pdf", "typst", "a client report"):
        import typst
    try:
        # system fonts are ignored, so that the pages are equal on every machine
        pdf = typst.compile(str(source), root=str(source.parent), ignore_system_fonts=True)
    except RuntimeError as error:
        message = " ".join(str(error).split())[:300]
        raise DataError(f"{template_file}: Typst cannot compile the template: {message}") from None
    return bytes(pdf)


def _draw_figures(run: RunFiles) -> Iterator[tuple[str, str, Canvas]]:
    """Yield name, caption and matplotlib figure of the figures of the report."""
    windows = run.read_split_windows(run.report_split)
    figures: list[Figure | None] = [
        runs.track_figure(run, windows),
        *manoeuvres.booklet_figures(run),
    ]
    for figure in figures:
        if figure is not None and figure.name in _FIGURES:
            # two pictures and a table share a page; texts keep their size in narrower pictures
            map_height = _MAP_HEIGHTS.get(figure.name, 0.0)
            canvas = render_matplotlib(figure, map_height=map_height, is_rasterized=False)
            yield figure.name, _FIGURES[figure.name], canvas
    derivatives = run.read_record(DerivativesFile, "derivatives.json")
    if derivatives is not None:
        rows = [row for row in derivatives.rows if row.prime_i_error is not None]
        if rows:
            caption = (
                "Non-dimensional derivatives (prime I) with 95 % intervals, divided by the largest"
                " of their equation; values of Clarke et al. (1983) as crosses where they apply."
            )
            yield "derivatives", caption, _draw_derivatives(rows, derivatives.published or {})
    booklet = run.read_record(BookletFile, "booklet.json")
    if booklet is not None and any(page.split for page in booklet.pages):
        indices_canvas = _draw_repeated_indices(booklet)
        if indices_canvas is not None:
            yield (
                "repeated_indices",
                "Predicted over measured indices of the repeated manoeuvres, with intervals;"
                " filled symbols are held-out records.",
                indices_canvas,
            )


def _draw_derivatives(rows: Sequence[DerivativeRow], published: Mapping[str, float]) -> Canvas:
    """Return a chart of derivatives with error bars, one panel for each equation."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Canvas

    axes_names = [axis for axis in ("X", "Y", "N") if any(row.axis == axis for row in rows)]
    with rc_context(RC_PARAMS):
        height = 0.6 + 0.17 * max(sum(row.axis == axis for row in rows) for axis in axes_names)
        canvas = Canvas(figsize=(7.0, min(max(height, 1.6), 4.5)), layout="constrained")
        FigureCanvasSVG(canvas)
        panels = canvas.subplots(1, len(axes_names), squeeze=False)[0]
        for panel, axis in zip(panels, axes_names, strict=True):
            axis_rows = [row for row in rows if row.axis == axis and row.prime_i is not None]
            unit = max(abs(row.prime_i or 0.0) for row in axis_rows) or 1.0
            for position, row in enumerate(axis_rows):
                value = (row.prime_i or 0.0) / unit
                panel.errorbar(
                    value,
                    position,
                    xerr=1.96 * (row.prime_i_error or 0.0) / unit,
                    fmt="o",
                    markersize=3.5,
                    capsize=2.5,
                    color="#1f4e79",
                    linewidth=1.0,
                )
                if row.name in published:
                    panel.plot(published[row.name] / unit, position, "x", color="#b3541e")
            panel.axvline(0.0, color="0.4", linewidth=0.7)
            panel.set_yticks(range(len(axis_rows)), [row.name for row in axis_rows])
            panel.invert_yaxis()
            panel.set_xlim(-1.6, 1.6)
            panel.set_title(f"{axis}, in units of {unit:.3g}")
    return canvas


def _draw_repeated_indices(booklet: BookletFile) -> Canvas | None:
    """Return a chart of predicted over measured indices, relative to the measured value."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Canvas

    names = ("advance", "tactical_diameter", "steady_diameter", "first_overshoot",
             "second_overshoot", "period")  # fmt: skip
    points = [
        (page, name, page.indices[name])
        for page in booklet.pages
        if page.split
        for name in names
        if name in page.indices and page.indices[name].measured
    ]
    if not points:
        return None
    with rc_context(RC_PARAMS):
        canvas = Canvas(figsize=(7.0, 0.6 + 0.16 * len(points)), layout="constrained")
        FigureCanvasSVG(canvas)
        panel = canvas.subplots()
        labels = []
        for position, (page, name, entry) in enumerate(points):
            measured = entry.measured or 1.0
            ratio = entry.value / measured
            if entry.interval is not None:
                low, high = (bound / measured for bound in entry.interval)
                panel.plot([low, high], [position, position], color="#1f4e79", linewidth=1.2)
            panel.plot(
                ratio,
                position,
                "o",
                markersize=4,
                color="#1f4e79",
                markerfacecolor="white" if page.split == "train" else "#1f4e79",
            )
            labels.append(f"{page.name}: {manoeuvres.index_title(name)}")
        panel.axvline(1.0, color="0.3", linewidth=0.8)
        panel.set_yticks(range(len(labels)), labels)
        panel.invert_yaxis()
        panel.set_xlabel("predicted / measured")
    return canvas
