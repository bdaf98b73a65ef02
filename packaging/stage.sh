#!/usr/bin/env bash
# Lays fusiond out under a folder as it is to stand under /: a Python environment of its own in /opt/fusiond, units,
# user, examples. `make install` gives it the root itself, `make deb` the tree of a package.
#   packaging/stage.sh FOLDER      PYTHON: the interpreter; WHEEL: what pip is to install (default: these sources)
set -euo pipefail
cd "$(dirname "$0")/.."
root=${1?FOLDER is wanted; \"\" is the root itself}
home=$root/opt/fusiond

"${PYTHON:-python3}" -m venv --clear "$home"
"$home/bin/python" -m pip install --quiet --disable-pip-version-check --root-user-action=ignore "${WHEEL:-.}"
"$home/bin/python" -m pip uninstall --quiet --yes --root-user-action=ignore setuptools  # it has a hand in every start
if [ -n "$root" ]; then  # paths as they will be
    grep -rlIF "$home" "$home/bin" "$home/pyvenv.cfg" | xargs sed -i "s|$home|/opt/fusiond|g"
fi

install -Dm644 -t "$root/usr/lib/systemd/system" systemd/fusiond.service systemd/fusiond@.service
install -Dm644 systemd/fusiond.sysusers "$root/usr/lib/sysusers.d/fusiond.conf"
install -Dm644 systemd/fusiond.tmpfiles "$root/usr/lib/tmpfiles.d/fusiond.conf"
install -Dm644 -t "$root/usr/share/fusiond/examples" configs/*.toml configs/*.dbc systemd/80-can0.network
install -dm755 "$root/usr/bin"
ln -sfn /opt/fusiond/bin/fusiond "$root/usr/bin/fusiond"
