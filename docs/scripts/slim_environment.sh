#!/bin/sh
# Takes out of a Python environment what no container of ours uses: the Rerun viewer's program (the
# library that writes its files stays), Arrow's parts for remote services and query plans, Amazon's
# services but the store and its credentials, AVIF images, NumPy's build tools (but f2py, which SciPy
# imports), Pygments' lexers (Rich would colour source code with them), zstandard's module for PyPy,
# other packages' tests, sources of compiled modules, headers, debugging symbols of extension
# modules. May run again on the same environment.
#
#     slim_environment.sh FOLDER
set -e
cd "$1"/lib/python3*/site-packages
rm -rf rerun_cli numba/cuda/tests ./*.dist-info/sboms numpy/distutils \
    zstandard/_cffi.* zstandard/backend_cffi.py zstandard/__pycache__/backend_cffi.* \
    pyarrow/include pyarrow/src pyarrow/*flight* pyarrow/*s3* pyarrow/*_cpp_tests* \
    pyarrow/_substrait* PIL/_avif* pillow.libs/libavif*
for service in botocore/data/*/; do
    case $service in */s3/ | */sts/ | */sso/ | */sso-oidc/ | */signin/) ;; *) rm -rf "$service" ;; esac
done
for lexers in pygments/lexers pygments/lexers/__pycache__; do
    [ -d "$lexers" ] || continue
    find "$lexers" -maxdepth 1 -type f ! -name '__init__.*' ! -name '_mapping.*' -delete
done
find . -type d -name tests -prune -exec rm -rf {} +
find . -type f \( -name '*.c' -o -name '*.cpp' -o -name '*.h' -o -name '*.pyx' -o -name '*.pxd' \
    -o -name '*.pyi' -o -name '*.a' \) -delete
# A wheel has no links: the same library is in it under up to three names.
for library in pyarrow/*.so.*.*; do
    [ -f "$library" ] || continue
    for other in "${library%%.so.*}".so*; do
        [ "$other" -ef "$library" ] || { cmp -s "$library" "$other" && ln -f "$library" "$other"; }
    done
done
# The libraries in *.libs were made by a tool whose files strip would break. Times stay: by them the
# Dockerfile finds what is new.
find . -name '*.so*' -type f -size +40k -not -path './*.libs/*' -exec strip -p --strip-unneeded {} +
