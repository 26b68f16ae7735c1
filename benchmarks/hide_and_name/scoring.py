"""Grades of all cases by family and size, as tables and as `results.json`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..blackbox import Case, Job, commit, grade, read

HIDDEN = ("right", "more", "set", "wrong", "nothing", "unknown", "failed")
SEEN = 5.0  # D from which an effect is more than the noise (`visible`)
NONE = ("nothing", "unknown", "wrong", "failed")


def score(cases: dict[str, Case], out: Path, modes: Iterable[str]) -> str:
    """The tables; `results.json` in `out` holds every case."""
    rows = [row for case in cases.values() for row in _rows(case, out, modes)]
    (out / "results.json").write_text(json.dumps({"commit": commit(), "cases": rows}, indent=1))
    lines = []
    for title, what in (("hidden", "right"), ("clean", "nothing"), ("left out", "unknown"), ("foreign", "unknown")):
        own = [r for r in rows if r["study"] == title]
        if own:
            lines += ["", f"{title} ({what} is right):", *_table(own, HIDDEN if title == "hidden" else NONE)]
            lines += [*_extra(own, title), *_moved(own)]
    return "\n".join([*lines, "", *map(_told, rows)])


def _rows(case: Case, out: Path, modes: Iterable[str]) -> list[dict[str, Any]]:
    found = []
    for mode in modes:
        forbid = tuple(case.get("forbid", ())) if mode == "forbidden" else ()
        job = Job(case["name"], forbid)
        if (mode == "forbidden" and not forbid) or not (out / job.folder / "run.json").is_file():
            continue
        answer = read(out / job.folder)
        graded = grade(case if mode == "named" else case | {"truth": []}, answer, None)
        mark = answer["verdict"] if answer and graded.grade == "silent" else graded.grade
        study = "left out" if forbid else "hidden" if case["truth"] else case["family"]
        ran = json.loads((out / job.folder / "run.json").read_text())
        found.append(
            {"case": case["name"], "group": case["group"], "size": case["size"], "family": case["family"]}
            | {"study": study if study in ("left out", "hidden", "clean") else "foreign", "grade": mark}
            | {"new": graded.new, "false": graded.false, "size_errors": graded.sizes, "inside": graded.inside}
            | {key: case.get(key) for key in ("left", "sigmas", "misfit", "visible")}
            | {"p_value": answer["p_value"] if answer else None, "cpu_s": ran["cpu_s"]}
            | {"links": bool(answer) and "links" in answer}
        )
    return found


def _table(rows: list[dict[str, Any]], grades: tuple[str, ...]) -> list[str]:
    head = ["cases of", "size", "number", *("right + another" if g == "more" else g for g in grades)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for group in dict.fromkeys(r["group"] for r in rows):
        for size in sorted({r["size"] for r in rows if r["group"] == group}):
            own = [r for r in rows if (r["group"], r["size"]) == (group, size)]
            counts = [str(sum(r["grade"] == g for r in own)) for g in grades]
            lines.append("| " + " | ".join([group, f"{size:g}", str(len(own)), *counts]) + " |")
    return lines


def _extra(rows: list[dict[str, Any]], title: str) -> list[str]:
    """Coverage of the intervals of named causes; p-values of clean cases."""
    if title == "hidden":
        inside = [x for r in rows for x in r["inside"]]
        return (
            [*_by_sight(rows)] + [f"90 % intervals of named causes hold {sum(inside)} of {len(inside)} parameters"]
            if inside
            else []
        )
    if title != "clean":
        return _by_sight(rows)
    p = [r["p_value"] for r in rows if r["p_value"] is not None]
    return [f"p < .05 in {sum(x < 0.05 for x in p)} of {len(p)}"] if p else []


def _moved(rows: list[dict[str, Any]]) -> list[str]:
    """How often links other than those of the file are told, though these are within what is believed."""
    count = sum(r["links"] for r in rows)
    return [f"links are told to be others than the file's in {count} of {len(rows)}"] if count else []


def _by_sight(rows: list[dict[str, Any]]) -> list[str]:
    """Hidden effects by what the data hold of them, which `visible` says without any tool's answer."""
    groups = {
        "in the data": lambda r: r["visible"],
        "below the tolerance": lambda r: not r["visible"] and r["sigmas"] >= SEEN,
        "within the noise": lambda r: r["sigmas"] < SEEN,
    }
    asked = [r for r in rows if r["visible"] is not None]
    out = []
    for title, belongs in groups.items():
        for size in sorted({r["size"] for r in asked}):
            own = [r["grade"] for r in asked if r["size"] == size and belongs(r)]
            if own:
                counts = ", ".join(f"{own.count(g)} {g}" for g in HIDDEN if g in own)
                out.append(f"{title}, {100 * size:g} %: {len(own)} cases: {counts}")
    return out


def _told(row: dict[str, Any]) -> str:
    new = "; ".join(f"{effect} ({', '.join(at)})" for effect, at in row["new"])
    size = ", ".join(f"{e:.2f}" for e in row["size_errors"])
    sight = f"   D {row['sigmas']:.1f}, misfit {row['misfit']:.2%}" if row["sigmas"] is not None else ""
    text = f"{row['case']:<64} {row['study']:<9} {row['grade']:<8} named: {new or '-'}"
    return text + (f"   size off by {size}" if size else "") + sight
