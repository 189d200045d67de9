#!/usr/bin/env bash
# Install the system libraries that Qt needs and this machine lacks (Debian and Ubuntu).
# Without the right to install it says what to ask for and goes on: headless work needs none.
set -euo pipefail
cd "$(dirname "$0")/.."

[ "$(uname)" = Linux ] || exit 0
missing="$(.venv/bin/python -m backend.verbs.qt_libraries)"
[ -n "$missing" ] || exit 0

say() { printf 'setup: %s\n' "$1" >&2; }
if ! command -v apt-get >/dev/null; then
    say "Qt needs system libraries that are missing; on Debian their packages are: $missing"
    say "Install their equivalents; 'make demo' works without them."
    exit 0
fi
if [ "$(id -u)" = 0 ]; then
    as_root=""
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo"
else
    say "Qt needs system libraries, and this account may not install them. Ask an administrator for:"
    say "    sudo apt-get install $missing"
    say "Until then the window and its tests do not start; 'make demo' works without them."
    exit 0
fi
say "installing system libraries: $missing"
# shellcheck disable=SC2086 # package names are words
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends $missing \
    || { $as_root apt-get update && $as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y --no-install-recommends $missing; } \
    || say "apt could not install them. Do it by hand: sudo apt-get install $missing"
