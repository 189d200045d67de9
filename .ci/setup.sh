#!/usr/bin/env bash
# Make .venv ready: interpreter, packages at the pinned versions, Qt's system libraries.
# Does nothing (in well under a second) if nothing changed since the last time.
set -euo pipefail
cd "$(dirname "$0")/.."

fail() { printf 'setup: %s\n' "$1" >&2; exit 1; }

is_fit() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        is_fit "$PYTHON" || fail "PYTHON=$PYTHON is not CPython 3.11, 3.12 or 3.13."
        printf '%s' "$PYTHON"
        return
    fi
    for name in .venv/bin/python python3.11 python3.12 python3.13 python3; do
        if is_fit "$name"; then printf '%s' "$name"; return; fi
    done
    fail "no CPython 3.11, 3.12 or 3.13 found. Debian 12: apt install python3 python3-venv. \
Elsewhere name one: make setup PYTHON=/path/to/python3.12"
}

python="$(find_python)"
version="$("$python" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])')"
key="$( { cat pyproject.toml constraints.txt .ci/setup.sh; printf '%s %s' "$version" "$PWD"; } | cksum)"
# The parts of the package lie beside touchdown/; with the links every tool sees one package.
for part in app backend resources widgets; do
    [ -e "touchdown/$part" ] || ln -s "../$part" "touchdown/$part" || true
done
if [ "$(cat .venv/.ready 2>/dev/null || true)" = "$key" ] && [ -x .venv/bin/touchdown ]; then
    exit 0
fi

present="$(.venv/bin/python -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null || true)"
if [ "$present" != "$version" ]; then
    printf 'setup: creating .venv with CPython %s\n' "$version"
    if ! "$python" -m venv --clear .venv; then
        rm -rf .venv
        fail "cannot create a virtual environment. Debian/Ubuntu: apt install python3-venv"
    fi
fi

printf 'setup: installing packages (the first time takes some minutes)\n'
install() {
    .venv/bin/python -m pip install --quiet --disable-pip-version-check \
        --constraint constraints.txt --editable '.[app,cad,dev,mujoco]'
}
# What came through is kept by pip: the second try goes on where a broken download ended the first.
install || { printf 'setup: once more in 10 s\n' >&2; sleep 10; install; } \
    || fail "pip could not install the packages (see above). Is the network reachable?"
.ci/system-packages.sh
printf '%s' "$key" > .venv/.ready
printf 'setup: ready\n'
