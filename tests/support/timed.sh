#!/bin/sh
# Runs a test program that reports the seconds of each test. Runs other programs unchanged.
program=$1
shift
case "$program" in
    */deps/*) RUSTC_BOOTSTRAP=1 exec "$program" "$@" -Zunstable-options --report-time ;;
    *) exec "$program" "$@" ;;
esac
