#!/usr/bin/env bash
# Makes a Debian package of the binary, its manual pages and completions. Usage: packaging/debian.sh
# [FOLDER]
# The package has no encoder weights. Each user installs them with `fastlgs models install-offline`.
set -euo pipefail
cd "$(dirname "$0")/.."
out=$(mkdir -p "${1:-target/debian}" && realpath "${1:-target/debian}")
target=${CARGO_TARGET_DIR:-target}
cargo build --release --locked -p fastlgs-cli
version=$("$target/release/fastlgs" --version | cut -d' ' -f2)
architecture=$(dpkg --print-architecture)
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
chmod 755 "$root"

install -Dm755 -s "$target/release/fastlgs" "$root/usr/bin/fastlgs"
"$root/usr/bin/fastlgs" man -o "$root/usr/share/man/man1"
gzip -9n "$root"/usr/share/man/man1/*
mkdir -p "$root/usr/share/bash-completion/completions" "$root/usr/share/zsh/vendor-completions" "$root/usr/share/fish/vendor_completions.d"
"$root/usr/bin/fastlgs" completions bash >"$root/usr/share/bash-completion/completions/fastlgs"
"$root/usr/bin/fastlgs" completions zsh >"$root/usr/share/zsh/vendor-completions/_fastlgs"
"$root/usr/bin/fastlgs" completions fish >"$root/usr/share/fish/vendor_completions.d/fastlgs.fish"
install -Dm644 -t "$root/usr/share/doc/fastlgs" README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE docs/*.md
# Packages of the shared libraries that the binary needs.
libraries=$(mkdir -p "$root/debian" && touch "$root/debian/control" && cd "$root" &&
    dpkg-shlibdeps -O --ignore-missing-info usr/bin/fastlgs 2>/dev/null | sed 's/^shlibs:Depends=//') || libraries="libc6, libgcc-s1"
rm -rf "$root/debian"
mkdir "$root/DEBIAN"
cat >"$root/DEBIAN/control" <<CONTROL
Package: fastlgs
Version: $version
Architecture: $architecture
Maintainer: The FastLGS developers <fastlgs@localhost>
Section: graphics
Priority: optional
Depends: ${libraries:-libc6, libgcc-s1}
Recommends: mesa-vulkan-drivers, python3-venv
Suggests: colmap
Description: open-vocabulary 3-D scenes from photos, without CUDA
 Trains 3-D Gaussians with a language field from photos, and answers text
 queries with masks, on any Vulkan device or on the CPU alone.
CONTROL
dpkg-deb --root-owner-group --build "$root" "$out/fastlgs_${version}_${architecture}.deb" >/dev/null
echo "$out/fastlgs_${version}_${architecture}.deb"
