#!/bin/sh
# build.sh [IMAGE [ARGUMENT...]]: the cell's image, by docker where its engine runs, else by buildah. BASE names another
# base image, PIP_CONF a pip.conf for the build alone; more arguments go to the builder (--target mlflow, ...).
set -eu
cd "$(dirname "$0")/.."
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' src/attentionvote/__init__.py)
image="${1:-attentionvote:$version}"
[ $# -eq 0 ] || shift
revision=$(git rev-parse HEAD 2>/dev/null || echo unknown)
[ "$revision" = unknown ] || git diff --quiet HEAD || revision="$revision+dirty"
[ -z "${BASE:-}" ] || set -- --build-arg "BASE=$BASE" "$@"
[ -z "${PIP_CONF:-}" ] || set -- --secret "id=pip,src=$PIP_CONF" "$@"
set -- --label "org.opencontainers.image.version=$version" --label "org.opencontainers.image.revision=$revision" \
    -f docker/Dockerfile -t "$image" "$@" .

if [ "${BUILDER:-docker}" = docker ] && docker info >/dev/null 2>&1; then
    exec docker build "$@"
elif command -v buildah >/dev/null; then
    # OCI's own format has no health check.
    exec buildah build --format docker --ignorefile docker/Dockerfile.dockerignore \
        --isolation "${BUILDAH_ISOLATION:-chroot}" --layers "$@"
fi
echo "build.sh: needs a running docker engine or buildah, found neither; install one (Debian: buildah)" >&2
exit 1
