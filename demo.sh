#!/usr/bin/env bash
# Runs all stages, from photos to answers. Usage: ./demo.sh [PHOTOS [TEXT...]]
# Without arguments, generates a small scene with poses first. Writes pictures and reports to
# scenes/NAME.
set -euo pipefail
start=$PWD
cd "$(dirname "$0")"
./setup.sh
fastlgs=./target/release/fastlgs
began=$(date +%s)

if [ $# -gt 0 ]; then
    photos=$(cd "$start" && realpath -- "$1")
    name=$(basename "$photos")
    shift
    texts=("$@")
    [ $# -gt 0 ] || texts=("chair" "table" "plant" "bicycle")
    max_side=480
else
    name=study
    photos=$PWD/scenes/photos-study
    mkdir -p scenes
    $fastlgs synth study -o "$photos" --views 48 --size 400x300
    texts=("soccer ball" "traffic light" "bookcase" "bicycle")
    view=008.png
    max_side=400
fi
scene=scenes/$name
mkdir -p "$scene"

echo "== make";       $fastlgs make "$photos" -o "$scene" --max-side "$max_side"
labelled=$(ls "$photos/labels" 2>/dev/null | sed 's/\.json$//' || true)
view=${view:-$(echo "$labelled" | head -n 1)}
[ -n "$view" ] && set -- --view "$view" || set --
echo "== render";     $fastlgs render "$scene" "$@" --what color,depth,feature,objects -o "$scene/pictures"
echo "== query: ${texts[*]}"
$fastlgs query "$scene" "${texts[@]}" "$@" --heatmap -o "$scene/pictures" || [ $? = 3 ]
if [ -n "$labelled" ]; then
    echo "== eval"; $fastlgs eval "$scene" --labels "$photos/labels"
else
    echo "== eval"; $fastlgs eval "$scene"
fi
echo "demo: finished in $(( $(date +%s) - began )) seconds after set-up; see $scene/pictures/sheet.png"
