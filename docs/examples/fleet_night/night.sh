#!/bin/sh
# A timer runs it each night: night.sh RECORDINGS SITE.toml TEMPERATURES.csv [day|week|month]
# Files of the night are added; nothing is identified or stored twice, so it may be run again.
set -eu
driveby catalog "$1"
driveby identify "$1" --site "$2" --into identified
driveby history add identified --temperature "$3"
driveby alarm check --period "${4:-week}"
