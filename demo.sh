#!/usr/bin/env bash
# Runs all stages, from photos to answers. Usage: ./demo.sh [PHOTOS [TEXT...]]
# Without arguments, generates a small room with poses first, and also points at an object, teaches a
# name and removes an object. Writes pictures and reports to scenes/NAME.
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
    # Five objects of the room, and one that is not in it.
    texts=("chair" "couch" "potted plant" "table lamp" "traffic light" "bicycle")
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
if [ "$name" = study ]; then
    # Taught names are stored in the scene folder instead of the user's own file.
    export FASTLGS_DATA=$scene
    echo "== teach";  $fastlgs teach "grandma's candle" "$scene" "$@" --point 183,118
    echo "== remove"; $fastlgs remove "$scene" chair -o scenes/study-tidy
    texts+=("grandma's candle")
    # A click on the television, and the room without the chair.
    set -- "$@" --point 378,140 --beside scenes/study-tidy
fi
echo "== query: ${texts[*]}"
$fastlgs query "$scene" "${texts[@]}" "$@" --heatmap -o "$scene/pictures" || [ $? = 3 ]
if [ -n "$labelled" ]; then
    echo "== eval"; $fastlgs eval "$scene" --labels "$photos/labels"
else
    echo "== eval"; $fastlgs eval "$scene"
fi
echo "demo: finished in $(( $(date +%s) - began )) seconds after set-up; see $scene/pictures/sheet.png"
