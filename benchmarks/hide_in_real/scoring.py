"""Grades of all cases, as tables and as `results.json`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..blackbox import Case, Job, commit, grade, read

TITLE = {  # what a grade is called where the truth may be named, and where it is forbidden
    "named": {"right": "right", "more": "right + another", "set": "in the set", "wrong": "wrong", "silent": "silent"},
    "forbidden": {"silent": "no new name", "wrong": "a new name"},
}
NEVER = "never came near"  # of an effect of which the answer says nothing


def score(cases: dict[str, Case], out: Path, modes: Iterable[str]) -> str:
    """The tables; `results.json` in `out` holds every case."""
    rows = [row for name, case in cases.items() if case["truth"] for row in _rows(name, case, out, modes)]
    (out / "results.json").write_text(json.dumps({"commit": commit(), "cases": rows}, indent=1))
    lines = []
    for mode in modes:
        for shown, title in ((True, "visible"), (False, "absorbed")):
            own = [r for r in rows if r["mode"] == mode and r["visible"] is shown]
            if own:
                lines += ["", f"{mode}, {title}:", *_table(own, TITLE[mode] | {"failed": "failed"})]
            if own and shown and mode == "named":
                lines += ["", "by what the robot leaves of its own:", *_beside_rest(own)]
    return "\n".join([*lines, "", *_detail(rows)])


def _rows(name: str, case: Case, out: Path, modes: Iterable[str]) -> list[dict[str, Any]]:
    found = []
    for mode in modes:
        forbid = tuple(case["forbid"]) if mode == "forbidden" else ()
        job, twin_job = Job(name, forbid), Job(case["twin"], forbid)
        if not all((out / each.folder / "run.json").is_file() for each in (job, twin_job)):
            continue
        answer, twin = read(out / job.folder), read(out / twin_job.folder)
        graded = grade(case if mode == "named" else case | {"truth": []}, answer, twin)
        ran = json.loads((out / job.folder / "run.json").read_text())
        found.append(
            {"case": name, "group": case["group"], "size": case["size"], "mode": mode, "visible": case["visible"]}
            | {"left": case["left"], "sigmas": case["sigmas"], "effect": case["truth"][0]["effect"]}
            | {"grade": graded.grade, "new": graded.new, "false": graded.false, "size_errors": graded.sizes}
            | {
                "borne_out": case.get("oracle", {}).get("sure"),
                "beside_rest": _over_rest(case, twin),
                "why_not": _why_not(case, answer),
                "inside": graded.inside,
                "verdict": answer["verdict"] if answer else None,
                "cpu_s": ran["cpu_s"],
            }
        )
    return found


def _over_rest(case: Case, twin: dict[str, Any] | None) -> float:
    """What the baseline cannot take of the effect, over what the twin leaves unexplained at its joints (largest)."""
    told = (twin or {}).get("rest", {}).get("relative", ())
    left = dict(zip(case["task"]["robot"].get("joints", ()), told, strict=False))
    at = [joint for joint in case["truth"][0]["at"] if joint in left]  # a link or the whole robot: any joint
    own = max([left[joint] for joint in at or left], default=np.nan)
    return case["size"] * case["left"] ** 0.5 / max(own, 1e-6)


def _why_not(case: Case, answer: dict[str, Any] | None) -> str:
    """Why the tool does not name the effect, in its words; that it never came near where it says nothing of it."""
    truth = case["truth"][0]
    near = (answer or {}).get("rest", {}).get("nearest", ())
    told = [one["why_not"] for one in near if (one["effect"], one["at"]) == (truth["effect"], truth["at"])]
    return told[0] if told else NEVER


def _beside_rest(rows: list[dict[str, Any]]) -> list[str]:
    """Markdown: how many are right, by how large they are beside what the untouched robot leaves unexplained there."""
    lines = ["| effect over the twin's rest | cases | right, also with another |", "|---|---|---|"]
    for low, high, title in ((2, np.inf, "more than 2"), (1, 2, "1 to 2"), (0, 1, "below 1")):
        own = [r for r in rows if low <= r["beside_rest"] < high]
        right = sum(r["grade"] in ("right", "more") for r in own)
        lines.append(f"| {title} | {len(own)} | {right}{f' ({100 * right / len(own):.0f} %)' if own else ''} |")
    unknown = sum(np.isnan(r["beside_rest"]) for r in rows)
    lines += [f"| the tool tells no rest | {unknown} | |"] * bool(unknown)
    silent = [r for r in rows if r["grade"] == "silent"]
    return [*lines, "", f"of {len(silent)} silent ones {sum(r['why_not'] == NEVER for r in silent)} {NEVER}"]


def _table(rows: list[dict[str, Any]], titles: dict[str, str]) -> list[str]:
    """Markdown: one line for each robot and size, then for each size."""
    head = ["robot", "size", "cases", *titles.values(), "size error, median", "within 15 %"]
    head += ["borne out", "right of these"] * (rows[0]["mode"] == "named")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    groups = list(dict.fromkeys(r["group"] for r in rows))
    for group in [*groups, None]:
        for size in sorted({r["size"] for r in rows}):
            own = [r for r in rows if r["size"] == size and group in (None, r["group"])]
            if own:
                lines.append(_line(group or "all", size, own, titles))
    return lines


def _line(group: str, size: float, rows: list[dict[str, Any]], titles: dict[str, str]) -> str:
    counts = [sum(r["grade"] == g for r in rows) for g in titles]
    errors = np.array([e for r in rows for e in r["size_errors"]])
    told = [f"{np.nanmedian(errors):.2f}", f"{np.sum(errors < 0.15)} of {len(errors)}"] if len(errors) else ["", ""]
    if rows[0]["mode"] == "named":  # by the truth itself: see oracle.py
        borne = [r for r in rows if r["borne_out"]]
        right = sum(r["grade"] in ("right", "more") for r in borne)
        told += [str(len(borne)), f"{right} ({100 * right / len(borne):.0f} %)" if borne else ""]
    return "| " + " | ".join([group, f"{100 * size:g} %", str(len(rows)), *map(str, counts), *told]) + " |"


def _detail(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for r in rows:
        new = "; ".join(f"{effect} ({', '.join(at)})" for effect, at in r["new"])
        size = ", ".join(f"{e:.2f}" for e in r["size_errors"])
        shown = f"left {r['left']:.2f} D {r['sigmas']:.1f}"
        borne = {True: "borne out", False: "not borne out", None: ""}[r["borne_out"]]
        lines.append(
            f"{r['case']:<48} {r['mode']:<9} {'visible ' if r['visible'] else 'absorbed'} {shown:<18} "
            f"{borne:<13} {r['grade']:<7} {r['verdict'] or '-':<10} new: {new or '-'}"
            + (f"   size off by {size}" if size else "")
            + (f"   {r['why_not']}" if r["mode"] == "named" and r["grade"] == "silent" else "")
        )
    return lines
