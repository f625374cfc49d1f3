#!/bin/sh
# Starts a command of driveby in the container, or one of Dask (docs/cluster.md): first the compiled
# kernels go to where numba may write.
set -e
mkdir -p "$NUMBA_CACHE_DIR"
cp -rp "${KERNELS:-/app/kernels}/." "$NUMBA_CACHE_DIR"
[ "$1" = dask ] && exec "$@"
exec driveby "$@"
