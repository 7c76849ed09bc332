#!/usr/bin/env bash
# Make the virtual environment that every make target uses. Needs Python 3.12 (or pyenv with one) and nothing else.
set -euo pipefail
venv="${1:-.venv}"
cd "$(dirname "$0")/.."

find_python() {
  for candidate in python3.12 python3 python; do
    if command -v "$candidate" >/dev/null 2>&1 &&
      "$candidate" -c 'import sys; raise SystemExit(sys.version_info[:2] != (3, 12))' >/dev/null 2>&1; then
      "$candidate" -c 'import sys; print(sys.executable)'
      return
    fi
  done
  for candidate in "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python; do
    if [ -x "$candidate" ]; then
      echo "$candidate"
      return
    fi
  done
  return 1
}

if ! python="$(find_python)"; then
  echo "setup: Python 3.12 was not found. Install it ('apt-get install python3.12 python3.12-venv', 'brew install python@3.12' or 'pyenv install 3.12') and run the same command again." >&2
  exit 2
fi

if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
  echo "setup: $python has no venv module. Install it ('apt-get install python3.12-venv') and run the same command again." >&2
  exit 2
fi

if command -v uv >/dev/null 2>&1; then
  uv=uv
else
  # A private copy, so that nothing outside the repository changes.
  boot="$venv.uv"
  [ -x "$boot/bin/uv" ] || { "$python" -m venv "$boot" && "$boot/bin/python" -m pip install --quiet --disable-pip-version-check "uv>=0.5"; }
  uv="$boot/bin/uv"
fi

echo "setup: installing the pinned packages into $venv (a few GB the first time; under a minute on a fast line)"
[ -x "$venv/bin/python" ] || "$uv" venv --quiet --python "$python" "$venv"
"$uv" pip sync --quiet --python "$venv/bin/python" --require-hashes requirements.lock
"$uv" pip install --quiet --python "$venv/bin/python" --no-deps --no-build-isolation -e .
"$venv/bin/python" scripts/check_system.py
