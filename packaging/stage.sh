#!/usr/bin/env bash
# Installs fusiond below a folder, with the layout that it has below /: its own Python environment in /opt/fusiond, units,
# user, examples. For `make install` the folder is the root itself, for `make deb` the tree of the package.
#   packaging/stage.sh FOLDER      PYTHON: the interpreter; WHEEL: what pip installs (default: these sources)
set -euo pipefail
cd "$(dirname "$0")/.."
root=${1?FOLDER is missing; \"\" is the root itself}
home=$root/opt/fusiond

"${PYTHON:-python3}" -m venv --clear "$home"
"$home/bin/python" -m pip install --quiet --disable-pip-version-check --root-user-action=ignore "${WHEEL:-.}"
"$home/bin/python" -m pip uninstall --quiet --yes --root-user-action=ignore setuptools  # it slows every start
if [ -n "$root" ]; then  # paths as after the installation
    grep -rlIF "$home" "$home/bin" "$home/pyvenv.cfg" | xargs sed -i "s|$home|/opt/fusiond|g"
fi

install -Dm644 -t "$root/usr/lib/systemd/system" systemd/fusiond.service systemd/fusiond@.service
install -Dm644 systemd/fusiond.sysusers "$root/usr/lib/sysusers.d/fusiond.conf"
install -Dm644 systemd/fusiond.tmpfiles "$root/usr/lib/tmpfiles.d/fusiond.conf"
install -Dm644 -t "$root/usr/share/fusiond/examples" configs/*.toml configs/*.dbc configs/prometheus/* systemd/80-can0.network
install -dm755 "$root/usr/bin"
ln -sfn /opt/fusiond/bin/fusiond "$root/usr/bin/fusiond"
