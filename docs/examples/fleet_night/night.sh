#!/bin/sh
# A timer runs it each night: night.sh RECORDINGS SITE.toml TEMPERATURES.csv [day|week|month]
# Files of the night are added; nothing is identified or stored twice, so it may be run again.
set -eu
status=0

# Exit code 3 means done, but something is lost: the rest is done all the same, and reported at the end.
run() {
    code=0
    "$@" || code=$?
    case $code in
        0) ;;
        3) status=3 ;;
        *) exit "$code" ;;
    esac
}

run driveby catalog "$1"
run driveby identify "$1" --site "$2" --into identified
run driveby history add identified --temperature "$3"
run driveby alarm check --period "${4:-week}"
exit "$status"
