#!/usr/bin/env bash
# Runs the tests; arguments go to pytest. RESIDNET_DATA and RESIDNET_GOLDEN name folders of measured logs and reference runs, where there are any.
source "$(dirname "${BASH_SOURCE[0]}")/_venv.sh"
install_residnet "[dev]"
# the tests start many programs, which need not compile the sources anew
export PYTHONDONTWRITEBYTECODE=
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
if [ $# -eq 0 ]; then
  set -- -q -n 2 --dist loadfile --no-loadscope-reorder -m "not long and not exporters"
fi
exec .venv/bin/python -m pytest "$@"
