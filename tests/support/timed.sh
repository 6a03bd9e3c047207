#!/bin/sh
# Runs a test program so that it tells how long each test took; other programs as they are.
program=$1
shift
case "$program" in
    */deps/*) RUSTC_BOOTSTRAP=1 exec "$program" "$@" -Zunstable-options --report-time ;;
    *) exec "$program" "$@" ;;
esac
