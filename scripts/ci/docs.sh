#!/usr/bin/env bash
# Builds the documentation site into build/site. A warning is an error, and so is an undocumented config key.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev,docs]"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 JUPYTER_PLATFORM_DIRS=1 NO_MKDOCS_2_WARNING=1
.venv/bin/python docs/hooks/config_keys.py
exec .venv/bin/mkdocs build --strict "$@"
