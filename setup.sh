#!/usr/bin/env bash
# Installs the dependencies of FastLGS on Debian or Ubuntu, and builds it. Can be repeated safely.
# With --tests, also installs what only the tests need: ffmpeg, npm, Chromium with its driver,
# Snakemake, a standard library for wasm32, and the Python module.
set -euo pipefail
cd "$(dirname "$0")"

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"
    else fail "root rights are needed for: $*; run this script as root, or install sudo"; fi
}

# Vulkan on the CPU, OpenCV's SIFT and inpainting with headers, and Python for the one-time
# conversion of weights.
packages="mesa-vulkan-drivers libvulkan1 libopencv-features2d-dev libopencv-photo-dev pkg-config build-essential python3 python3-venv curl ca-certificates"
if [ "${1:-}" = --tests ]; then
    packages="$packages chromium chromium-driver ffmpeg"
    # npm installs other programs that read exported files.
    command -v npm >/dev/null || packages="$packages npm"
    # If rustup cannot reach its server, Debian's compiler and library source build for wasm32.
    if command -v rustup >/dev/null; then timeout 60 rustup target add wasm32-unknown-unknown >/dev/null 2>&1 || true; fi
    [ -d "$(rustc --print sysroot 2>/dev/null)/lib/rustlib/wasm32-unknown-unknown" ] || packages="$packages rustc-web rust-web-src"
fi
if command -v dpkg-query >/dev/null; then
    missing=""
    for p in $packages; do
        dpkg-query -W -f='${Status}' "$p" 2>/dev/null | grep -q 'install ok installed' || missing="$missing $p"
    done
    # A Python outside the package system is accepted too.
    if python3 -c 'import venv, ensurepip' 2>/dev/null; then missing=${missing/ python3-venv/}; missing=${missing/ python3 / }; fi
    if [ -n "$missing" ]; then
        say "installing$missing"
        as_root apt-get update -qq || fail "apt-get update failed: check the network and /etc/apt/sources.list"
        # shellcheck disable=SC2086
        DEBIAN_FRONTEND=noninteractive as_root apt-get install -y -qq --no-install-recommends $missing >/dev/null \
            || fail "apt-get failed to install:$missing"
    fi
else
    say "dpkg is missing; install these packages yourself: $packages"
fi

if ! command -v cargo >/dev/null; then
    [ -f "$HOME/.cargo/env" ] && . "$HOME/.cargo/env"
fi
if ! command -v cargo >/dev/null; then
    say "installing Rust with rustup"
    curl -sSf https://sh.rustup.rs | sh -s -- -y --profile minimal -c rustfmt -c clippy >/dev/null \
        || fail "installing Rust failed; install Rust 1.92 or newer from https://rustup.rs and run this again"
    . "$HOME/.cargo/env"
fi

say "building (the first build takes several minutes)"
# Tests also build the Python module, in the same build. A separate build has other features and
# would compile most crates again.
what=""
if [ "${1:-}" = --tests ]; then what=--workspace; export PYO3_BUILD_EXTENSION_MODULE=1; fi
# shellcheck disable=SC2086
cargo build --release --locked $what --no-default-features --features fastlgs-cli/load-ort,fastlgs-cli/opencv --quiet || fail "the build failed; see the messages above"
say "installing the offline encoders"
./target/release/fastlgs models install-offline --quiet || fail "installing the offline encoders failed; see the message above"
if [ "${1:-}" = --tests ] && [ ! -x target/snakemake/bin/snakemake ]; then
    say "installing Snakemake"
    python3 -m venv target/snakemake && target/snakemake/bin/pip install --quiet "snakemake>=9,<10" || fail "installing Snakemake with pip failed; see the messages above"
fi
say "ready: $(./target/release/fastlgs --version), devices: $(./target/release/fastlgs info --json - | tr -d '\n ' | sed 's/.*"adapters":\[\([^]]*\)\].*/\1/')"
