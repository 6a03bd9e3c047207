#!/usr/bin/env bash
# Checks that fastlgs-core and fastlgs-grid build for browsers (wasm32).
# Uses rustup's target, or else Debian's compiler and the source of its standard library.
set -euo pipefail
cd "$(dirname "$0")/.."
# The result is never run, so fast compilation matters more than fast code.
export CARGO_PROFILE_RELEASE_OPT_LEVEL=0 CARGO_TARGET_DIR=target/wasm
build="cargo build --release --locked --quiet -p fastlgs-core -p fastlgs-grid --target wasm32-unknown-unknown"
if [ -d "$(rustc --print sysroot)/lib/rustlib/wasm32-unknown-unknown" ]; then
    $build
elif [ -d /usr/lib/rustlib/src/rust/library ] && /usr/bin/rustc --version >/dev/null 2>&1; then
    RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 $build -Zbuild-std=std,panic_abort
else
    echo "wasm: no standard library for wasm32; run 'rustup target add wasm32-unknown-unknown' or ./setup.sh --tests" >&2
    exit 1
fi
echo "wasm: fastlgs-core and fastlgs-grid build for wasm32-unknown-unknown"
