#!/bin/sh
# Installs Tidegate from this folder, without a network: verifies everything first, and refuses what is not as signed.
#   sh install.sh --allowed-signers FILE [--verify-only]
#   sh install.sh --allowed-signers FILE --backup FOLDER       # an upgrade: backs up before anything else
#   sh install.sh --rollback VERSION --backup FOLDER           # back to a version that is still installed
# FILE holds the release's public key and came another way than this folder (docs/3-operate/it-guide.md).
# Exit codes: 0 done, 1 a step failed, 2 refused and nothing changed.
set -eu

NAMESPACE=tidegate-bundle
SIGNER=releases@tidegate
here=$(cd "$(dirname "$0")" && pwd -P)
root=/opt/tidegate data=/var/lib/tidegate settings=/etc/tidegate user=tidegate python=python3
signers='' backup='' rollback='' image_engine='' verify_only=false debs=true service=true

refuse() { echo "install.sh: refused: $*" >&2; exit 2; }
fail() { echo "install.sh: FAILED: $*" >&2; exit 1; }
say() { echo "install.sh: $*"; }
value() { [ $# -ge 2 ] && [ -n "$2" ] || refuse "$1 needs a value"; }

while [ $# -gt 0 ]; do
    case "$1" in
        --allowed-signers) value "$@"; signers=$2; shift 2 ;;
        --backup) value "$@"; backup=$2; shift 2 ;;
        --rollback) value "$@"; rollback=$2; shift 2 ;;
        --root) value "$@"; root=$2; shift 2 ;;
        --data) value "$@"; data=$2; shift 2 ;;
        --settings) value "$@"; settings=$2; shift 2 ;;
        --user) value "$@"; user=$2; shift 2 ;;
        --python) value "$@"; python=$2; shift 2 ;;
        --load-image) value "$@"; image_engine=$2; shift 2 ;;
        --verify-only) verify_only=true; shift ;;
        --no-debs) debs=false; shift ;;
        --no-service) service=false; shift ;;
        *) refuse "unknown option $1" ;;
    esac
done

verify() {
    [ -n "$signers" ] || refuse "--allowed-signers FILE: the release's public key"
    [ -s "$signers" ] || refuse "$signers is missing or empty"
    case "$(readlink -f "$signers")" in "$here"/*) refuse "$signers came with what it shall prove: use the key that was handed over another way" ;; esac
    command -v ssh-keygen >/dev/null || refuse "ssh-keygen is missing (package openssh-client)"
    cd "$here"
    [ -s SHA256SUMS ] || refuse "SHA256SUMS is missing"
    [ -s SHA256SUMS.sig ] || refuse "the signature SHA256SUMS.sig is missing"
    ssh-keygen -Y verify -f "$signers" -I "$SIGNER" -n "$NAMESPACE" -s SHA256SUMS.sig <SHA256SUMS >/dev/null 2>&1 \
        || refuse "the signature is not of the key in $signers"
    [ -z "$(find . ! -type f ! -type d)" ] || refuse "it holds links or devices"
    listed=$(sed 's/^[0-9a-f]\{64\}  //' SHA256SUMS | sort)
    present=$(find . -type f ! -name SHA256SUMS ! -name SHA256SUMS.sig | sed 's,^\./,,' | sort)
    [ "$listed" = "$present" ] || refuse "it does not hold exactly the files that are signed"
    sha256sum --quiet --strict --check SHA256SUMS >/dev/null 2>&1 || refuse "a file was changed after it was signed"
    version=$(cat VERSION)
    say "signed by $SIGNER: Tidegate $version"
}

tidegate() { # PROGRAM-FOLDER COMMAND...
    folder=$1; shift
    # As the service's own account, with its settings, on its data.
    setpriv --reuid "$user" --regid "$user" --init-groups env TIDEGATE_DATA_DIR="$data" TIDEGATE_JOURNAL_DIR="$data/journal" \
        TIDEGATE_CONFIG="$settings/tidegate.toml" sh -c 'cd /; exec "$@"' sh "$folder/bin/tidegate" "$@"
}

stop_service() { if $service && systemctl is-active --quiet tidegate; then systemctl stop tidegate; fi; }

start_service() { ! $service || systemctl start tidegate; }

need_backup_folder() {
    [ -n "$backup" ] || refuse "--backup FOLDER: a backup is made first"
    [ -d "$backup" ] || refuse "$backup is no folder"
}

# The service that ran goes on running where a step fails.
fail_running() { start_service || true; fail "$@"; }

back_up() { # PROGRAM-FOLDER
    name=$backup/before-$(date -u +%Y-%m-%dT%H%M%SZ).backup
    tidegate "$1" backup "$name" || fail_running "the backup; the version before is still installed"
    say "backup: $name"
}

switch_to() { # VERSION
    ln -sfn "$root/$1" "$root/.next"
    mv -T "$root/.next" "$root/current"
}

[ "$(id -u)" = 0 ] || $verify_only || refuse "only root can install"

if [ -n "$rollback" ]; then
    older=$root/$rollback
    [ -x "$older/bin/tidegate" ] || refuse "version $rollback is not in $root"
    [ -e "$root/current" ] || refuse "no version is installed"
    newer=$(readlink -f "$root/current")
    [ "$newer" != "$(readlink -f "$older")" ] || refuse "version $rollback is installed already"
    need_backup_folder
    stop_service
    back_up "$newer"
    # With the newer program, which knows the way down; it refuses where data would be lost.
    tidegate "$newer" database downgrade "$(cat "$older/REVISION")" || fail_running "the older tables; $newer is still installed"
    switch_to "$rollback"
    start_service
    say "rolled back to $rollback"
    exit 0
fi

verify
! $verify_only || exit 0
[ "$(uname -m)" = "$(cat MACHINE)" ] || refuse "it is for $(cat MACHINE), and this machine is $(uname -m)"
target=$root/$version
[ ! -e "$target/REVISION" ] || refuse "version $version is installed already"
[ ! -e "$root/current" ] || need_backup_folder
space_kb=$(df --output=avail -k "$(dirname "$root")" | tail -1)
[ "$space_kb" -ge 2000000 ] || refuse "$(dirname "$root") has less than 2 GB of space"

if $debs; then
    missing=''
    for file in debs/*.deb; do
        dpkg -s "$(dpkg-deb -f "$file" Package)" >/dev/null 2>&1 || missing="$missing ./$file"
    done
    # From these files alone: no source of the machine's own is asked.
    # shellcheck disable=SC2086 # one word a file: the names are the bundle's own
    [ -z "$missing" ] || DEBIAN_FRONTEND=noninteractive apt-get -o Dir::Etc::sourcelist=/dev/null -o Dir::Etc::sourceparts=/dev/null \
        install -y --no-install-recommends $missing || fail "the Debian packages"
fi
"$python" -c 'import sys, venv; sys.exit(sys.version_info[:2] != (3, 11))' || refuse "$python must be Python 3.11 with venv"

id "$user" >/dev/null 2>&1 || useradd --system --user-group --home-dir "$data" --no-create-home --shell /usr/sbin/nologin "$user"
install -d -m 0755 "$root" "$settings"
install -d -m 0700 -o "$user" -g "$user" "$data"
rm -rf "$target"
"$python" -m venv "$target"
"$target/bin/python" -m pip --isolated install --quiet --disable-pip-version-check --no-index --find-links wheels --require-hashes -r requirements.lock \
    && "$target/bin/python" -m pip --isolated install --quiet --disable-pip-version-check --no-index --no-deps own/*.whl \
    || { rm -rf "$target"; fail "the Python packages"; }
revision=$("$target/bin/python" -I -c 'from service.storage.database.migrations import titles; print(list(titles())[-1])')
[ -e "$settings/tidegate.toml" ] || install -m 0640 -g "$user" room/tidegate.toml.example "$settings/tidegate.toml"
if [ -n "$image_engine" ]; then
    for archive in image/*; do [ ! -e "$archive" ] || "$image_engine" load --input "$archive" || fail "the image"; done
fi
if [ -e "$root/current" ]; then
    stop_service
    back_up "$(readlink -f "$root/current")"
fi
echo "$revision" >"$target/REVISION"
switch_to "$version"
if $service; then
    install -m 0644 tidegate.service /etc/systemd/system/tidegate.service
    systemctl daemon-reload
    systemctl enable tidegate
    systemctl restart tidegate
fi
say "installed $version in $target"
