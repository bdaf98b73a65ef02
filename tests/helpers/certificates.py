"""Certificates of an authority of its own, for the tests of Zenoh over TLS. Needs openssl."""

from __future__ import annotations

import subprocess
from pathlib import Path


def certify(folder: Path, *names: str) -> None:
    """An authority (ca.pem), and a key and a certificate for each name as its common name, valid for loopback."""
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", 2)
    openssl("req", "-x509", *curve, "-subj", "/CN=authority", "-keyout", folder / "ca.key", "-out", folder / "ca.pem")
    for name in names:
        request, key, extensions = folder / f"{name}.csr", folder / f"{name}.key", folder / f"{name}.ext"
        extensions.write_text("subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n")
        openssl("req", *curve[:-2], "-subj", f"/CN={name}", "-keyout", key, "-out", request)
        openssl("x509", "-req", "-in", request, "-CA", folder / "ca.pem", "-CAkey", folder / "ca.key", "-CAcreateserial",
                 "-days", 2, "-extfile", extensions, "-out", folder / f"{name}.pem")  # fmt: skip


def openssl(*arguments: object) -> None:
    """Run openssl. Raises CalledProcessError."""
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)
