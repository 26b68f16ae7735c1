"""YAML files read with suspicion, and the inheritance between task files (`extends`).

Aliases are accepted as far as what they expand to stays small (a few lines of them can describe gigabytes). Keys that
stand twice, Python tags and files above 256 KiB are refused. Relative paths become absolute against the folder of the
file they stand in, before files are merged.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError, check_names, nearest
from .files import read_file

__all__ = [
    "CONTRACT_EFFECTS",
    "check_effect",
    "check_effects",
    "given_task",
    "merge",
    "read_task",
    "read_yaml",
    "where",
]

# The names that the contract fixes, of every level; a task may forbid one that this version does not look for.
CONTRACT_EFFECTS = """
link_inertia payload viscous_friction coulomb_friction asymmetric_coulomb_friction asymmetric_viscous_friction
stribeck_friction power_law_friction load_dependent_friction position_dependent_friction friction_drift presliding
rotor_inertia coupled_transmission torque_gain torque_offset torque_ripple joint_spring gravity_tilt joint_elasticity
backlash torque_delay torque_lag torque_saturation contact external_wrench clock_error encoder_offset encoder_scale
encoder_eccentricity joint_offset link_geometry gear_transmission_error joint_compliance link_compliance base_frame
tool_frame outlier thermal_growth payload_deflection settling reversal_hysteresis joint_coupling joint_damping
friction_loss actuator_gain command_delay actuator_saturation voltage_saturation dead_band contact_stiffness
contact_friction
""".split()


LARGEST = 1 << 18  # bytes
MOST_NODES = 50_000  # after expansion of the aliases
DEEPEST = 100
LONGEST_NUMBER = 500  # characters; what is longer is text (base 60, which YAML has, takes a quadratic time)
_NUMBERS = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp"))


def check_effect(name: str) -> None:
    """Raise `InputError`, with the nearest known name, where no effect of any level is called so."""
    from ..effects.catalogue import CATALOGUE, ROLLOUTS
    from ..effects.registry import POSES

    known = list(dict.fromkeys([*CATALOGUE, *POSES, *ROLLOUTS, *CONTRACT_EFFECTS]))
    if name not in known:
        raise InputError(f"no effect '{name}'{nearest(name, known)}")


def check_effects(name: str, given: Any) -> None:
    """Refuse what is no list of names of effects; `name` is that of the argument."""
    check_names(name, given)
    for one in given:
        try:
            check_effect(one)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None


class _Loader(yaml.SafeLoader):
    def get_single_node(self):
        node = super().get_single_node()
        if node is not None:
            _expanded(node, {})
        return node

    def compose_scalar_node(self, anchor):
        node = super().compose_scalar_node(anchor)
        if len(node.value) > LONGEST_NUMBER and node.tag in _NUMBERS:
            node.tag = "tag:yaml.org,2002:str"
        if any("\ud800" <= c <= "\udfff" for c in node.value):  # written as an escape
            raise InputError(f"{_line(node)}: {node.value[:60]!a} ends in half a character")
        return node

    def construct_mapping(self, node, deep=False):
        if not isinstance(node, yaml.MappingNode):
            raise InputError(f"{_line(node)}: the tag {node.tag} is on something that has no keys")
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(f"{_line(key)}: a key is a list or a mapping; a name is expected")
            if key.value in seen:
                raise InputError(f"{_line(key)}: the key '{key.value}' appears twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _line(node: yaml.Node) -> str:
    return f"line {node.start_mark.line + 1}"


def _expanded(node: yaml.Node, known: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """Number of nodes and depth once every alias is what it stands for; `InputError` where these are too many."""
    if id(node) in known:
        found = known[id(node)]
        if found is None:
            raise InputError(f"{_line(node)}: an alias (`*`) is inside what it refers to")
        return found
    known[id(node)] = None
    children = node.value if isinstance(node, yaml.SequenceNode) else []
    if isinstance(node, yaml.MappingNode):
        children = [part for pair in node.value for part in pair]
    sizes = [_expanded(child, known) for child in children]
    nodes, depth = 1 + sum(size for size, _ in sizes), 1 + max((deep for _, deep in sizes), default=0)
    if nodes > MOST_NODES or depth > DEEPEST:
        what = f"{MOST_NODES} values" if nodes > MOST_NODES else f"{DEEPEST} levels"
        raise InputError(f"{_line(node)}: with its aliases (`*`) expanded it holds more than {what}")
    known[id(node)] = nodes, depth
    return nodes, depth


def read_yaml(file: Path, asked_by: str = "") -> dict[str, Any]:
    """The mapping in a YAML file; `asked_by` says which key names the file, for the message of the `InputError`."""
    name = f"{file}{asked_by}"
    data = read_file(file, name, "a YAML file", LARGEST, (".yaml", ".yml"))
    try:
        content = yaml.load(data.decode("utf-8"), _Loader)  # noqa: S506  a SafeLoader
    except InputError as error:
        raise error if name in str(error) else InputError(f"{name}, {error}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{name}{_explain(error)}") from error
    except RecursionError:
        raise InputError(f"{name} is nested too deeply") from None
    except Exception as error:  # what tags at the wrong place make of PyYAML's constructors
        raise InputError(f"{name} cannot be read as YAML: {error}") from error
    if content is None:
        raise InputError(f"{name} is empty")
    if not isinstance(content, dict):
        raise InputError(f"{name} holds a {type(content).__name__}, expected keys such as `robot:` and `data:`")
    return content


def _explain(error: yaml.YAMLError) -> str:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    text = str(problem or getattr(error, "reason", None) or error).replace("\n", " ")
    if "'\\t'" in text:
        text = "a tab: YAML is indented with spaces"
    return f", line {mark.line + 1}, column {mark.column + 1}: {text}" if mark else f" is not YAML: {text}"


def read_task(file: Path) -> list[tuple[Path, dict[str, Any]]]:
    """The chain of a task file, the most general first: each file with its keys, paths made absolute."""
    chain: list[tuple[Path, dict[str, Any]]] = []
    asked_by, seen = "", []
    current: Path | None = file
    while current is not None:
        keys = read_yaml(current, asked_by)
        if current.resolve() in seen:
            raise InputError(f"{chain[0][0]}: `extends` goes in a circle back to {current}")
        seen.append(current.resolve())
        parent = keys.pop("extends", None)
        if parent is not None and not isinstance(parent, str):
            raise InputError(f"{current}: extends is {parent!r}, expected the name of one YAML file")
        _absolute(keys, current.resolve().parent)
        chain.insert(0, (current, keys))
        asked_by = f" (extends in {current})"
        current = None if parent is None else current.parent / parent
    return chain


def given_task(keys: Mapping[str, Any]) -> list[tuple[Path, dict[str, Any]]]:
    """`read_task` of keys that no file holds: relative paths and `extends` are those of the working directory."""
    own = copy.deepcopy(dict(keys))
    parent = own.pop("extends", None)
    if parent is not None and not isinstance(parent, (str, Path)):
        raise InputError(f"task: extends is {parent!r}, expected the name of one YAML file")
    _absolute(own, Path.cwd())
    return [*([] if parent is None else read_task(Path(parent))), (Path("task"), own)]


def _absolute(keys: dict[str, Any], folder: Path) -> None:
    """Make `robot.model`, `data[].file` and `excite.predict` absolute, in place."""
    entries = keys.get("data")
    files = [(entry, "file") for entry in entries] if isinstance(entries, list) else []
    for holder, key in [(keys.get("robot"), "model"), *files]:
        if isinstance(holder, dict) and isinstance(holder.get(key), (str, Path)):
            holder[key] = str(folder / holder[key])
    excite = keys.get("excite")
    if isinstance(excite, dict) and isinstance(excite.get("predict"), list):
        excite["predict"] = [str(folder / x) if isinstance(x, (str, Path)) else x for x in excite["predict"]]


def merge(chain: list[tuple[Path, dict[str, Any]]]) -> dict[str, Any]:
    """One mapping of a chain: mappings merge key by key, anything else is replaced by the later value."""
    merged: dict[str, Any] = {}
    for _, keys in chain:
        merged = _merge(merged, keys)
    return merged


def _merge(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return {**old, **{key: _merge(old.get(key), value) for key, value in new.items()}}


def where(chain: list[tuple[Path, dict[str, Any]]], location: tuple[str | int, ...]) -> Path:
    """The file of the chain whose value at `location` (or as near above it as can be) is the one in force."""
    for end in range(len(location), 0, -1):
        for file, keys in reversed(chain):
            if _has(keys, location[:end]):
                return file
    return chain[-1][0]


def _has(value: Any, location: tuple[str | int, ...]) -> bool:
    for key in location:
        if isinstance(value, dict) and key in value:
            value = value[key]
        elif isinstance(value, list) and isinstance(key, int) and key < len(value):
            value = value[key]
        else:
            return False
    return True
