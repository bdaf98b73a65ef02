#!/usr/bin/env bash
# Installs fusiond below a folder, with the layout that it has below /: its own Python environment in /opt/fusiond, units,
# user, examples, documentation. For `make install` the folder is the root itself, for `make deb` the tree of the package.
#   packaging/stage.sh FOLDER      PYTHON: the interpreter; WHEEL: the wheel of fusiond (default: made of these sources)
# Only what the lock files name is fetched, and only with their hashes.
set -euo pipefail
cd "$(dirname "$0")/.."
root=${1?FOLDER is missing; \"\" is the root itself}
python=${PYTHON:-python3}
home=$root/opt/fusiond
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT

"$python" -m venv "$build/tools"
pip() { "$build/tools/bin/python" -m pip --quiet --disable-pip-version-check "$@"; }
into_home() { pip --python "$home/bin/python" install --no-compile --no-deps --root-user-action=ignore "$@"; }
if [ -z "${WHEEL:-}" ]; then
    pip install --require-hashes --only-binary :all: --requirement packaging/build-requirements.txt
    rm -rf build/lib* build/bdist*  # of earlier sources
    pip wheel --no-deps --no-build-isolation --wheel-dir "$build" .
    WHEEL=$(echo "$build"/fusiond-*.whl)
fi
"$python" -m venv --clear --without-pip "$home"
into_home --require-hashes --only-binary :all: --requirement packaging/requirements.txt
into_home --no-index "$WHEEL"

# Left out: programs of the libraries, their tests, and of pymavlink what is not used here. Its dialect `all` has the messages
# of the dialects that are left out, except matrixpilot and paparazzi, which stay.
site=$(echo "$home"/lib/python3.*/site-packages)
for program in "$home"/bin/*; do
    case ${program##*/} in python* | fusiond) ;; *) rm -f "$program" ;; esac
done
rm -rf "$site"/numpy/{f2py,distutils}
find "$site" -type d -name tests -prune -exec rm -rf {} +
rm -rf "$site"/pymavlink/{dfindexer,generator,tools,dialects/v10}
for dialect in "$site"/pymavlink/dialects/v20/*.py; do
    case $(basename "$dialect" .py) in
        __init__ | minimal | standard | common | ardupilotmega | development | cubepilot | matrixpilot | paparazzi | all) ;;
        *) rm -f "$dialect" "${dialect}i" ;;
    esac
done
"$home/bin/python" -m compileall -q ${root:+-s "$root" -p /} "$site"

if [ -n "$root" ]; then  # paths as after the installation
    grep -rlIF "$home" "$home/bin" "$home/pyvenv.cfg" | xargs sed -i "s|$home|/opt/fusiond|g"
fi

install -Dm644 -t "$root/usr/lib/systemd/system" systemd/fusiond.service systemd/fusiond@.service
install -Dm644 systemd/fusiond.sysusers "$root/usr/lib/sysusers.d/fusiond.conf"
install -Dm644 systemd/fusiond.tmpfiles "$root/usr/lib/tmpfiles.d/fusiond.conf"
install -Dm644 -t "$root/usr/share/fusiond/examples" configs/*.toml configs/*.parm configs/*.params configs/*.dbc configs/prometheus/* systemd/80-can0.network
install -Dm644 -t "$root/usr/share/fusiond/examples/zenoh" configs/zenoh/*
install -dm755 "$root/usr/bin" "$root/usr/share/man/man1" "$root/usr/share/doc/fusiond"
ln -sfn /opt/fusiond/bin/fusiond "$root/usr/bin/fusiond"
"$home/bin/python" packaging/man_page.py | gzip -9n > "$root/usr/share/man/man1/fusiond.1.gz"
"$home/bin/python" -m fusiond completion bash | install -Dm644 /dev/stdin "$root/usr/share/bash-completion/completions/fusiond"
"$home/bin/python" -m fusiond completion zsh | install -Dm644 /dev/stdin "$root/usr/share/zsh/vendor-completions/_fusiond"
"$home/bin/python" -m fusiond completion fish | install -Dm644 /dev/stdin "$root/usr/share/fish/vendor_completions.d/fusiond.fish"
"$home/bin/python" packaging/licences.py "$site" > "$root/usr/share/doc/fusiond/copyright"
gzip -9nc CHANGELOG.md > "$root/usr/share/doc/fusiond/changelog.gz"
