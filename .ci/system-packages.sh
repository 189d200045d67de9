#!/usr/bin/env bash
# Install what this machine lacks (Debian and Ubuntu): the system libraries that Qt needs, or, with
# words COMMAND=PACKAGE, these commands. Without the right to install it says what to ask for and
# goes on: headless work needs none, and tests without their commands are reported as skipped.
set -euo pipefail
cd "$(dirname "$0")/.."

[ "$(uname)" = Linux ] || exit 0
what="Qt needs system libraries" without="the window and its tests do not start; 'make demo' works"
missing=""
if [ $# = 0 ]; then
    missing="$(.venv/bin/python -m touchdown.backend.cli.doctor.qt_libraries)"
else
    what="the tests by real keys need programs" without="they are skipped; all other tests run"
    for word in "$@"; do
        command -v "${word%%=*}" >/dev/null || missing="$missing ${word#*=}"
    done
    missing="${missing# }"
fi
[ -n "$missing" ] || exit 0

say() { printf 'setup: %s\n' "$1" >&2; }
if ! command -v apt-get >/dev/null; then
    say "$what that are missing; on Debian their packages are: $missing"
    say "Install their equivalents; without them $without."
    exit 0
fi
if [ "$(id -u)" = 0 ]; then
    as_root=""
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo"
else
    say "$what, and this account may not install them. Ask an administrator for:"
    say "    sudo apt-get install $missing"
    say "Without them $without."
    exit 0
fi
say "installing system packages: $missing"
# shellcheck disable=SC2086 # package names are words
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends $missing \
    || { $as_root apt-get update && $as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y --no-install-recommends $missing; } \
    || say "apt could not install them. Do it by hand: sudo apt-get install $missing"
