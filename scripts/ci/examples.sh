#!/usr/bin/env bash
# The examples and the comparison of Python with the command line: tests that train and run whole tasks.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
exec .venv/bin/python -m pytest -q -n 2 -m long "$@"
