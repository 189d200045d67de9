#!/usr/bin/env bash
# Build the documentation site into output/docs: `docs.sh html`, or `docs.sh linkcheck`.
# Sphinx lives in an environment of its own, which sees the packages of .venv. Only its set-up needs
# the network. DOCS_VENV=DIR uses one that is there.
set -euo pipefail
cd "$(dirname "$0")/.."

venv="${DOCS_VENV:-.venv-docs}"
key="$(cat .ci/docs-requirements.txt | cksum)"
if [ "$(cat "$venv/.ready" 2>/dev/null || true)" != "$key" ]; then
    printf 'docs: installing the tools into %s\n' "$venv"
    .venv/bin/python -m venv --clear "$venv"
    packages="$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
    own="$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
    printf 'import site; site.addsitedir("%s")\n' "$packages" > "$own/touchdown-packages.pth"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
        --requirement .ci/docs-requirements.txt
    printf '%s' "$key" > "$venv/.ready"
fi

export QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 MPLBACKEND=Agg TOUCHDOWN_DATA="$PWD/output/docs/data"
began=$SECONDS
"$venv/bin/python" -m sphinx -b "$1" -n -W --keep-going -q docs "output/docs/$1"
printf 'docs: output/docs/%s in %d s, no warnings\n' "$1" $((SECONDS - began))
