#!/bin/sh
# The system libraries that open3d loads: installed where that is possible, else named.
set -eu
[ "$(uname -s)" = Linux ] || exit 0

missing=""
need() { # soname, Debian package
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep -q "$1" || missing="$missing $2"
}
need libusb-1.0.so.0 libusb-1.0-0
need libEGL.so.1 libegl1
need libGL.so.1 libgl1
need libX11.so.6 libx11-6
need libgomp.so.1 libgomp1
[ -n "$missing" ] || exit 0

get() { # apt-get, after another one (a fresh machine's unattended upgrades) is done: at most ten minutes
    for _ in $(seq 120); do
        said=$(DEBIAN_FRONTEND=noninteractive apt-get "$@" 2>&1) && return 0
        case $said in *"Could not get lock"*) sleep 5 ;; *) break ;; esac
    done
    echo "$said" >&2
    return 1
}

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing:$missing"
    get update -qq
    # shellcheck disable=SC2086 # a list of packages
    get install -y -qq --no-install-recommends $missing
else
    echo "open3d needs system libraries that are missing. On Debian or Ubuntu: sudo apt-get install$missing" >&2
    exit 1
fi
