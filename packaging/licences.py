"""Prints Debian's copyright file: fusiond's licence, and that of every library in its environment.

    python packaging/licences.py SITE_PACKAGES
"""

from __future__ import annotations

import sys
from email.message import Message
from importlib.metadata import Distribution, distributions
from pathlib import PurePosixPath

SITE = "/opt/fusiond/lib/python3*/site-packages"
AUTHORS = ("Author", "Author-email", "Maintainer", "Maintainer-email")  # the first that the metadata has
TEXTS = ("LICEN", "COPYING", "NOTICE")  # in the names of files with licences
COMMON = "/usr/share/common-licenses"  # where Debian keeps the texts of some licences
KNOWN = {  # licences of libraries whose metadata names none of SPDX's names
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0",
    "LGPLv3": "LGPL-3.0",
    "LGPL v3": "LGPL-3.0",
    "LGPL-3.0-only": "LGPL-3.0",
    "Apache Software License": "Apache-2.0",
    "MIT License": "MIT",
    "BSD": "BSD-3-Clause",
}
LEFT_OUT = {  # what this copy of a library lacks; nothing else of it is changed
    "numpy": "f2py, distutils, and the tests",
    "pymavlink": "generator, tools, the dialects of MAVLink 1 and some of MAVLink 2",
}


def text(site: str) -> str:
    """The whole file."""
    paragraphs = [
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: fusiond",
        "Files: *\nCopyright: the authors of fusiond\nLicense: Apache-2.0",
    ]
    found = sorted(distributions(path=[site]), key=lambda one: one.name.lower())
    paragraphs += [paragraph(one) for one in found if one.name != "fusiond"]
    paragraphs.append(f"License: Apache-2.0\n The full text is in {COMMON}/Apache-2.0.")
    paragraphs.append(f"License: LGPL-3.0\n The full text is in {COMMON}/LGPL-3, and that of the GPL in {COMMON}/GPL-3.")
    return "\n\n".join(paragraphs) + "\n"


def paragraph(one: Distribution) -> str:
    """A library: its files, authors, licence, where the licence's text lies, and what this copy lacks."""
    metadata: Message = one.metadata  # type: ignore[assignment]
    paths = sorted({PurePosixPath(file).parts[0] for file in one.files or () if not str(file).startswith("..")})
    author = next((value for key in AUTHORS if (value := metadata[key])), "")
    files = "\n ".join(f"{SITE}/{name}" for name in paths if not name.startswith("__"))
    copyright_of = " ".join(author.split()) or f"the authors of {one.name}"
    lines = [f"Files: {files}", f"Copyright: {copyright_of}", f"License: {licence(metadata)}"]
    texts = [file for file in one.files or () if any(word in file.name.upper() for word in TEXTS)]
    comments = [f"{one.name} {one.version}"]
    comments += [f"its licence: {SITE}/{name}" for name in texts if ".dist-info" in str(name)]
    if one.name in LEFT_OUT:
        comments.append(f"left out of this copy: {LEFT_OUT[one.name]}")
    return "\n".join([*lines, "Comment:", *(f" {comment}" for comment in comments)])


def licence(metadata: Message) -> str:
    """The short name of a library's licence."""
    given = metadata["License-Expression"] or (metadata["License"] or "").strip().partition("\n")[0]
    classes = [value.rpartition(" :: ")[2] for value in metadata.get_all("Classifier", ()) if value.startswith("License ::")]
    name = str(given or next(iter(classes), "see the comment"))
    return KNOWN.get(name, name)


if __name__ == "__main__":
    print(text(sys.argv[1]), end="")
