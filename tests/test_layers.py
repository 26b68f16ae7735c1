"""The modules form layers: no import cycles, and the core knows no backend, no simulator and no plot."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "figaroh_jax"
MODULES = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}
# Only these may touch a file format, a simulator, the terminal or the page.
OUTSIDE = {
    "yaml": {"formats.taskfile", "formats.export", "recordings.migration"},
    "mujoco": {"formats.mjcf", "rollouts.callback"},  # the second is a file for the user's own simulation
    "pinocchio": set(),
    "pyarrow": {"recordings.containers"},
    "h5py": {"recordings.containers"},
    "rosbags": {"recordings.bags"},
    "pydantic": {f"formats.{name}" for name in ("config", "excite_keys", "fields", "recording_keys", "reference")},
    "rich": {"reporting.terminal"},
    "jinja2": {"reporting.report"},
    "jaxopt": {"diagnosis.refit", "estimation.fit"},
    "clarabel": {"estimation.conic"},
    "sklearn": {"estimation.least_squares"},
    "coal": {"excitation.meshes"},
    "trimesh": {"formats.collision"},
}


class _Used(ast.NodeVisitor):
    """What a file imports when it runs (the library's modules as `.folder.name`); `lazy`: inside functions too."""

    def __init__(self, path: Path, lazy: bool) -> None:
        self.folder, self.lazy, self.found = path.relative_to(ROOT).parts[1:-1], lazy, set[str]()

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) != "TYPE_CHECKING":
            self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if self.lazy:
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        self.found |= {alias.name.split(".")[0] for alias in node.names}

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if node.level:
            above = self.folder[: len(self.folder) + 1 - node.level]
            inside = [*above, *(node.module or "").split(".")] if node.module else list(above)
            named = {".".join([*inside, alias.name]) for alias in node.names} & MODULES.keys()
            self.found |= {f".{name}" for name in named or {".".join(inside)}}
        elif node.module:
            self.found.add(node.module.split(".")[0])


@cache
def _imports(path: Path, *, lazy: bool) -> frozenset[str]:
    used = _Used(path, lazy)
    used.visit(ast.parse(path.read_text(encoding="utf-8")))
    return frozenset(used.found)


def test_modules_import_each_other_without_cycles():
    """Imports inside functions count: a circle that waits for a call is a circle. The package itself only points."""
    graph = {name: {m[1:] for m in _imports(path, lazy=True) if m[:1] == "."} for name, path in MODULES.items()}
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError with the cycle


def test_folders_import_each_other_without_cycles():
    """Modules beside the folders are below them, but for the entry points."""
    graph: dict[str, set[str]] = {}
    for name, path in MODULES.items():
        if "." in name:
            used = {m[1:].split(".")[0] for m in _imports(path, lazy=True) if m[1:] in MODULES and "." in m[1:]}
            graph.setdefault(name.split(".")[0], set()).update(used - {name.split(".")[0]})
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError with the cycle


@pytest.mark.parametrize("package", OUTSIDE)
def test_outside_packages_stay_in_their_modules(package: str):
    users = {name for name, path in MODULES.items() if package in _imports(path, lazy=True)}
    assert users <= OUTSIDE[package]


def test_core_never_imports_a_backend():
    for path in MODULES.values():
        assert not {name for name in _imports(path, lazy=True) if name.startswith("figaroh_jax_")}, path


def test_backends_never_import_each_other():
    for folder in (ROOT / "backends").iterdir():
        for path in folder.glob("*.py"):
            others = {name for name in _imports(path, lazy=True) if name.startswith("figaroh_jax_")}
            assert others <= {folder.name}, path


def test_options_of_one_kind_of_device_are_set_where_the_device_is_known():
    """A compiler for another device refuses them: `batching.program` and code that looks may pass them."""
    own = {name for name, path in MODULES.items() if "compiler_options=" in path.read_text(encoding="utf-8")}
    assert own <= {
        "compiled.batching",
        "compiled.executable_cache",
        "rigid.normal_equations",
        "estimation.accelerators",
    }
    for path in (ROOT / "backends").rglob("*.py"):
        assert "compiler_options=" not in path.read_text(encoding="utf-8"), path
