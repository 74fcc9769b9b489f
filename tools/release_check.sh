#!/bin/sh
# Builds the wheel into dist/, installs it into an environment made from nothing, and runs the smoke preset with it from
# a folder outside the tree: what is missing in the wheel is missing there. An argument names another interpreter than
# python3.
set -eu

root=$(cd "$(dirname "$0")/.." && pwd)
outside=$(mktemp -d)
trap 'rm -rf "$outside"' EXIT INT TERM
unset PYTHONPATH

set -x
cd "$root"
rm -rf build dist  # a file of an earlier build would go into the wheel
"${1:-python3}" -m venv "$outside/venv"
"$outside/venv/bin/pip" wheel --quiet --no-deps --wheel-dir dist .
"$outside/venv/bin/pip" install --quiet -c constraints.txt dist/*.whl

cd "$outside"
export QDOS_DATA="$outside/data"
venv/bin/python -c "import envs, qdos_brax; print(qdos_brax.__file__); assert '$root' not in qdos_brax.__file__"
venv/bin/qdos tasks
venv/bin/qdos train --env antsoccer --preset smoke --out run
test -s run/report.html
venv/bin/qdos evaluate run --episodes 1
