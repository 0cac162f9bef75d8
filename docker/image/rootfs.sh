#!/bin/sh
# Copy the installed Debian packages that run, and nothing else, into a folder that becomes the image's root.
#   rootfs.sh FOLDER PACKAGE...
# The packages and all they depend on, but for package management, Perl and log-in, which only their installation needs.
# No shell, no package manager and no setuid file is left; what a scanner reads of Debian (the packages and their
# versions) is.
set -eu
root=$1; shift
left_out='debconf|debconf-2.0|cdebconf|dpkg|perl-base|perl|tar|install-info|login|passwd|adduser|libpam.*|python3-distutils|libcrypt1-dev'

# A package that only a left-out one needs is not wanted: the recursion is done one step at a time.
wanted="$*"; new="$*"
while [ -n "$new" ]; do
    next=""
    for package in $new; do
        for one in $(dpkg-query -W -f='${Pre-Depends}, ${Depends}\n' "$package" \
            | tr ',|' '\n\n' | sed 's/([^)]*)//; s/:any//; s/ //g' | grep . || true); do
            echo "$one" | grep -qxE "$left_out" && continue
            dpkg-query -W -f='${Status}' "$one" 2>/dev/null | grep -q 'ok installed' || continue
            case " $wanted $next " in *" $one "*) ;; *) next="$next $one" ;; esac
        done
    done
    wanted="$wanted $next"; new=$next
done

mkdir -p "$root/usr/bin" "$root/usr/sbin" "$root/usr/lib" "$root/usr/lib64" "$root/tmp" "$root/run" "$root/proc" "$root/sys" "$root/dev" "$root/var/lib/dpkg" "$root/etc"
chmod 1777 "$root/tmp"
for folder in bin sbin lib lib64; do ln -s "usr/$folder" "$root/$folder"; done
for package in $wanted; do
    dpkg-query -L "$package" | while read -r file; do
        case $file in
            /usr/share/man/*|/usr/share/locale/*|/usr/share/info/*|/usr/share/lintian/*|/usr/share/bug/*|*/gconv/*|/usr/share/zoneinfo/right/*) continue ;;
            /usr/share/doc/*) [ "${file##*/}" = copyright ] || continue ;;
        esac
        if [ -f "$file" ] || [ -L "$file" ]; then echo "${file#/}"; fi
    done
done | sort -u >/tmp/files
tar -C / -c --no-recursion -T /tmp/files 2>/dev/null | tar -C "$root" -x --keep-directory-symlink
# Bytecode of Python's own library, as its installation has made it.
( cd / && find usr/lib/python3* -name __pycache__ -type d -print0 | tar -c --null -T - ) | tar -C "$root" -x
for file in etc/ld.so.cache etc/nsswitch.conf; do [ ! -e "/$file" ] || cp -a "/$file" "$root/$file"; done
# ctypes finds the camera's runtime with it.
cp -a /usr/sbin/ldconfig "$root/usr/sbin/ldconfig" 2>/dev/null || cp -a /sbin/ldconfig "$root/usr/sbin/ldconfig"
for package in $wanted libc-bin; do dpkg-query -s "$package"; echo; done >"$root/var/lib/dpkg/status"
echo 'root:x:0:0:root:/:/usr/sbin/nologin
tidegate:x:10001:10001:Tidegate:/data:/usr/sbin/nologin' >"$root/etc/passwd"
echo 'root:x:0:
tidegate:x:10001:' >"$root/etc/group"
find "$root" -xdev -type f -perm /6000 -exec chmod a-s {} +
mkdir -p "$root/data"; chmod 0700 "$root/data"; chown 10001:10001 "$root/data"
du -sm "$root" | cut -f1 | sed 's/$/ MB of Debian packages/'
