#!/usr/bin/env bash
# Compares SAM, CLIP and SigLIP with their authors' programs, on random weights.
# Makes ONNX exports and the originals' outputs, and runs the tests `reference::` on them.
# Needs PyPI, a gigabyte for PyTorch, and a few minutes. `test.sh --all` runs it.
# REFERENCE_PYTHON names a Python 3.8 to 3.10, which that PyTorch needs, by name or path.
# SAM 2 needs five more gigabytes for a later PyTorch and its dependencies.
# It is tested only if REFERENCE_SAM2 names a Python 3.10 to 3.12.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${REFERENCE_PYTHON:-}
for version in 3.10 3.9 3.8; do
    [ "$python" ] || ! "python$version" -c 'import venv, ensurepip' 2>/dev/null || python=python$version
done
if [ -z "$python" ]; then
    echo "SKIPPED: no Python 3.8 to 3.10 for the originals of SAM, CLIP and SigLIP; set it: REFERENCE_PYTHON=FILE tests/reference.sh"
    exit 0
fi
venv=target/reference/venv out=$PWD/target/reference/out
ready=$venv/ready-$(cksum < tests/reference.sh | cut -d' ' -f1)
if [ ! -f "$ready" ]; then
    rm -rf "$venv"
    "$python" -m venv "$venv"
    "$venv/bin/pip" install --quiet torch==1.12.1 torchvision==0.13.1 transformers==4.37.2 segment-anything==1.0 \
        'numpy<2' 'onnx<1.16' 'protobuf<5' pillow
    touch "$ready"
fi
merges=${FASTLGS_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/fastlgs}/offline/bpe_simple_vocab_16e6.txt.gz
"$venv/bin/python" -W ignore tests/reference/sam.py "$out" > /dev/null
"$venv/bin/python" -W ignore tests/reference/clip.py "$out" "$merges" > /dev/null
"$venv/bin/python" -W ignore tests/reference/siglip.py "$out" > /dev/null
if [ -n "${REFERENCE_SAM2:-}" ]; then
    venv=target/reference/venv-sam2
    ready=$venv/ready-$(cksum < tests/reference.sh | cut -d' ' -f1)
    if [ ! -f "$ready" ]; then
        rm -rf "$venv"
        "$REFERENCE_SAM2" -m venv "$venv"
        "$venv/bin/pip" install --quiet 'setuptools<80' wheel torch==2.5.1 torchvision==0.20.1 hydra-core iopath tqdm onnx==1.17.0 pillow
        SAM2_BUILD_CUDA=0 "$venv/bin/pip" install --quiet --no-build-isolation --no-deps sam2==1.1.0
        touch "$ready"
    fi
    "$venv/bin/python" -W ignore tests/reference/sam_two.py "$out" > /dev/null
else
    rm -rf "$out/sam2"
    echo "SKIPPED: SAM 2 needs a Python 3.10 to 3.12; set it: REFERENCE_SAM2=FILE tests/reference.sh"
fi
FASTLGS_REFERENCE=$out cargo test --release --locked -p fastlgs-vision --no-default-features --features load-ort,opencv reference:: -- --nocapture
