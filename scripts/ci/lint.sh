#!/usr/bin/env bash
# Lint and types.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
.venv/bin/ruff check src tests scripts docs examples
.venv/bin/mypy
.venv/bin/mypy --config-file scripts/ci/mypy_tests.ini tests
