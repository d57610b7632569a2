"""The report: one self-contained HTML file, from the run folder alone."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from residnet.judge.sanity import CHECKS, Finding, check_run
from residnet.report import tables
from residnet.report.figures.fit import FigureFile, read_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections import booklet as report_booklet
from residnet.report.sections import doctor as report_doctor
from residnet.report.sections import equations as report_equations
from residnet.report.sections import goodness as report_goodness
from residnet.report.sections import limits as report_limits
from residnet.report.sections import offsets as report_offsets
from residnet.report.text import cautions, fitted_on, verdict

_TEMPLATE = "report.html.j2"


def write_report(run: Path) -> Path:
    """Write `report.html` into a run folder (or what `residnet evaluate` wrote) from what stands
    there; sections without data are left out.

    Figures are taken from `figures/`: call `residnet.report.figures.fit.write_figures` before.

    Args:
        run: folder with metrics.json.

    Returns:
        Path of the report.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    files = RunFiles(run)
    divergence = float(files.evaluation.get("divergence") or 3.0)
    findings = check_run(run, divergence=divergence)
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["minus"] = _minus
    text = environment.get_template(_TEMPLATE).render(_context(files, findings, read_figures(run)))
    path = run / "report.html"
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
    return path


def _context(
    run: RunFiles, findings: Sequence[Finding], figures: Sequence[FigureFile]
) -> dict[str, Any]:
    protocols = [
        {
            "name": name,
            "table": tables.free_runs(run, name),
            "kinds": tables.by_manoeuvre(run, name, run.focus),
            "first": name == run.protocols[0],
        }
        for name in run.protocols
    ]
    return {
        "title": str(run.metrics.get("run") or run.path.name),
        "description": str(run.resolved.get("description") or ""),
        "date": str(run.provenance.get("started") or "")[:10],
        "version": run.provenance.get("residnet"),
        "selected": run.selected,
        "verdict": [sentence for sentence in verdict(run) if sentence],
        "cautions": cautions(run, findings),
        "focus": run.focus,
        "sides": run.sides,
        "has_baseline": run.baseline is not None,
        "fitted_on": fitted_on(run),
        "quality": tables.quality(run),
        "doctor": report_doctor.section(run),
        "good": report_limits.section(run),
        "baselines": _coefficients(run),
        "heads": tables.heads(run),
        "equations": report_equations.section(run),
        "goodness": report_goodness.section(run),
        "booklet": report_booklet.section(run),
        "protocols": [entry for entry in protocols if entry["table"] is not None],
        "figures": [
            {"title": f.title, "caption": f.caption, "name": f.path.name, "data": _embedded(f.path)}
            for f in figures
        ],
        "checks": CHECKS,
        "sanity": _by_model(findings),
        "provenance": tables.provenance(run),
        "inputs": list((run.provenance.get("inputs") or {}).items()),
        "resolved": run.resolved_text,
    }


def _coefficients(run: RunFiles) -> list[dict[str, Any]]:
    """Tables of identified coefficients, the first baseline's first."""
    names = [
        run.baseline or "baseline",
        *(model for model, kind in run.kinds.items() if kind == "further"),
    ]
    found = [
        {
            "name": name,
            "table": tables.baseline_parameters(run, name),
            "refitted": bool(run.fit(name).get("refit")),
            "offsets": report_offsets.section(run, name),
        }
        for name in names
    ]
    return [entry for entry in found if entry["table"] is not None]


def _by_model(findings: Sequence[Finding]) -> list[tuple[str, list[Finding]]]:
    return [
        (model, [f for f in findings if f.model == model])
        for model in dict.fromkeys(f.model for f in findings)
    ]


def _minus(text: str) -> str:
    """Hyphens before numbers as minus signs."""
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
