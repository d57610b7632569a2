"""Physical sanity: what the checks of every model found."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.judge.verdict.sanity import CHECKS, Finding
from residnet.report.blocks import Cell, Facts, Section, Table
from residnet.report.format import minus
from residnet.report.run_reader import RunFiles


def section(run: RunFiles, findings: Sequence[Finding]) -> Section | None:
    """Return a table of all checks and what each found, None where no model was checked."""
    if not findings:
        return None
    table = Table(["model", *CHECKS])
    details = []
    for model in dict.fromkeys(finding.model for finding in findings):
        of_model = [finding for finding in findings if finding.model == model]
        selected = model == run.selected
        table.add(model, [_cell(finding) for finding in of_model], selected=selected)
        facts = Facts(
            [(finding.check, minus(finding.text)) for finding in of_model],
            failed=[finding.check for finding in of_model if finding.ok is False],
        )
        details.append(Section(run.label(model), [facts], folded=not selected))
    return Section("Physical sanity", [table, *details])


def _cell(finding: Finding) -> Cell:
    if finding.ok is None:
        return Cell("n/a", mark="weak")
    return Cell("✓ ok") if finding.ok else Cell("✗ look", mark="bad")
