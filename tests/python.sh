#!/usr/bin/env bash
# Tests the Python module, with the library that `cargo build --workspace` has left.
# With FASTLGS_TEST_ALL, pip installs the module as for a user, which compiles most crates again.
set -euo pipefail
cd "$(dirname "$0")/.."
[ -x target/python/bin/python ] || python3 -m venv target/python
target/python/bin/pip install --quiet pytest "numpy>=1.23"
if [ "${FASTLGS_TEST_ALL:-}" ]; then
    target/python/bin/pip install --quiet --config-settings=build-args="--locked --no-default-features --features load-ort,opencv" ./crates/fastlgs-py
else
    package=target/python/package
    rm -rf "$package"
    mkdir "$package"
    cp -r crates/fastlgs-py/python/fastlgs "$package"
    cp target/release/lib_fastlgs.so "$package/fastlgs/_fastlgs.abi3.so"
    export PYTHONPATH=$PWD/$package
fi
target/python/bin/python -m pytest -q crates/fastlgs-py/tests
