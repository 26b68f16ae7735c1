"""YAML files read with suspicion, and the inheritance between task files (`extends`).

Aliases are refused (a few lines of them can describe gigabytes), so are keys that stand twice, Python tags, and files
above 256 KiB. Relative paths become absolute against the folder of the file they stand in, before files are merged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError, nearest

__all__ = ["CONTRACT_EFFECTS", "merge", "read_task", "read_yaml", "where"]

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


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise InputError(f"line {mark.line + 1}: YAML aliases are not accepted; use `extends` to share keys")
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen and isinstance(key, yaml.ScalarNode):
                raise InputError(f"line {key.start_mark.line + 1}: the key '{key.value}' stands there twice")
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def read_yaml(file: Path, asked_by: str = "") -> dict[str, Any]:
    """The mapping in a YAML file; `asked_by` says which key names the file, for the message of the `InputError`."""
    name = f"{file}{asked_by}"
    if file.is_dir():
        raise InputError(f"{name} is a directory, expected a YAML file")
    if not file.is_file():
        beside = sorted(path.name for path in file.parent.glob("*.y*ml"))
        raise InputError(f"{name} does not exist{nearest(file.name, beside)}")
    try:
        if file.stat().st_size > LARGEST:
            raise InputError(f"{name} is larger than {LARGEST >> 10} KiB, which no task needs")
        content = yaml.load(file.read_text(encoding="utf-8"), _Loader)
    except InputError as error:
        raise error if name in str(error) else InputError(f"{name}, {error}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{name}{_explain(error)}") from error
    except RecursionError:
        raise InputError(f"{name} is nested too deeply") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
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
        if current.resolve() in seen:
            raise InputError(f"{chain[0][0]}: `extends` goes in a circle back to {current}")
        seen.append(current.resolve())
        keys = read_yaml(current, asked_by)
        parent = keys.pop("extends", None)
        if parent is not None and not isinstance(parent, str):
            raise InputError(f"{current}: extends is {parent!r}, expected the name of one YAML file")
        _absolute(keys, current.resolve().parent)
        chain.insert(0, (current, keys))
        asked_by = f" (extends in {current})"
        current = None if parent is None else current.parent / parent
    return chain


def _absolute(keys: dict[str, Any], folder: Path) -> None:
    """Make `robot.model` and `data[].file` absolute, in place."""
    entries = keys.get("data")
    files = [(entry, "file") for entry in entries] if isinstance(entries, list) else []
    for holder, key in [(keys.get("robot"), "model"), *files]:
        if isinstance(holder, dict) and isinstance(holder.get(key), str):
            holder[key] = str(folder / holder[key])


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
