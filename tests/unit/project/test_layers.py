"""The layers of the project, in one ordered table. A module imports from its own layer and from layers before it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.paths import ROOTS

LAYERS = (  # from the bottom; those of one line do not import each other
    ("fusiond",),  # the package's own file: glossary and version
    ("fusiond.errors",),
    ("fusiond.units",),
    ("fusiond.maths",),
    ("fusiond.events",),
    ("fusiond.sessions",),
    ("fusiond.config",),
    ("fusiond.timeline", "fusiond.filter", "fusiond.simulation"),
    ("fusiond.estimator",),
    ("fusiond.messages",),
    ("fusiond.engine", "fusiond.arrays"),
    ("fusiond.ports",),
    ("fusiond_adapters",),
    ("fusiond.app",),
    ("fusiond.client", "fusiond.__main__"),
)
ACROSS = {  # folders of one protocol that import another's, and why
    ("ros2", "zenoh"): "rmw_zenoh carries ROS 2 over a Zenoh session",
    ("logs", "mavlink"): "a .tlog holds MAVLink frames",
    ("logs", "can"): "a candump log holds CAN frames",
    ("mcap", "foxglove"): "MCAP files hold what Foxglove shows",
}
SHARED = {"host", "payloads", "registry"}  # of no protocol: clock, what sensors measured, table of all
NEVER = {  # imports that the order would allow
    ("fusiond_adapters", "fusiond.filter"): "an adapter knows a protocol and nothing of filters",
    ("fusiond_adapters", "fusiond.timeline"): "an adapter passes on the stamps that it gets",
    ("fusiond.maths", "fusiond.errors"): "mathematics knows nothing of the project",
    ("fusiond.maths", "fusiond.units"): "mathematics knows nothing of the project",
}
INPUT_AND_OUTPUT = {"socket", "time", "asyncio", "subprocess", "pymavlink", "can", "cantools", "zenoh", "matplotlib"}
OPENS_THINGS = ("fusiond.ports", "fusiond_adapters", "fusiond.app", "fusiond.client", "fusiond.__main__", "fusiond.config")


def name_of(path: Path) -> str:
    for name, root in ROOTS.items():
        if path.is_relative_to(root):
            parts = [name, *path.relative_to(root).with_suffix("").parts]
            return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    raise ValueError(path)


MODULES = {name_of(path): path for root in ROOTS.values() for path in sorted(root.rglob("*.py"))}


def imported(module: str) -> Iterator[str]:
    """Absolute names of all that a module imports, anywhere in it; of `from a import b`, a.b where that is a module."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                yield whole if whole in MODULES else source


def layer(module: str) -> tuple[int, str]:
    """Place in the table, and the entry: the longest that the module lies in."""
    found = [
        (len(entry), number, entry)
        for number, entries in enumerate(LAYERS)
        for entry in entries
        if module == entry or (entry != "fusiond" and module.startswith(f"{entry}."))
    ]
    assert found, f"{module} is in no layer: add it to LAYERS"
    _, number, entry = max(found)
    return number, entry


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_from_layers_below(module: str) -> None:
    number, entry = layer(module)
    for other in imported(module):
        if other.split(".")[0] in ROOTS:
            below, its = layer(other)
            assert below < number or its == entry, f"{module} imports {other}"
            assert (entry, its) not in NEVER, f"{module} imports {other}: {NEVER[entry, its]}"


@pytest.mark.parametrize("module", [module for module in MODULES if module.startswith("fusiond_adapters.")])
def test_a_protocol_does_not_import_another(module: str) -> None:
    own = module.split(".")[1]
    for other in imported(module):
        parts = other.split(".")
        if parts[0] == "fusiond_adapters" and len(parts) > 1 and parts[1] != own and not {own, parts[1]} & SHARED:
            assert (own, parts[1]) in ACROSS, f"{module} imports {other}"


@pytest.mark.parametrize("module", [module for module in MODULES if not module.startswith(OPENS_THINGS)])
def test_the_core_is_free_of_input_and_output(module: str) -> None:
    assert not {other.split(".")[0] for other in imported(module)} & INPUT_AND_OUTPUT
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    calls = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    assert not calls & {"print", "open", "input"}


def test_every_exception_is_used() -> None:
    across = {
        (module.split(".")[1], other.split(".")[1])
        for module in MODULES
        for other in imported(module)
        if module.startswith("fusiond_adapters.") and other.startswith("fusiond_adapters.")
    }
    assert set(ACROSS) <= across
