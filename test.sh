#!/usr/bin/env bash
# Installs missing dependencies and runs the tests on any Vulkan device, such as lavapipe on
# machines without a GPU.
# --all runs everything before a release: the benches, long fuzzing, the page on fox,
# the packages, pip, and the originals of SAM and CLIP. It takes about an hour on two cores.
set -euo pipefail
cd "$(dirname "$0")"
./setup.sh --tests
export NODEVICE_SELECT=1          # Mesa's device chooser prints warnings without a desktop session
export FASTLGS_REQUIRE_GPU=1      # a missing device is an error, not a skip
export FASTLGS_REQUIRE_MODELS=1   # missing models as well; setup.sh installs them
ignored=
if [ "${1:-}" = --all ]; then
    export FASTLGS_TEST_ALL=1 FASTLGS_FUZZ_SECONDS=${FASTLGS_FUZZ_SECONDS:-5}
    ignored=--include-ignored
fi
# The same options as in setup.sh, so that nothing is built twice.
with="--workspace --no-default-features --features fastlgs-cli/load-ort,fastlgs-cli/opencv"
export PYO3_BUILD_EXTENSION_MODULE=1
lap() { printf 'test: %s took %d s\n' "$1" $((SECONDS - began)); began=$SECONDS; }
began=$SECONDS
cargo fmt --all --check
# shellcheck disable=SC2086
cargo clippy --release --locked --all-targets $with --quiet -- -D warnings
# Also checks the build without OpenCV, which has key points in pure Rust.
# shellcheck disable=SC2086
cargo clippy --release --locked ${with/opencv/rust-sift} --quiet -- -D warnings
lap "formatting and clippy"
# shellcheck disable=SC2086
RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --no-deps $with --quiet
lap "documentation"
tests/wasm.sh
if [ "${FASTLGS_TEST_ALL:-}" ]; then tests/packages.sh; fi
lap "wasm and packages"
tests/python.sh
lap "Python"
export FASTLGS_SNAKEMAKE=$PWD/target/snakemake/bin/snakemake
# The log shows the numbers of damaged inputs, and the slowest tests.
# shellcheck disable=SC2086
python3 tests/slowest.py cargo test --release --locked --no-fail-fast $with -- --show-output $ignored
if [ "${FASTLGS_TEST_ALL:-}" ]; then
    # Tests both kinds of key points against each other.
    cargo test --release --locked -p fastlgs-sfm --features opencv -- --show-output
    tests/reference.sh
fi
lap "tests"
