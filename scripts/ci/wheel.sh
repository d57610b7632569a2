#!/usr/bin/env bash
# Builds wheel and sdist, installs the wheel into an environment that holds no residnet, and runs it
# far from the checkout: shipped configs and vessels must be found by name.
source "$(dirname "${BASH_SOURCE[0]}")/../_venv.sh"
install_residnet "[dev]"
root="$PWD"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

echo "building wheel and sdist"
.venv/bin/python -m build --no-isolation --outdir "$work/dist" . >"$work/build.log" 2>&1 || { cat "$work/build.log" >&2; exit 1; }
for part in docs/index.md examples/ configs/quickstart.yaml src/residnet/core/version.py tests/test_layers.py; do
  tar -tzf "$work"/dist/*.tar.gz | grep "/$part" >/dev/null || { echo "the sdist lacks $part" >&2; exit 1; }
done

# The dependencies are those of .venv, read only; residnet itself comes from the wheel alone.
.venv/bin/python -m venv --without-pip "$work/venv"
site="$("$work/venv/bin/python" -c 'import site; print(site.getsitepackages()[0])')"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-index --target "$site" "$work"/dist/*.whl
.venv/bin/python -c 'import site; print(site.getsitepackages()[0])' >"$site/dependencies.pth"

mkdir "$work/elsewhere"
cd "$work/elsewhere"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
python="$work/venv/bin/python"
"$python" -c "
import pathlib, residnet
from residnet.core.version import __version__
place = pathlib.Path(residnet.__file__)
assert str(place).startswith('$work'), f'residnet comes from {place}, not from the wheel'
print('residnet', __version__, 'from the wheel')"
"$python" -m residnet.cli list vessels | grep '^wam_v_cal ' >/dev/null
"$python" -m residnet.cli check quickstart
echo "running quickstart, shortened, from the wheel"
"$python" -m residnet.cli run quickstart --out run -s "~heads.mlp" -s "~heads.lstm" -s "~training" >run.log 2>&1 || { cat run.log >&2; exit 1; }
for file in report.html summary.json metrics.json; do
  test -s "run/$file" || { echo "the run left no $file" >&2; exit 1; }
done
echo "the wheel runs: $(ls "$work"/dist | tr '\n' ' ')"
