#!/usr/bin/env bash
# What the tests of viewers need, by apt where it is missing: Chromium and its driver for pages; for windows a screen in
# memory, keys pressed on it, and a Vulkan driver in software. Without them these tests skip, and say so.
set -euo pipefail

say() { echo "viewers: $*" >&2; }
has() { command -v "$1" >/dev/null 2>&1; }
has_library() { ldconfig -p 2>/dev/null | grep -q "$1"; }
has_browser() { { has chromium || has chromium-browser || has google-chrome; } && has chromedriver; }
has_window() {
    has Xvfb && has_library libXtst.so.6 && has_library libvulkan.so.1 && ls /usr/share/vulkan/icd.d/lvp_icd*.json >/dev/null 2>&1
}

SUDO=""
[ "$(id -u)" -eq 0 ] || SUDO="sudo -n"
install() {
    command -v apt-get >/dev/null && $SUDO true 2>/dev/null || return 0
    say "installing $*"
    $SUDO apt-get update -qq >/dev/null 2>&1 || true
    $SUDO env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1 || true
}

has_browser || install chromium chromium-driver
has_window || install xvfb libxtst6 libvulkan1 mesa-vulkan-drivers
has_browser || say "there is no browser and it cannot be installed here; the tests of pages in one are skipped"
has_window || say "there is no screen in memory or no Vulkan and neither can be installed here; the tests of windows are skipped"
