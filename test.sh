#!/usr/bin/env bash
# Installs what is missing and runs all tests on whatever Vulkan device there is (lavapipe on a machine without GPU).
set -euo pipefail
cd "$(dirname "$0")"
./setup.sh --tests
export NODEVICE_SELECT=1          # Mesa's device chooser complains where there is no desktop session
export FASTLGS_REQUIRE_GPU=1      # a missing device is a failure here, not a skip
export FASTLGS_REQUIRE_MODELS=1   # and so are missing models, which setup.sh installs
cargo fmt --all --check
cargo clippy --release --locked --all-targets --features fastlgs-cli/opencv --quiet -- -D warnings
RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --no-deps --features fastlgs-cli/opencv --quiet
tests/wasm.sh
# Also builds without OpenCV, with the pure-Rust key points.
tests/packages.sh
export FASTLGS_SNAKEMAKE=$PWD/target/snakemake/bin/snakemake
# Counts of kills, damaged inputs and benches are part of the log.
cargo test --release --locked --features fastlgs-cli/opencv -- --show-output
