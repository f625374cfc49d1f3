#!/bin/sh
# Makes the two images that Dockerfile and compose.yaml take from a registry, where none is within
# reach: the base image from Debian's packages, the router's from `zenohd`. Tags are read from the
# files. Images that are there already stay.
#
#     sh tests/containers/images.sh [FOLDER]
#     BASES="python:3.13-slim-trixie python:3.14-slim-forky" sh tests/containers/images.sh
#
# BASES names further base images, of other Debian releases: test_wheels.py takes them.
#
# `zenohd` is the program that ZENOHD names, or that of PATH, or is compiled from crates.io into
# FOLDER (default: build/containers). Without cargo stand_in.py takes its place, or with
# ZENOHD=tests/containers/stand_in.py. Needs root, debootstrap and a docker engine; DEBIAN is the
# mirror, by default the one of this machine's apt.
set -eu
cd "$(dirname "$0")/../.."
folder=$(mkdir -p "${1:-build/containers}" && cd "${1:-build/containers}" && pwd)
base=$(sed -n 's/^ARG BASE=//p' Dockerfile)
router=$(sed -n 's/^ *image: \(eclipse\/zenoh:.*\)/\1/p' compose.yaml)
sources=$(cat /etc/apt/sources.list /etc/apt/sources.list.d/*.sources 2>/dev/null || true)
mirror=${DEBIAN:-$(echo "$sources" | sed -nE 's/^(URIs:|deb) *([^ ]+).*/\2/p' | head -n 1)}

there() { docker image inspect "$1" >/dev/null 2>&1; }

# What the official image leaves out, this one does, too: documentation, translations, lists of
# packages, compiled Python. `python` is Debian's own interpreter.
make_base() {
    suite=${1##*-}
    # debootstrap treats all releases since 2020 alike and does not know the names of the newest.
    script=/usr/share/debootstrap/scripts/$suite
    [ -e "$script" ] || script=/usr/share/debootstrap/scripts/sid
    root=$(mktemp -d "$folder/root.XXXXXX")
    trap 'rm -rf "$root"' EXIT
    debootstrap --variant=minbase --include=python3,python3-pip,ca-certificates \
        "$suite" "$root" "$mirror" "$script" >"$folder/debootstrap.log"
    chroot "$root" python3 -c 'import sys; assert sys.argv[1].startswith(f"{sys.version_info[0]}.{sys.version_info[1]}-")' "${1#*:}"
    find "$root/usr" -name __pycache__ -type d -prune -exec rm -rf {} +
    rm -rf "$root"/var/lib/apt/lists/* "$root"/var/cache/* "$root"/usr/share/doc \
        "$root"/usr/share/man "$root"/usr/share/info "$root"/usr/share/locale \
        "$root"/usr/lib/python3*/EXTERNALLY-MANAGED
    mkdir -p "$root/var/cache/apt/archives/partial" "$root/var/lib/apt/lists/partial"
    ln -s /usr/bin/python3 "$root/usr/local/bin/python"
    tar -C "$root" -c . | docker import -c 'CMD ["python3"]' - "$1" >/dev/null
    rm -rf "$root"
}

# As the official image: /zenohd behind /entrypoint.sh.
make_router() {
    version=${router##*:}
    program=${ZENOHD:-$(command -v zenohd || echo "$folder/bin/zenohd")}
    if [ ! -x "$program" ] && [ -z "${ZENOHD:-}" ] && command -v cargo >/dev/null; then
        CARGO_BUILD_JOBS=${CARGO_BUILD_JOBS:-2} cargo install zenohd --version "$version" --locked \
            --quiet --root "$folder"
    fi
    if [ ! -x "$program" ]; then
        [ -z "${ZENOHD:-}" ] || { echo "ZENOHD=$ZENOHD: no such program" >&2; exit 2; }
        program=tests/containers/stand_in.py
    fi
    context=$(mktemp -d "$folder/router.XXXXXX")
    cp "$program" "$context/zenohd"
    case $program in *.py)
        python3 -m pip download --quiet --no-deps --only-binary :all: --dest "$context" \
            "eclipse-zenoh==$version"
        ;;
    esac
    docker build --quiet --tag "$router" --file - "$context" >/dev/null <<END
FROM $base
COPY . /router
RUN if ls /router/*.whl; then pip install --no-index --no-deps /router/*.whl; fi \\
    && mv /router/zenohd / && rm -r /router \\
    && /zenohd --version | grep -F "$version" \\
    && printf '#!/bin/sh\nexec /zenohd \$*\n' >/entrypoint.sh && chmod +x /entrypoint.sh
ENV RUST_LOG=info
ENTRYPOINT ["/entrypoint.sh"]
END
    rm -r "$context"
}

for one in "$base" ${BASES:-}; do there "$one" || make_base "$one"; done
there "$router" || make_router
docker image ls --format '{{.Repository}}:{{.Tag}} {{.Size}}' | grep -F -e "$router" $(printf -- "-e %s " "$base" ${BASES:-})
docker run --rm --entrypoint /zenohd "$router" --version
