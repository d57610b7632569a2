#!/usr/bin/env bash
# Every shipped config in a shortened form, to its report; arguments are names of configs.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
exec .venv/bin/python scripts/ci/short_configs.py "$@"
