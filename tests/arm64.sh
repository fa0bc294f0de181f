#!/usr/bin/env bash
# Proves the README's installation on aarch64: makes a Debian arm64 tree, runs in it, under user-mode emulation, the
# commands that the README gives for the robot, then the tests against what they installed.
#
#     sudo tests/arm64.sh bookworm|trixie TREE [pytest arguments]
#
# TREE is kept and used again. Needs debootstrap, qemu-user-static and binfmt-support; MIRROR names a Debian mirror.
# Emulation is ten times slower than the machine (a hundred times in linear algebra): this is about right, not fast.
set -euo pipefail
[ $# -ge 2 ] || { sed -n '2,8s/^# \{0,1\}//p' "$0"; exit 2; }
suite=$1
tree=$2
shift 2
clone=$(cd "$(dirname "$0")/.." && pwd)

[ "$(id -u)" = 0 ] || { echo "arm64: run me as root: debootstrap and chroot need it" >&2; exit 1; }
command -v debootstrap >/dev/null || { echo "arm64: apt-get install debootstrap qemu-user-static binfmt-support" >&2; exit 1; }
mountpoint -q /proc/sys/fs/binfmt_misc || mount -t binfmt_misc none /proc/sys/fs/binfmt_misc
[ "$(uname -m)" = aarch64 ] || [ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || update-binfmts --enable qemu-aarch64

if [ ! -e "$tree/.complete" ]; then
    rm -rf "$tree"
    # what Raspberry Pi OS brings and a minimal Debian does not
    debootstrap --arch=arm64 --variant=minbase --include=ca-certificates,sudo,systemd,udev,libcap2-bin \
        "$suite" "$tree" "${MIRROR:-http://deb.debian.org/debian}"
    touch "$tree/.complete"
fi

mounted=()
leave() { for at in "${mounted[@]}"; do umount -l "$at"; done; }
trap leave EXIT
share() { # SOURCE TARGET [mount options]
    mkdir -p "$2"
    mount "${@:3}" "$1" "$2"
    mounted=("$2" "${mounted[@]}")
}
share proc "$tree/proc" -t proc
share /dev "$tree/dev" --bind
share /dev/pts "$tree/dev/pts" --bind
share tmpfs "$tree/tmp" -t tmpfs
cp -L /etc/resolv.conf "$tree/etc/resolv.conf"
[ ! -e /etc/pip.conf ] || cp /etc/pip.conf "$tree/etc/pip.conf"
for file in "${PIP_CERT:-}" "${REQUESTS_CA_BUNDLE:-}"; do [ -z "$file" ] || install -D -m 644 "$file" "$tree$file"; done

inside() { chroot "$tree" /usr/bin/env -u PIP_FIND_LINKS HOME=/root LC_ALL=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
    PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 bash -euc "$1"; }

echo "== $suite on $(inside 'uname -m'): the README's commands"
rm -rf "$tree/srv/robotd" "$tree/srv/check" "$tree/opt/robotd"
mkdir -p "$tree/srv/robotd" "$tree/srv/check"
git -C "$clone" archive HEAD | tar x -C "$tree/srv/robotd"
# nothing is booted in the tree: udevadm ignores what needs a running system, systemctl can only enable
grep -q "$(hostname)" "$tree/etc/hosts" 2>/dev/null || echo "127.0.0.1 localhost $(hostname)" >>"$tree/etc/hosts"
awk '/^Raspberry Pi OS, 64 bit/ { on = 1; next } on && /^    / { print substr($0, 5); seen = 1; next } on && seen { exit }' \
    "$clone/README.md" | sed 's/systemctl enable --now/systemctl enable/' >"$tree/srv/install.sh"
grep -q 'pip install' "$tree/srv/install.sh" || { echo "arm64: README.md has no installation commands any more" >&2; exit 1; }
inside 'apt-get update -q; cd /srv/robotd; set -x; . /srv/install.sh'

echo "== what was installed"
inside 'cd /; file=$(/opt/robotd/bin/python -c "import robotd.vision._stroke as kernel; print(kernel.__file__)"); echo "$file"
    /opt/robotd/bin/robotd --help | head -3; systemctl is-enabled robotd robotd-guardian; systemd-analyze verify /etc/systemd/system/robotd*.service; id robotd'

echo "== the tests, against it"
python3 - "$clone/pyproject.toml" >"$tree/srv/requirements.txt" <<'PYTHON'
import sys, tomllib
extras = tomllib.load(open(sys.argv[1], "rb"))["project"]["optional-dependencies"]
print(*(name for name in extras["solver"] + extras["dev"] if not name.startswith(("robotd", "mypy", "ruff"))), sep="\n")
PYTHON
inside 'cd /srv/robotd; cp -r tests etc systemd cython README.md ARCHITECTURE.md CHANGELOG.md pyproject.toml setup.py /srv/check/
    package=$(cd / && /opt/robotd/bin/python -c "import robotd, pathlib; print(pathlib.Path(robotd.__file__).parent)")
    ln -s "$package" /srv/check/robotd; ln -s "$package/drivers" /srv/check/drivers
    /opt/robotd/bin/pip install -q -r /srv/requirements.txt'
inside "cd /srv/check && /opt/robotd/bin/python -m pytest $*"
