#!/usr/bin/env bash
# Installs what FastLGS needs on Debian or Ubuntu and builds it. Safe to run again: it skips what is there.
# With --tests also what only the tests need: ffmpeg, npm, Chromium with its driver, Snakemake, a standard library for wasm32, and Python's module.
set -euo pipefail
cd "$(dirname "$0")"

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"
    else fail "root rights are needed for: $* (run this script as root, or install sudo)"; fi
}

# Vulkan on the CPU, OpenCV's SIFT and inpainting with their headers, Python for the one-time weight conversion.
packages="mesa-vulkan-drivers libvulkan1 libopencv-features2d-dev libopencv-photo-dev pkg-config build-essential python3 python3-venv curl ca-certificates"
if [ "${1:-}" = --tests ]; then
    packages="$packages chromium chromium-driver ffmpeg"
    # Programs of others read what is exported; npm brings them.
    command -v npm >/dev/null || packages="$packages npm"
    # Where rustup cannot reach its server, Debian's compiler with its library's source builds for wasm32.
    if command -v rustup >/dev/null; then timeout 60 rustup target add wasm32-unknown-unknown >/dev/null 2>&1 || true; fi
    [ -d "$(rustc --print sysroot 2>/dev/null)/lib/rustlib/wasm32-unknown-unknown" ] || packages="$packages rustc-web rust-web-src"
fi
if command -v dpkg-query >/dev/null; then
    missing=""
    for p in $packages; do
        dpkg-query -W -f='${Status}' "$p" 2>/dev/null | grep -q 'install ok installed' || missing="$missing $p"
    done
    # A Python outside the package system serves as well.
    if python3 -c 'import venv, ensurepip' 2>/dev/null; then missing=${missing/ python3-venv/}; missing=${missing/ python3 / }; fi
    if [ -n "$missing" ]; then
        say "installing$missing"
        as_root apt-get update -qq || fail "apt-get update failed: check the network and /etc/apt/sources.list"
        # shellcheck disable=SC2086
        DEBIAN_FRONTEND=noninteractive as_root apt-get install -y -qq --no-install-recommends $missing >/dev/null \
            || fail "apt-get could not install:$missing"
    fi
else
    say "no dpkg here: please see that these are installed: $packages"
fi

if ! command -v cargo >/dev/null; then
    [ -f "$HOME/.cargo/env" ] && . "$HOME/.cargo/env"
fi
if ! command -v cargo >/dev/null; then
    say "installing Rust by rustup"
    curl -sSf https://sh.rustup.rs | sh -s -- -y --profile minimal -c rustfmt -c clippy >/dev/null \
        || fail "Rust could not be installed; get Rust 1.92 or newer from https://rustup.rs and run this again"
    . "$HOME/.cargo/env"
fi

say "building (the first build takes some minutes)"
# Tests build Python's module as well, in one go: alone it would have other features of most crates, and compile them once more.
what=""
if [ "${1:-}" = --tests ]; then what=--workspace; export PYO3_BUILD_EXTENSION_MODULE=1; fi
# shellcheck disable=SC2086
cargo build --release --locked $what --no-default-features --features fastlgs-cli/load-ort,fastlgs-cli/opencv --quiet || fail "the build failed; its messages are above"
say "installing the offline encoders"
./target/release/fastlgs models install-offline --quiet || fail "the offline encoders could not be installed; the message is above"
if [ "${1:-}" = --tests ] && [ ! -x target/snakemake/bin/snakemake ]; then
    say "installing Snakemake"
    python3 -m venv target/snakemake && target/snakemake/bin/pip install --quiet "snakemake>=9,<10" || fail "Snakemake could not be installed with pip"
fi
say "ready: $(./target/release/fastlgs --version), devices: $(./target/release/fastlgs info --json - | tr -d '\n ' | sed 's/.*"adapters":\[\([^]]*\)\].*/\1/')"
