#!/bin/sh
# What the cell's image does without: `prune.sh packages FOLDER` (a site-packages folder), `prune.sh system` (the base).
# tests/docker/test_image.py starts the server in what is left, compares its answer and measures the size.
set -eu

packages() {
    cd "$1"
    # Tests: never imported by their packages.
    find . -type d -name tests -prune -exec rm -rf {} +
    # Headers, stubs, Cython sources and static libraries: for compilers and type checkers.
    find . -type f \( -name '*.h' -o -name '*.hpp' -o -name '*.pyi' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.a' \) -delete
    # onnxruntime: conversion and quantisation of models, profiling tools, sample models, and the library a second time
    # for C programs (29 MB; Python's module has it inside).
    rm -rf onnxruntime/tools onnxruntime/transformers onnxruntime/quantization onnxruntime/datasets
    rm -f onnxruntime/capi/libonnxruntime.so*
    # scipy: the cell calls spatial (the kd-tree), which imports constants, linalg, sparse and special. These are a
    # quarter of the image and nothing that stays imports them; tests/docker/test_prune.py holds that the cell does not either.
    for unused in cluster datasets differentiate fftpack integrate interpolate io misc odr optimize signal stats; do
        rm -rf "scipy/$unused"
    done
    # numpy: what once built C extensions.
    rm -rf numpy/distutils
    # Pillow: AVIF is 5 MB for a format no depth camera writes; Pillow says "not supported" without it.
    rm -rf PIL/_avif.*.so pillow.libs/libavif-*
    # The packages' own programs.
    find ../../../bin -type f ! -name attentionvote -delete
    # Never `strip`: the wheels' libraries were rewritten by patchelf, and OpenBLAS no longer loads after it.
}

system() {
    # pip, its wheels and the build tools of a Python image; then what only developers of Python use.
    for library in /usr/lib/python3.11 /usr/local/lib/python3.11 /usr/lib/python3; do
        rm -rf "$library"/ensurepip "$library"/idlelib "$library"/lib2to3 "$library"/tkinter "$library"/turtledemo \
            "$library"/test "$library"/pydoc_data "$library"/config-3.11-* "$library"/distutils
        for folder in "$library"/site-packages "$library"/dist-packages; do
            rm -rf "$folder"/pip "$folder"/pip-* "$folder"/setuptools* "$folder"/_distutils_hack \
                "$folder"/distutils-precedence.pth "$folder"/pkg_resources "$folder"/wheel "$folder"/wheel-*
        done
    done
    rm -rf /usr/share/python-wheels /usr/include /usr/local/include /usr/local/bin/pip* /usr/local/bin/wheel \
        /usr/local/bin/idle* /usr/local/bin/2to3* /usr/local/bin/pydoc* /usr/local/bin/python3*-config
    find / -xdev -name '*.a' -type f -delete
    # Bytecode of everything; warm.py writes again what the server imports.
    find / -xdev -name __pycache__ -type d -prune -exec rm -rf {} +
    # A cell installs nothing, knows no log-in and checks no file systems: apt, passwd, login and e2fsprogs with the
    # libraries that only they use, and perl. dpkg removes them, so its list, which scanners read, stays true; what
    # still depends on them are maintainer scripts, which never run again.
    for package in python3.11-venv python3-pip-whl python3-setuptools-whl \
        apt libapt-pkg6.0 gpgv libgnutls30 libp11-kit0 libhogweed6 libnettle8 libtasn1-6 libidn2-0 libunistring2 \
        adduser passwd login libsemanage2 libsemanage-common libsepol2 \
        e2fsprogs logsave libext2fs2 libss2 mount perl-base; do
        if dpkg-query -W "$package" >/dev/null 2>&1; then
            said=$(dpkg --purge --force-all "$package" 2>&1) || { echo "$said" >&2; exit 1; }
        fi
    done
    # Tables of iconv(); Python brings its own codecs.
    rm -rf /usr/lib/*-linux-gnu/gconv
    # Documentation, but the copyright notices that Debian's packages are passed on with.
    find /usr/share/doc -mindepth 2 ! -type d ! -name copyright -delete
    find /usr/share/doc -mindepth 1 -type d -empty -delete
    rm -rf /usr/share/man /usr/share/info /usr/share/locale /usr/share/lintian /usr/share/gcc \
        /var/cache/* /var/lib/apt /etc/apt /var/log/* /root/.cache
    # No program gives anybody more rights than he has.
    find / -xdev -type f -perm /6000 -exec chmod a-s {} +
}

case "${1:-}" in
    packages) packages "${2:?a folder}" ;;
    system) system ;;
    *) echo "prune.sh: say 'packages FOLDER' or 'system', got '${1:-}'" >&2; exit 2 ;;
esac
