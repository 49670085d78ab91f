#!/bin/sh
# debian_base.sh IMAGE: a base for docker/Dockerfile without any image registry: Debian 12 with its security updates and
# its Python 3.11, made by debootstrap, cut down as Debian's slim images are, kept by buildah. Needs root and a mirror of
# Debian (MIRROR, else debootstrap's own).
set -eu
image="${1:?say the name of the image, e.g. localhost/attentionvote-base}"

work=$(mktemp -d)
root="$work/root"
trap 'umount "$root" 2>/dev/null || true; rm -rf "$work"' EXIT
mkdir "$root"
# In memory: dpkg waits for the disk after every file, which doubles the time.
mount -t tmpfs -o size=2g,mode=755 tmpfs "$root"

make_root() {
    debootstrap --variant=minbase --include=python3.11 bookworm "$root" ${MIRROR:-}
    main=$(awk '$1 == "deb" {print $2; exit}' "$root/etc/apt/sources.list")
    echo "deb ${main%/debian*}/debian-security bookworm-security main" >>"$root/etc/apt/sources.list"
    # As in Debian's images: what is built on this base does not wait for the disk either.
    echo force-unsafe-io >"$root/etc/dpkg/dpkg.cfg.d/unsafe-io"
    chroot "$root" apt-get update -q
    chroot "$root" env DEBIAN_FRONTEND=noninteractive apt-get upgrade -y -q --no-install-recommends
    chroot "$root" apt-get clean
}
make_root >"$work/log" 2>&1 || { tail -n 5 "$work/log" "$root/debootstrap/debootstrap.log" >&2; exit 1; }

(cd "$root" && find usr/share/doc -mindepth 2 ! -type d ! -name copyright -delete && rm -rf debootstrap etc/resolv.conf etc/hostname var/lib/apt/lists/* var/log/* var/cache/debconf/*-old \
    usr/share/man/* usr/share/info/* usr/share/locale/*)
container=$(buildah from scratch)
buildah copy -q "$container" "$root" / >/dev/null
buildah commit -q --rm "$container" "$image" >/dev/null
