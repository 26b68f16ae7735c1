"""Fitted parameters as plain tables for other programs: `parameters.csv`, `parameters.yaml`, `parameters.npz`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from .result import Identification

__all__ = ["write_parameters"]


def write_parameters(found: Identification, folder: Path) -> None:
    """Write every parameter (name, value, standard deviation, status) and every base parameter into `folder`.

    The NPZ file holds `names`, `values`, `std`, `status`, and the same for the base parameters with `base_` in front.
    """
    rows = [("parameter", p.name, p.value, p.std, p.status) for p in found.parameters]
    rows += [("base parameter", b.expression, b.value, b.std, b.status) for b in found.base]
    with (folder / "parameters.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["kind", "name", "value", "std", "status"])
        writer.writerows(rows)
    (folder / "parameters.yaml").write_text(_yaml(found), encoding="utf-8")
    kinds = {"": "parameter", "base_": "base parameter"}
    arrays = {
        f"{prefix}{key}": np.array([row[k] for row in rows if row[0] == kind])
        for prefix, kind in kinds.items()
        for k, key in enumerate(("names", "values", "std", "status"), 1)
    }
    with (folder / "parameters.npz").open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _yaml(found: Identification) -> str:
    """Links with their ten parameters, and the effects; numbers in full."""
    order = "[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]"
    lines = [f"# at and in the joint frame: {order}, kg, kg m, kg m^2", "links:"]
    lines += [f"  {_quoted(link.name)}: [{', '.join(repr(float(x)) for x in link.parameters)}]" for link in found.links]
    lines.append("effects:" if found.effects else "effects: []")
    for effect in found.effects:
        at = ", ".join(_quoted(name) for name in effect.name.at)
        values = ", ".join(f"{name}: {float(x.value)!r}" for name, x in effect.parameters.items())
        lines.append(f"  - {{effect: {effect.name.effect}, at: [{at}], parameters: {{{values}}}}}")
    return "\n".join(lines) + "\n"


def _quoted(name: str) -> str:
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
