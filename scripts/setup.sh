#!/usr/bin/env bash
# Set-up behind `make demo` and `make test`: a virtual environment in .venv with this package, what checks it, and Open3D;
# with the argument `demo`, this package and its viewer alone.
#
# Does nothing when .venv already fits: same pyproject.toml, same script, same folder, a suitable Python.
# PYTHON=... chooses the interpreter. Network: the package index through pip, and apt where a system package is missing.
set -euo pipefail
cd -P "$(dirname "${BASH_SOURCE[0]}")/.."

export PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1
# What the shared libraries of Open3D 0.19 and 0.20 link and Debian does not install by itself. Taichi links libX11 too.
OPEN3D_LIBRARIES=(libgl1 libegl1 libx11-6 libgomp1 libidn2-0 libusb-1.0-0)
STAMP=.venv/set-up-done
WANTED=${1:-all}
SUDO=""
[ "$(id -u)" -eq 0 ] || SUDO=sudo

say() { echo "set-up: $*" >&2; }
die() { say "$@"; exit 1; }

is_suitable() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }
makes_venvs() { "$1" -c 'import ensurepip, venv' 2>/dev/null; }
loads_x11() { "$1" -c 'import ctypes; ctypes.CDLL("libX11.so.6")' 2>/dev/null; }
identity() { "$1" -c 'import sys; print(sys.base_prefix, sys.version)' 2>/dev/null; }

# Fails without asking for a password where this user may not install system packages.
apt_install() {
    local messages
    command -v apt-get >/dev/null || return 1
    [ -z "$SUDO" ] || sudo -n true 2>/dev/null || return 1
    say "installing system packages: $*"
    # A stale third-party source makes `update` fail; whether the packages are there is the install's to say.
    $SUDO apt-get update -qq >/dev/null 2>&1 || true
    messages=$($SUDO env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" 2>&1) ||
        { echo "$messages" >&2; return 1; }
}

# Prints the interpreter to use: the first suitable one, preferably one that can make virtual environments already.
find_python() {
    local candidate incomplete=""
    if [ -n "${PYTHON:-}" ]; then
        is_suitable "$PYTHON" || die "PYTHON=$PYTHON is not a Python 3.11, 3.12 or 3.13 that runs here; name another one."
        echo "$PYTHON"
        return
    fi
    for candidate in python3 python3.12 python3.11 python3.13; do
        is_suitable "$candidate" || continue
        if makes_venvs "$candidate"; then echo "$candidate"; return; fi
        incomplete=${incomplete:-$candidate}
    done
    [ -n "$incomplete" ] || die "found no Python 3.11, 3.12 or 3.13; install one, or name one with PYTHON=/path/to/python3.12."
    echo "$incomplete"
}

# Prints the system packages without which nothing works.
lacking_packages() {
    makes_venvs "$1" || "$1" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    loads_x11 "$1" || echo libx11-6
}

make_venv() {
    local python packages
    python=$(find_python)
    packages=$(lacking_packages "$python" | xargs)
    if [ -n "$packages" ]; then
        # shellcheck disable=SC2086  # a list of names
        { apt_install $packages && [ -z "$(lacking_packages "$python")" ]; } ||
            die "$python lacks system packages; run: ${SUDO:+sudo }apt-get install -y $packages"
    fi
    say "making .venv with $("$python" -VV)"
    "$python" -m venv --clear .venv || die "$python could not make a virtual environment in $PWD/.venv (its own message is above)."
}

# .venv runs, has pip, was made in this folder (its scripts hold the path), and is of the Python asked for.
venv_fits() {
    is_suitable .venv/bin/python && .venv/bin/python -c 'import pip' 2>/dev/null || return 1
    grep -qsF "$PWD/.venv" .venv/bin/activate || return 1
    [ -z "${PYTHON:-}" ] || [ "$(identity "$PYTHON")" = "$(identity .venv/bin/python)" ]
}

pip_install() {
    local quiet=--quiet
    [ ! -t 2 ] || quiet=
    .venv/bin/python -m pip install $quiet "$@" >&2
}

# Reconstruction does not need Open3D, so nothing here ends the set-up.
add_open3d() {
    local left_out="only comparisons with it are left out" reason
    pip_install -e '.[open3d]' ||
        { say "pip could not install Open3D; $left_out; to try again: .venv/bin/python -m pip install -e '.[open3d]'"; return; }
    open3d_imports && return
    apt_install "${OPEN3D_LIBRARIES[@]}" && open3d_imports && return
    reason=$(.venv/bin/python -c 'import open3d' 2>&1 | tail -n 1) || true
    say "Open3D does not import ($reason); $left_out; to add it: ${SUDO:+sudo }apt-get install -y ${OPEN3D_LIBRARIES[*]}"
}
open3d_imports() { .venv/bin/python -c 'import open3d' >/dev/null 2>&1; }

fingerprint() { { cat pyproject.toml scripts/setup.sh; identity .venv/bin/python; } | cksum; }

if venv_fits; then
    for done in all "$WANTED"; do
        [ "$(cat $STAMP 2>/dev/null)" != "$(fingerprint) $done" ] || exit 0
    done
else
    make_venv
fi
rm -f $STAMP
if [ "$WANTED" = demo ]; then extra=viewer size=0.3; else extra=dev size=0.8; fi
say "installing packages into .venv; the first time this downloads about $size GB"
pip_install -e ".[$extra]" ||
    die "pip could not install the packages (its own message is above); check the network, then run the command again."
[ "$WANTED" = demo ] || add_open3d
echo "$(fingerprint) $WANTED" > $STAMP
say "ready"
