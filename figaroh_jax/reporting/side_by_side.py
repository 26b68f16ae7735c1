"""Runs side by side: what each found, parameters with intervals, held-out errors by joint, and how the models differ.

The first run is the reference. `rows` is the comparison as plain tables, which terminal and page print alike.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np

from ..errors import InputError, as_written
from ..rigid.inertia import to_com
from .provenance import PROVENANCE, read_provenance
from .run_directory import MARKER
from .verification import SIMULATED, figures, read_run

__all__ = ["PAGE", "Section", "compare_runs", "comparison_page", "comparison_text", "list_runs"]

PAGE = '<meta name="generator" content="figaroh-jax compare">'  # by which such a page is known


class Section(NamedTuple):
    """One table: a title, the heads of its columns (the first one names the rows), and its rows as text."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def compare_runs(folders: Sequence[Path], units: Sequence[str] | None = None) -> tuple[Section, ...]:
    """The tables of a comparison; raises `InputError` where a folder is no run, or a simulation beside other runs.

    `units`: the robot of each run, by any label; runs of one label are days of one robot. From three runs on, what
    differs between robots and between days is a table of its own.
    """
    if units is not None and len(units) != len(folders):
        raise InputError(f"--units: {len(units)} labels for {len(folders)} runs; one for each is expected")
    if units is not None and len(folders) < 3:
        raise InputError("--units: at least three runs are needed to compare robots and days")
    names = _names(folders)
    if all((folder / SIMULATED).is_file() for folder in folders):
        if units is not None:
            raise InputError("--units: simulations hold no parameters that could differ between robots; leave it out")
        with as_written(" or ".join(map(str, folders))):
            return _simulations(folders, names)
    runs = [read_run(folder) for folder in folders]
    with as_written(" or ".join(map(str, folders))):
        return (*_sections(folders, runs, names), *_spread(runs, units))


def _simulations(folders: Sequence[Path], names: tuple[str, ...]) -> tuple[Section, ...]:
    """How far simulations are from the positions of their files, and from each other where their rows are the same."""
    told, moved = [], []
    for folder in folders:
        told.append(json.loads((folder / SIMULATED).read_text(encoding="utf-8")))
        path = (folder / SIMULATED).with_suffix(".npz")
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                moved.append((arrays["time"], arrays["position"]))
        except (OSError, EOFError, BadZipFile, ValueError, KeyError):
            raise InputError(f"{path}: cannot be read; name run directories of `simulate`") from None
    facts = [
        (key, *(str(one[key]) for one in told))
        for key in ("robot", "model", "command", "between_rows", "start", "step")
    ]
    errors = [one["error"] or {} for one in told]
    distances = [
        (joint, *(f"{one[joint]['rms']:.4g} {one[joint]['unit']}" if joint in one else "-" for one in errors))
        for joint in dict.fromkeys(joint for one in errors for joint in one)
    ]
    (time, first), columns = moved[0], told[0]["joints"]
    apart = []
    if first.shape[1] == len(columns):
        for k, joint in enumerate(columns):
            row = [joint]
            for one, (t, q) in zip(told, moved, strict=True):
                same = joint in one["joints"] and len(t) == len(time) and np.allclose(t, time, rtol=0, atol=1e-6)
                same = same and q.shape[1] == len(one["joints"])
                gap = q[:, one["joints"].index(joint)] - first[:, k] if same else np.zeros(0)
                row.append(f"{np.sqrt(np.mean(gap**2)):.4g}" if same else "-")
            apart.append(tuple(row))
    sections = (
        Section("Simulations", ("simulation", *names), tuple(facts)),
        Section("RMS distance from the positions of the file", ("joint", *names), tuple(distances)),
        Section("RMS distance from the first simulation (rad or m)", ("joint", *names), tuple(apart)),
        Section("Made by", ("made by", *names), tuple(_made(folders))),
    )
    return tuple(section for section in sections if section.rows)


def _sections(folders: Sequence[Path], runs: Sequence[dict[str, Any]], names: tuple[str, ...]) -> tuple[Section, ...]:
    sections = (
        Section("What was found", ("cause", *names), tuple(_found(runs))),
        Section("Figures", ("figure", *names), tuple(_figures(runs))),
        Section("Error on held-out data by joint (relative RMS)", ("joint", *names), tuple(_by_joint(runs))),
        Section(
            "Parameters (± one standard deviation; * differs by more than 3)",
            ("parameter", *names),
            tuple(_values(runs)),
        ),
        Section("Links of the models", ("link", *names), tuple(_links(folders))),
        Section("Made by", ("made by", *names), tuple(_made(folders))),
    )
    return tuple(section for section in sections if section.rows)


def _spread(runs: Sequence[dict[str, Any]], units: Sequence[str] | None) -> tuple[Section, ...]:
    """Parameters that three runs or more tell: mean, spreads, and whether they differ (`estimation.units`)."""
    from ..estimation.units import spreads

    tables = [_parameters(run) for run in runs]
    names = [n for n in dict.fromkeys(n for t in tables for n in t) if sum(t.get(n, (0, 0))[1] > 0 for t in tables) > 1]
    if len(runs) < 3 or not names:
        return ()
    missing = (float("nan"), float("nan"), "")
    whole = [[t[n] if t.get(n, missing)[1] > 0 else missing for n in names] for t in tables]
    values, std = (np.array([[cell[k] for cell in row] for row in whole], float) for k in (0, 1))
    rows = []
    for found in spreads(names, values, std, units):
        unit = next(t[found.name][2] for t in tables if found.name in t)
        mean = f"{found.mean:.4g} ± {found.std:.2g} {unit}".rstrip()
        rows.append((found.name, mean, f"{found.units:.2g}", f"{found.days:.2g}", found.differs() or "-"))
    title = "Spread between robots and between days (random effects; differs: p < 0.05 over all parameters)"
    return (Section(title, ("parameter", "mean", "between robots", "between days", "differs between"), tuple(rows)),)


def list_runs(folder: Path) -> Section:
    """Every run below a folder, with what it found; files of the same names that no run wrote are passed over."""
    rows: list[tuple[str, ...]] = []
    for marker in sorted(path for name in _MARKERS for path in folder.rglob(name)):
        run = marker.parent
        if any(row[0] == str(run) for row in rows):
            continue
        try:
            with as_written(run):
                rows.append(_row(run))
        except InputError:
            if any((run / name).is_file() for name in (PROVENANCE, MARKER)):
                rows.append((str(run), "?", "cannot be read", "-", "-", "?"))
    return Section("Runs", ("directory", "command", "verdict", "causes", "held-out error", "time"), tuple(rows))


_MARKERS = ("answer.json", "result.json", SIMULATED)


def _row(run: Path) -> tuple[str, ...]:
    if (run / SIMULATED).is_file():
        return _simulation_row(run)
    found, made = figures(read_run(run)), {}
    if (run / PROVENANCE).is_file():
        made = read_provenance(run)
    held = (found["holdout_relative"] or {}).get("all")
    causes = ", ".join(found["forbidden_causes"] or []) or "-"
    figure = (made.get("command", "?"), found["verdict"] or "-", causes, _number(held), made.get("time", "?"))
    return (str(run), *map(str, figure))


def _simulation_row(run: Path) -> tuple[str, ...]:
    content = json.loads((run / SIMULATED).read_text(encoding="utf-8"))
    if not {"robot", "between_rows", "error"} <= content.keys():
        raise KeyError("robot, between_rows or error is missing")
    made = read_provenance(run) if (run / PROVENANCE).is_file() else {}
    return (str(run), "simulate", "-", "-", "-", str(made.get("time", "?")))


def _names(folders: Sequence[Path]) -> tuple[str, ...]:
    names = [folder.resolve().name for folder in folders]
    return tuple(str(f) if names.count(n) > 1 else n for n, f in zip(names, folders, strict=True))


def _found(runs: Sequence[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    found = [figures(run) for run in runs]
    yield "verdict", *(f["verdict"] or "-" for f in found)
    causes = [_causes(run) for run in runs]
    for name in dict.fromkeys(name for one in causes for name in one):
        yield name, *("named" if name in one else "-" for one in causes)


def _causes(run: dict[str, Any]) -> dict[str, dict[str, Any]]:
    causes = (run["answer"] or run["result"] or {}).get("causes", [])
    return {f"{cause['effect']} ({', '.join(cause['at'])})": cause for cause in causes}


def _figures(runs: Sequence[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    found = [figures(run) for run in runs]
    for name in ("p_value", "gain", "rank", "condition", "relative_std", "position_mm", "orientation_deg", "fk_parity"):
        if any(f[name] is not None for f in found):
            yield name, *(_number(f[name]) for f in found)
    if any((f["holdout_relative"] or {}).get("all") is not None for f in found):
        yield "held-out error", *(_number(f["holdout_relative"].get("all")) for f in found)


def _by_joint(runs: Sequence[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    found = [figures(run)["holdout_relative"] or {} for run in runs]
    for joint in dict.fromkeys(name for one in found for name in one if name != "all"):
        yield joint, *(_number(one.get(joint)) for one in found)


def _values(runs: Sequence[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    """Parameters by name; an entry that is more than three joint standard deviations off the first has a star."""
    tables = [_parameters(run) for run in runs]
    for name in dict.fromkeys(name for table in tables for name in table):
        first = tables[0].get(name)
        yield name, *(_estimate(table.get(name), first) for table in tables)


def _parameters(run: dict[str, Any]) -> dict[str, tuple[float, float, str]]:
    found: dict[str, tuple[float, float, str]] = {}
    effects = [*_causes(run).values(), *(run["result"] or {}).get("effects", [])]
    for effect in effects:
        for key, value in effect["parameters"].items():
            if value["value"] is not None:
                name = f"{effect['effect']} ({', '.join(effect['at'])}) {key}"
                found[name] = value["value"], value["std"] or 0.0, value["unit"]
    stated = [estimate[:2] for estimate in found.values()]
    result = run["result"] or {}
    for one in (*result.get("base_parameters", []), *(result.get("parameters", []) if "level" in result else [])):
        if one["value"] is not None:
            name, estimate = one.get("expression", one.get("name", "")), (one["value"], one["std"] or 0.0)
            if " " in name or not any(
                np.allclose(estimate, other, rtol=1e-9, atol=1e-6 * other[1]) for other in stated
            ):
                found[name] = *estimate, one.get("unit", "")  # a drive's own column is an effect already
    return found


def _estimate(value: tuple[float, float, str] | None, first: tuple[float, float, str] | None) -> str:
    if value is None:
        return "-"
    star = first is not None and abs(value[0] - first[0]) > 3 * math.hypot(value[1], first[1]) + 1e-12
    return f"{value[0]:.4g} ± {value[1]:.2g} {value[2]}".rstrip() + (" *" if star else "")


def _links(folders: Sequence[Path]) -> Iterator[tuple[str, ...]]:
    """Mass, centre of mass and principal moments of the exported models' links, and how far each is off the first."""
    from ..formats.urdf import load_urdf

    tables: list[dict[str, tuple[float, ...]]] = []
    for folder in folders:
        path = folder / "model" / "robot.urdf"
        table: dict[str, tuple[float, ...]] = {}
        robot = load_urdf(path, kinematic=True) if path.is_file() else None
        for link, ten in zip(robot.link_names, np.asarray(robot.inertia), strict=True) if robot is not None else ():
            mass, com, about = to_com(ten) if ten[0] > 0 else (0.0, np.zeros(3), np.zeros((3, 3)))
            table[f"{link}: mass, kg"] = (float(mass),)
            table[f"{link}: centre of mass, mm"] = tuple(1e3 * float(x) for x in com)
            table[f"{link}: principal moments, kg m²"] = tuple(float(x) for x in np.linalg.eigvalsh(about))
        tables.append(table)
    for name in dict.fromkeys(name for one in tables for name in one):
        yield name, *(_values_of(one.get(name), tables[0].get(name)) for one in tables)


def _values_of(values: tuple[float, ...] | None, first: tuple[float, ...] | None) -> str:
    """Numbers of a model, with their change against the first run's."""
    if values is None:
        return "-"
    least = 1e-9 * max(map(abs, [*values, *(first or ())]))  # beside the others of its kind it is rounding

    def plain(x: float, form: str) -> str:
        return f"{x:{form}}" if abs(x) > least else "0"

    text = " ".join(plain(x, ".4g") for x in values)
    changes = [0.0] * len(values) if first is None else [x - y for x, y in zip(values, first, strict=True)]
    if max(map(abs, changes)) <= least:
        return text
    return f"{text} ({' '.join(plain(x, '+.2g') for x in changes)})"


def _made(folders: Sequence[Path]) -> Iterator[tuple[str, ...]]:
    made = [read_provenance(folder) if (folder / PROVENANCE).is_file() else {} for folder in folders]
    if any(made):
        for key in ("command", "task", "time"):
            yield key, *(str(one.get(key, "?")) for one in made)
        yield "figaroh-jax", *(str(one.get("versions", {}).get("figaroh-jax", "?")) for one in made)


def _number(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}"


def comparison_text(sections: Sequence[Section]) -> str:
    """The tables as text with aligned columns."""
    parts = []
    for section in sections:
        table = [section.head, *section.rows]
        widths = [max(len(row[k]) for row in table) for k in range(len(section.head))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in table]
        parts.append("\n".join([section.title, *("  " + line for line in lines)]))
    return "\n\n".join(parts)


_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1100px;padding:0 1rem;
color-scheme:light dark}
table{border-collapse:collapse}.scroll{overflow-x:auto}td,th{padding:.2rem .8rem;text-align:left;
border-bottom:1px solid color-mix(in srgb,currentColor 20%,transparent)}td+td{font-variant-numeric:tabular-nums}
svg{width:100%;height:auto;border:1px solid color-mix(in srgb,currentColor 20%,transparent)}
.k0{stroke:#2563eb}.k1{stroke:#d97706}.k2{stroke:#059669}.k3{stroke:#dc2626}.k4{stroke:#7c3aed}"""


def comparison_page(folders: Sequence[Path], sections: Sequence[Section]) -> str:
    """One HTML page without network: the tables, and the predictions of held-out recordings over each other."""
    parts = [f"<h1>{escape(' against '.join(_names(folders)))}</h1><p>The first run is the reference.</p>"]
    for section in sections:
        head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in section.head)
        body = "".join(
            f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{escape(x)}</td>" for x in row[1:]) + "</tr>"
            for row in section.rows
        )
        title = escape(section.title)
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        scroll = f'<div class="scroll" tabindex="0" role="group" aria-label="{title}">{table}</div>'
        parts.append(f"<h2>{title}</h2>{scroll}")
    with as_written(" or ".join(str(folder / "predictions.npz") for folder in folders)):
        parts += _overlays(folders)
    title = f"<title>{escape(' | '.join(_names(folders)))}</title>"
    meta = f'<meta charset="utf-8">{PAGE}<meta name="viewport" content="width=device-width,initial-scale=1">'
    text = f'<!doctype html><html lang="en"><head>{meta}{title}<style>{_STYLE}</style></head>'
    return f"{text}<body><main>{''.join(parts)}</main></body></html>\n"


def _overlays(folders: Sequence[Path]) -> Iterator[str]:
    """Predicted torque of each run on the held-out recordings that they share, joint by joint."""
    files = [folder / "predictions.npz" for folder in folders]
    if not all(file.is_file() for file in files):
        return
    runs = []
    for file in files:
        with np.load(file, allow_pickle=False) as arrays:
            runs.append({name: arrays[name] for name in arrays.files})
    shared = [key for key in runs[0] if key.endswith("_torque") and all(key in run for run in runs)]
    for key in shared:
        stem = key.removesuffix("_torque")
        yield f"<h2>Predicted torque of {escape(stem)}</h2><p>{_legend(_names(folders))}</p>"
        for joint in range(runs[0][key].shape[1]):
            if all(run[key].shape[1] > joint for run in runs):
                lines = [(run[f"{stem}_time"], run[key][:, joint]) for run in runs]
                yield f"<h3>column {joint + 1}</h3>{_plot(lines, f'{stem}, column {joint + 1}')}"


def _legend(names: Sequence[str]) -> str:
    line = (
        '<svg viewBox="0 0 20 6" style="width:20px;border:0"><path class="k{}" stroke-width="3" d="M0 3h20"/></svg> {}'
    )
    return ", ".join(line.format(k % 5, escape(name)) for k, name in enumerate(names))


def _plot(lines: Sequence[tuple[np.ndarray, np.ndarray]], label: str) -> str:
    start, end = min(t[0] for t, _ in lines), max(t[-1] for t, _ in lines)
    low, high = min(x.min() for _, x in lines), max(x.max() for _, x in lines)
    paths = ""
    for k, (time, x) in enumerate(lines):
        rows = np.unique(np.linspace(0, len(time) - 1, min(len(time), 1200)).astype(int))
        across = 1000 * (time[rows] - start) / max(end - start, 1e-12)
        up = 190 - 180 * (x[rows] - low) / max(high - low, 1e-12)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, up, strict=True))
        paths += f'<polyline class="k{k % 5}" fill="none" stroke-width="1.2" points="{points}"/>'
    text = f"{escape(label)}: {low:.3g} to {high:.3g} N m or N over {end - start:.3g} s"
    return f'<svg viewBox="0 0 1000 200" role="img" aria-label="{text}">{paths}</svg><p>{text}</p>'
