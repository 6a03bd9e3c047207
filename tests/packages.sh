#!/usr/bin/env bash
# Tests that `cargo install` gives a working binary, and that packaging/ makes complete packages of
# it.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cargo install --path crates/fastlgs-cli --locked --quiet --root "$work/installed" --target-dir target
"$work/installed/bin/fastlgs" info --json - >/dev/null
"$work/installed/bin/fastlgs" synth table -o "$work/photos" --views 4 --size 64x48 -q
deb=$(packaging/debian.sh "$work/deb")
dpkg-deb -x "$deb" "$work/root"
"$work/root/usr/bin/fastlgs" --version
for file in usr/share/man/man1/fastlgs-query.1.gz usr/share/bash-completion/completions/fastlgs usr/share/doc/fastlgs/LICENSE-MIT; do
    [ -s "$work/root/$file" ] || { echo "packages: the Debian package lacks $file" >&2; exit 1; }
done
tarball=$(packaging/tarball.sh "$work/tar")
tar -C "$work/tar" -xzf "$tarball"
"$work"/tar/*/bin/fastlgs --version
echo "packages: cargo install, Debian package and tarball work"
