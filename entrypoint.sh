#!/bin/sh
# Starts a command of driveby in the container: first the compiled kernels go to where numba may write.
set -e
mkdir -p "$NUMBA_CACHE_DIR"
cp -rp "${KERNELS:-/app/kernels}/." "$NUMBA_CACHE_DIR"
exec driveby "$@"
