"""The package's import graph: folders and modules of the root as nodes, imports inside functions counted.

`python benchmarks/import_graph.py [CHECKOUT]` prints nodes, layers (length of the longest chain), edges, pairs of
modules that import each other across nodes, and circles; then, for a few names, how many functions of how many modules
take it as a parameter, and how many calls in those hand it on. Another checkout can be measured beside this one.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path


def imports(path: Path, root: Path, modules: set[str]) -> Iterator[tuple[str, bool]]:
    """Modules of the package that a file imports, and whether inside a function; `TYPE_CHECKING` is left out."""
    package = list(path.relative_to(root).parts[:-1])
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), False)]
    while waiting:
        node, inside = waiting.pop()
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            waiting.append((child, inside or isinstance(child, ast.FunctionDef)))
            if isinstance(child, ast.ImportFrom) and child.level:
                above = package[: len(package) + 1 - child.level]
                base = ".".join([*above, *(child.module.split(".") if child.module else [])])
                for alias in child.names:
                    name = f"{base}.{alias.name}"
                    yield (name if name in modules else base), inside


def handed_on(files: dict[str, Path], wanted: str) -> tuple[int, int, int]:
    """Functions that take a parameter of this name, their modules, and calls in them that hand it on."""
    functions, modules, calls = 0, set[str](), 0
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                if any(one.arg == wanted for one in arguments):
                    functions, modules = functions + 1, modules | {name}
                    inside = (x for x in ast.walk(node) if isinstance(x, ast.Call))
                    calls += sum(_hands(call, wanted) for call in inside)
    return functions, len(modules), calls


def _hands(call: ast.Call, wanted: str) -> bool:
    given = [*call.args, *(keyword.value for keyword in call.keywords)]
    return any(isinstance(one, ast.Name) and one.id == wanted for one in given)


def main(root: Path) -> None:
    """Print the graph of the package under `root`."""
    files = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((root / "figaroh_jax").rglob("*.py"))
    }
    node = {name: name.split(".")[1] if "." in name else name for name in files}
    used = {(name, *one) for name, path in files.items() if "." in name for one in imports(path, root, set(files))}
    edges = {(name, other) for name, other, _ in used if other in files and node[name] != node[other]}
    graph: dict[str, set[str]] = {one: set() for one in node.values() if one not in ("figaroh_jax", "__main__")}
    for name, other in edges:
        if node[name] in graph and node[other] in graph:
            graph[node[name]].add(node[other])
    lazy = sum(inside for _, other, inside in used if other in files)
    try:
        depth: dict[str, int] = {}
        for one in TopologicalSorter(graph).static_order():
            depth[one] = 1 + max((depth[other] for other in graph[one]), default=0)
        shape = f"{max(depth.values())} layers, no circle"
        print(*(f"{level:3d} {one}" for one, level in sorted(depth.items(), key=lambda item: item[1])), sep="\n")
    except CycleError as error:
        shape = "a circle: " + " -> ".join(error.args[1])
    total = sum(map(len, graph.values()))
    for name in ("model", "position", "rate", "effect"):
        functions, modules, calls = handed_on(files, name)
        print(f"{name}: {functions} functions of {modules} modules take it, {calls} calls hand it on")
    print(f"{len(graph)} nodes, {shape}, {total} edges ({len(edges)} between modules), {lazy} imports inside functions")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parents[1]).resolve())
