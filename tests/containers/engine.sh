#!/bin/sh
# Starts a second container engine, new enough for compose.yaml, beside the one of this machine: the
# packages of Debian trixie in a folder of their own, with a file system view and a network of their
# own. Nothing of the machine's own engine is touched.
#
#     sh tests/containers/engine.sh start [FOLDER]    prints what to export
#     sh tests/containers/engine.sh stop [FOLDER]
#
# Needs root, debootstrap and iptables. FOLDER, by default where the tests look, takes some 10 GB with
# images.
# What containers mount from this machine has to be in this checkout or in /tmp. DEBIAN is the
# mirror, by default the one of this machine's apt.
set -eu
cd "$(dirname "$0")/../.."
checkout=$(pwd)
folder=$(mkdir -p "${2:-/var/tmp/driveby-engine}" && cd "${2:-/var/tmp/driveby-engine}" && pwd)
root=$folder/root
sources=$(cat /etc/apt/sources.list /etc/apt/sources.list.d/*.sources 2>/dev/null || true)
mirror=${DEBIAN:-$(echo "$sources" | sed -nE 's/^(URIs:|deb) *([^ ]+).*/\2/p' | head -n 1)}
netns=driveby-engine
outside=10.213.0.1
inside=10.213.0.2

install() {
    [ -e "$root/.installed" ] && return
    rm -rf "$root"
    debootstrap --variant=minbase \
        --include=ca-certificates,docker.io,docker-cli,docker-compose,docker-buildx,iptables,procps \
        trixie "$root" "$mirror" >"$folder/debootstrap.log"
    touch "$root/.installed"
}

# A network of its own: two engines in one would each write the other's firewall.
connect() {
    ip netns add "$netns"
    ip link add driveby-out type veth peer name driveby-in netns "$netns"
    ip addr add "$outside/30" dev driveby-out
    ip link set driveby-out up mtu 1400
    ip -n "$netns" addr add "$inside/30" dev driveby-in
    ip -n "$netns" link set driveby-in up mtu 1400
    ip -n "$netns" link set lo up
    ip -n "$netns" route add default via "$outside"
    sysctl -q -w net.ipv4.ip_forward=1
    iptables -t nat -A POSTROUTING -s "$inside" -j MASQUERADE
    iptables -I FORWARD -i driveby-out -j ACCEPT
    iptables -I FORWARD -o driveby-out -j ACCEPT
}

disconnect() {
    iptables -D FORWARD -o driveby-out -j ACCEPT
    iptables -D FORWARD -i driveby-out -j ACCEPT
    iptables -t nat -D POSTROUTING -s "$inside" -j MASQUERADE
    ip netns del "$netns"
} 2>/dev/null

# Run inside the network and a mount namespace: make the folder the root directory and become dockerd.
enter='
set -eu
root=$1 folder=$2 checkout=$3
mount --make-rprivate /
mount --bind "$root" "$root"
for other in /dev /sys /tmp "$checkout" "$folder/sockets"; do
    mkdir -p "$root$other"
    mount --rbind "$other" "$root$other"
done
mount -t proc proc "$root/proc"
mount -t tmpfs tmpfs "$root/run"
cp -L /etc/resolv.conf "$root/etc/resolv.conf"
cd "$root"
mkdir -p .old
pivot_root . .old
umount -l /.old
exec dockerd --host "unix://$folder/sockets/docker.sock" --data-root /var/lib/docker \
    --exec-root /run/docker --pidfile /run/dockerd.pid --mtu 1400 --storage-driver overlay2
'

start() {
    install
    mkdir -p "$folder/sockets"
    if ! DOCKER_HOST=unix://$folder/sockets/docker.sock docker version >/dev/null 2>&1; then
        disconnect || true
        connect
        # `ip netns exec` would hide the control groups behind a /sys of its own.
        setsid nsenter --net=/run/netns/"$netns" unshare --mount --pid --fork --kill-child \
            sh -c "$enter" engine "$root" "$folder" "$checkout" </dev/null >"$folder/dockerd.log" 2>&1 &
        echo $! >"$folder/pid"
        for _ in $(seq 60); do
            DOCKER_HOST=unix://$folder/sockets/docker.sock docker version >/dev/null 2>&1 && break
            sleep 1
        done
    fi
    # `docker compose` of the same packages.
    mkdir -p "$folder/config/cli-plugins"
    ln -sf "$root"/usr/libexec/docker/cli-plugins/* "$folder/config/cli-plugins/"
    echo "export DOCKER_HOST=unix://$folder/sockets/docker.sock DOCKER_CONFIG=$folder/config"
}

stop() {
    [ -e "$folder/pid" ] && kill -- -"$(cat "$folder/pid")" && rm "$folder/pid"
    rm -f "$folder/sockets/docker.sock"
    disconnect || true
}

"$1"
