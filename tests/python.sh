#!/usr/bin/env bash
# The Python module that `cargo build --workspace` has left, beside its Python files; with FASTLGS_TEST_ALL installed by pip as a user would, which
# compiles most of it once more.
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
