#!/usr/bin/env bash
# A browser for the tests of pages: Chromium and its driver, by apt where they are missing. Without them these tests skip.
set -euo pipefail

has_browser() {
    { command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null 2>&1 &&
        command -v chromedriver >/dev/null 2>&1
}
say() { echo "browser: $*" >&2; }

has_browser && exit 0
SUDO=""
[ "$(id -u)" -eq 0 ] || SUDO="sudo -n"
if command -v apt-get >/dev/null && $SUDO true 2>/dev/null; then
    say "installing chromium and chromium-driver"
    $SUDO apt-get update -qq >/dev/null 2>&1 || true
    $SUDO env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium chromium-driver >/dev/null 2>&1 || true
fi
has_browser || say "there is none and it cannot be installed here; the tests of pages in a browser are skipped"
