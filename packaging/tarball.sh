#!/usr/bin/env bash
# Makes a tarball of binary, manual pages, completions and documents for Linux.
# Usage: packaging/tarball.sh [FOLDER]
# It runs on systems with the same or a newer C library. For old systems, run this script in a
# container of the oldest one. Vulkan and ONNX Runtime are loaded at run time, so the binary links
# only to the C library.
set -euo pipefail
cd "$(dirname "$0")/.."
out=$(mkdir -p "${1:-target/tarball}" && realpath "${1:-target/tarball}")
target=${CARGO_TARGET_DIR:-target}
cargo build --release --locked -p fastlgs-cli
version=$("$target/release/fastlgs" --version | cut -d' ' -f2)
name=fastlgs-$version-$(uname -m)-linux
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
install -Dm755 -s "$target/release/fastlgs" "$root/$name/bin/fastlgs"
"$root/$name/bin/fastlgs" man -o "$root/$name/share/man/man1"
for shell in bash zsh fish; do "$root/$name/bin/fastlgs" completions $shell >"$root/$name/fastlgs.$shell"; done
cp -r README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE docs assets "$root/$name/"
tar -C "$root" --sort=name --owner=0 --group=0 --numeric-owner --mtime=@0 -czf "$out/$name.tar.gz" "$name"
echo "$out/$name.tar.gz"
