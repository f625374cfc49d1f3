#!/bin/sh
# A timer runs it each night: night.sh RECORDINGS SITE.toml TEMPERATURES.csv [day|week|month]
# Without temperatures the third argument is "-", or is omitted.
# Files of the night are added; nothing is identified or stored twice, so it may be run again.
set -eu
status=0

if [ $# -lt 2 ]; then
    echo "usage: night.sh RECORDINGS SITE.toml [TEMPERATURES.csv|-] [day|week|month]" >&2
    exit 2
fi
recordings=$1
site=$2
temperatures=${3:--}
period=${4:-week}
# A wrong file must not be found only after hours of identification.
if [ "$temperatures" != - ] && [ ! -r "$temperatures" ]; then
    echo "night.sh: $temperatures: cannot be read; - stands for no temperatures" >&2
    exit 2
fi

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

run driveby catalog "$recordings"
run driveby identify "$recordings" --site "$site" --into identified

# A worker's results outlive the recordings that a logger with --budget deletes.
set -- identified
for folder in "$recordings"/*/; do
    for file in "$folder"results-*.json; do
        if [ -e "$file" ]; then
            set -- "$@" "${folder%/}"
            break
        fi
    done
done
if [ "$temperatures" != - ]; then
    set -- "$@" --temperature "$temperatures"
fi
run driveby history add "$@"
run driveby alarm check --period "$period"
exit "$status"
