"""The checks for physical sanity as a file of the run folder: a report need not repeat them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from residnet.core.errors import DataError
from residnet.judge.verdict.sanity import Finding, check_run

SCHEMA = "residnet.sanity/1"


def content(findings: Mapping[str, Sequence[Finding]]) -> dict[str, Any]:
    """Return the contents of sanity.json from the findings of each model."""
    rows = [asdict(finding) for of_model in findings.values() for finding in of_model]
    return {"schema": SCHEMA, "findings": rows}


def read_findings(run: Path, *, divergence: float = 3.0) -> list[Finding]:
    """Return the findings of a run folder's sanity.json; checks the models where there is none.

    Args:
        run: folder of a fit.
        divergence: a velocity beyond this many times its largest training value counts as run away.

    Raises:
        DataError: where the file cannot be read.
        UsageError: where a model cannot be read.
    """
    path = run / "sanity.json"
    if not path.is_file():
        return check_run(run, divergence=divergence)
    try:
        return [Finding(**row) for row in json.loads(path.read_text(encoding="utf-8"))["findings"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: not readable as the findings of a run ({error}); delete the file, and the"
            " checks are made again"
        ) from None
