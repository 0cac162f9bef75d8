#!/bin/sh
# Install Debian packages that a Python lock file cannot name, where we may; else say the one line to run.
#   install-debian-packages.sh PACKAGE...
# Exit 0 when all are there, 1 when one is missing.
set -u
missing=""
for package in "$@"; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing="$missing $package"
done
[ -n "$missing" ] || exit 0
line="apt-get install -y --no-install-recommends$missing"
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing$missing"
    log=$(mktemp)
    if { apt-get update -q && DEBIAN_FRONTEND=noninteractive $line; } >"$log" 2>&1; then
        rm -f "$log"
        exit 0
    fi
    tail -n 3 "$log"
fi
echo "missing:$missing. Install with:  sudo $line"
exit 1
