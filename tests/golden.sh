#!/usr/bin/env bash
# Checks that a change keeps every output byte: the generated table and room, on the cpu backend.
#   tests/golden.sh save [BINARY]     before the change: keeps the hashes in target/golden/expected
#   tests/golden.sh check [BINARY]    after it: fails, and names the files, where a hash differs
set -euo pipefail
cd "$(dirname "$0")/.."
mode=${1:?save or check}
binary=$(realpath "${2:-target/release/fastlgs}")
work=target/golden
mkdir -p $work
export NODEVICE_SELECT=1 FASTLGS_DEVICE=cpu FASTLGS_DATA=$PWD/$work/data

fastlgs() { "$binary" "$@" -q >> $work/log.txt 2>&1 || { tail -5 $work/log.txt; exit 1; }; }
scene() { # NAME KIND VIEWS SIZE ITERATIONS PREPROCESS-OPTIONS -- TRAIN-OPTIONS
    local name=$1 kind=$2 views=$3 size=$4 iterations=$5 preprocess=()
    shift 5
    while [ "$1" != -- ]; do preprocess+=("$1"); shift; done
    shift
    local photos=$work/photos-$kind out=$work/scenes/$name
    fastlgs synth "$kind" -o "$photos" --views "$views" --size "$size"
    fastlgs preprocess "$photos" -o "$out" --seed 0 "${preprocess[@]}"
    fastlgs train "$out" --iterations "$iterations" --seed 0 "$@"
    fastlgs render "$out" -o "$out/rendered" --view 000 --what color,depth,objects
    fastlgs query "$out" table -o "$out/answer" --view 000 --false-alarms 1
    fastlgs export "$out" "$out/exported.spz"
}

rm -rf $work/scenes $work/photos-* $work/data $work/log.txt
scene table table 24 160x120 300 --segmenter import --
scene table-offline table 24 160x120 200 --
scene table-paper table 24 160x120 200 --segmenter import -- --mapping paper --feature-mode train
scene room room 32 160x120 300 --segmenter import --
# Reports hold seconds and paths; scene.json too.
(cd $work/scenes && find . -type f ! -name scene.json ! -path '*/cache/*' ! -path '*/logs/*' ! -path '*/checkpoints/*' ! -name '*.lock' -print0 |
    sort -z | xargs -0 sha256sum) > $work/$mode.txt
case $mode in
    save) mv $work/save.txt $work/expected; echo "golden: $(wc -l < $work/expected) files kept" ;;
    check)
        diff $work/expected $work/check.txt > $work/difference || { echo "golden: these files differ"; grep '^[<>]' $work/difference; exit 1; }
        echo "golden: $(wc -l < $work/expected) files are the same"
        ;;
esac
