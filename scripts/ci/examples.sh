#!/usr/bin/env bash
# The examples, as their readers run them: the Python example, the package with a head of its own, the notebook.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
exec .venv/bin/python -m pytest -q tests/test_face.py tests/contracts/test_sample_package.py
