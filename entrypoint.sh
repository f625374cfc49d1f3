#!/bin/sh
# Starts a command of driveby in the container, or one of Dask (docs/cluster.md), or Python's own
# while the image is built. First the compiled kernels go to where numba may write.
set -e
# Kernels for one kind of processor would be compiled again on every other. This kind is what servers
# have had since 2013; numba compiles for itself on an older or another one.
if grep -qw avx2 /proc/cpuinfo && grep -qw fma /proc/cpuinfo && grep -qw bmi2 /proc/cpuinfo; then
    export NUMBA_CPU_NAME=x86-64-v3 NUMBA_CPU_FEATURES=
fi
kernels=${KERNELS:-/app/kernels}
if [ -d "$kernels" ] && [ "$kernels" != "$NUMBA_CACHE_DIR" ]; then
    mkdir -p "$NUMBA_CACHE_DIR"
    cp -rp "$kernels/." "$NUMBA_CACHE_DIR"
fi
case $1 in dask | python) exec "$@" ;; esac
exec driveby "$@"
