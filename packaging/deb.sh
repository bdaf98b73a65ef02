#!/usr/bin/env bash
# Makes dist/fusiond_VERSION_ARCHITECTURE.deb, for systems whose /usr/bin/python3 has the same version as PYTHON here.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
root=$PWD/build/deb
rm -rf "$root"
packaging/stage.sh "$root"

# Use the target's interpreter instead of this machine's.
read -r minor next < <("$python" -c 'import sys; print(f"3.{sys.version_info[1]} 3.{sys.version_info[1] + 1}")')
ln -sfn /usr/bin/python3 "$root/opt/fusiond/bin/python3"
ln -sfn python3 "$root/opt/fusiond/bin/python"
ln -sfn python3 "$root/opt/fusiond/bin/python$minor"
sed -i "s|^home = .*|home = /usr/bin|; /^executable = /d; /^command = /d" "$root/opt/fusiond/pyvenv.cfg"

version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' fusiond/__init__.py)
architecture=$(dpkg --print-architecture)
mkdir -p "$root/DEBIAN" dist
sed "s|@VERSION@|$version|; s|@ARCHITECTURE@|$architecture|; s|@PYTHON@|$minor|; s|@NEXT@|$next|;
     s|@SIZE@|$(du -sk "$root" | cut -f1)|" packaging/control > "$root/DEBIAN/control"
install -m755 -t "$root/DEBIAN" packaging/postinst packaging/prerm packaging/postrm
chmod -R go-w "$root"
(cd "$root" && find . -path ./DEBIAN -prune -o -type f -printf '%P\0' | sort -z | xargs -0 md5sum) > "$root/DEBIAN/md5sums"
dpkg-deb --root-owner-group -Zxz -z3 --build "$root" "dist/fusiond_${version}_$architecture.deb"
