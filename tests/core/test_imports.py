"""No module imports itself by way of others, and no private name crosses a module."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCES = (
    ROOT / "src",
    ROOT / "devices" / "src",
    ROOT / "occupancy" / "src",
    ROOT / "lab" / "src",
    ROOT / "experiment" / "src",
)


def imports() -> dict[str, set[tuple[str, str]]]:
    """By module: the modules of ours that it imports, and the names taken from them."""
    files = {}
    for source in SOURCES:
        for path in source.rglob("*.py"):
            parts = path.relative_to(source).with_suffix("").parts
            files[".".join(parts).removesuffix(".__init__")] = path
    found: dict[str, set[tuple[str, str]]] = {module: set() for module in files}
    for module, path in files.items():
        if module == "tumortrack":  # the public names, for type checking alone
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tumortrack"):
                for name in node.names:
                    whole = f"{node.module}.{name.name}"
                    found[module].add((whole if whole in files else str(node.module), name.name))
    return found


def test_no_module_imports_itself_by_way_of_others():
    graph = {module: {to for to, _ in names} - {module} for module, names in imports().items()}
    assert len(graph) > 200
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError, which names it
    assert order.index("tumortrack.core.errors") < order.index("tumortrack.cli.main")


def test_no_private_name_crosses_a_module():
    crossing = [
        f"{module} takes {name} from {to}"
        for module, names in imports().items()
        for to, name in names
        if name.startswith("_") and not name.startswith("__")
    ]
    assert crossing == []
