#!/usr/bin/env bash
# From nothing to a fitted, validated and exported vessel model: installs into .venv and runs configs/quickstart.yaml.
source "$(dirname "${BASH_SOURCE[0]}")/_venv.sh"
install_residnet ""
out=runs/quickstart
if [ -e "$out" ]; then
  out="runs/quickstart-$(date +%Y%m%dT%H%M%S)"
fi
exec .venv/bin/residnet run configs/quickstart.yaml --out "$out"
