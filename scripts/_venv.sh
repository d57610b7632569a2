# Sourced by the other scripts: makes .venv with pinned versions and installs residnet into it. Needs Python 3.11 to 3.13 and pip, nothing else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=""
for name in python3.11 python3.12 python3.13 python3; do
  if command -v "$name" >/dev/null && "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then
    python=$name
    break
  fi
done
if [ -z "$python" ]; then
  echo "residnet needs Python 3.11, 3.12 or 3.13; none was found" >&2
  exit 2
fi

install_residnet() {  # $1: extras, for example [dev,docs], or nothing
  if [ ! -x .venv/bin/python ]; then
    "$python" -m venv .venv
  fi
  local sum have wanted="${1//[\[\],]/ }" extra missing=""
  sum="$(cat pyproject.toml scripts/constraints.txt | cksum | tr ' ' -)"
  have=" $(cat .venv/installed 2>/dev/null || true) "
  for extra in "$sum" $wanted; do
    [[ "$have" == *" $extra "* ]] || missing="$missing $extra"
  done
  if [ -n "$missing" ]; then
    echo "installing into .venv (some minutes the first time)"
    # torch first and alone: pip takes the CPU build that the constraint names, and nothing after it asks for another
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint scripts/constraints.txt torch
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint scripts/constraints.txt --editable ".$1"
    if [[ "$have" == *" $sum "* ]]; then echo "$have $wanted" >.venv/installed; else echo "$sum $wanted" >.venv/installed; fi
  fi
}
