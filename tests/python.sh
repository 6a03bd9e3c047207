#!/usr/bin/env bash
# The Python module, installed by pip as a user would, with the kind of key points that all else was built with.
set -euo pipefail
cd "$(dirname "$0")/.."
python3 -m venv target/python
target/python/bin/pip install --quiet pytest
target/python/bin/pip install --quiet --config-settings=build-args="--locked --no-default-features --features load-ort,opencv" ./crates/fastlgs-py
target/python/bin/python -m pytest -q crates/fastlgs-py/tests
