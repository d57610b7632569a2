#!/usr/bin/env bash
# Everything that .ci/run leaves out. Arguments are names of stages; without any, all of them run:
#   types      types of the tests
#   long       tests that take ten seconds or more: whole runs, golden runs at full length, examples
#   exporters  every export format with every kind of model, written, loaded back and compared
#   configs    every shipped config in a shortened form, to its report
#   docs       the documentation site, tutorials carried out; a warning is an error
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
set +e
shared="$(cd .. && pwd)/shared"
if [ -z "${RESIDNET_DATA:-}" ] && [ -d "$shared/data" ]; then export RESIDNET_DATA="$shared/data"; fi
if [ -z "${RESIDNET_GOLDEN:-}" ] && [ -d "$shared/golden" ]; then export RESIDNET_GOLDEN="$shared/golden"; fi
install_residnet "[dev,docs]"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 JUPYTER_PLATFORM_DIRS=1 NO_MKDOCS_2_WARNING=1
python=.venv/bin/python

types() { .venv/bin/mypy --config-file scripts/ci/mypy_tests.ini tests; }
long() { $python -m pytest -q -n 2 -m long; }
exporters() { $python -m pytest -q -n 2 -m exporters; }
configs() { rm -rf build/runs && $python scripts/ci/short_configs.py --out build/runs; }
# with the pages of runs that configs left
docs() { $python docs/hooks/config_keys.py && .venv/bin/mkdocs build --strict; }

if [ $# -eq 0 ]; then set -- types long exporters configs docs; fi
lines=() failed=0
for name in "$@"; do
  [[ " types long exporters configs docs " == *" $name "* ]] || { echo "no stage '$name'" >&2; exit 2; }
  started=$SECONDS state=ok
  echo "=== $name"
  "$name" || { state=FAILED; failed=1; }
  lines+=("$(printf '%-9s %-6s %5d s' "$name" "$state" "$((SECONDS - started))")")
done
printf '=== %s\n' "${lines[@]}"
exit "$failed"
