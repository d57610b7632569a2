#!/usr/bin/env bash
# Style of everything, and types of the package; scripts/ci/long.sh checks the types of the tests.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
.venv/bin/ruff check src tests scripts docs examples
.venv/bin/python scripts/ci/parallel_assignments.py src tests scripts docs examples
.venv/bin/mypy
