#!/usr/bin/env bash
# fastlgs-core and fastlgs-grid build for browsers: with rustup's target, else with Debian's compiler and its library's source.
set -euo pipefail
cd "$(dirname "$0")/.."
# Nothing runs here: code that is built quickly will do.
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
