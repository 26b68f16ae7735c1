"""What `diagnose` says of untouched recordings of real robots: causes, what they gain, what is left and where.

    python -m benchmarks.real                       # torque recordings, each beside `identify` on the same rows
    python -m benchmarks.real --postures            # the pose sets of `benchmarks/calibration.py`
    python -m benchmarks.real --only tx40 --jobs 2 --out RESULTS.json
    python -m benchmarks.real --commands identify   # one of the two alone

The tasks are those of `hide_in_real`, without anything hidden; the data folder is `$FIGAROH_JAX_DATA`.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import blackbox

IDENTIFY = f"{shlex.quote(sys.executable)} -m figaroh_jax identify {{task}} --out {{out}} --quiet"
COMMANDS = {"diagnose": blackbox.default_command(), "identify": IDENTIFY}
PARTS = 4  # of the rest that are told


def main() -> None:
    """Diagnose each set in a process of its own and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--postures", action="store_true", help="pose sets in place of torque recordings")
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), help="of torque recordings")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all answers")
    args = parser.parse_args()
    names = [n for n in _names(args.postures) if not args.only or any(word in n for word in args.only)]
    results = {}
    with ProcessPoolExecutor(args.jobs) as pool:
        work = pool.map(_postures, names) if args.postures else pool.map(_torque, names, [args.commands] * len(names))
        for name, told in zip(names, work, strict=True):
            results[name] = told
            print(*_lines(name, told), sep="\n", flush=True)
    if args.out:
        args.out.write_text(json.dumps({"commit": blackbox.commit(), "sets": results}, indent=1))


def _names(postures: bool) -> list[str]:
    if postures:
        return list(_pose_sets())
    from .hide_in_real.recordings import SETS

    return list(SETS)


def _pose_sets() -> dict[str, Any]:
    sys.path.insert(0, str(Path(__file__).parent))
    import calibration  # pyright: ignore[reportMissingImports]

    return calibration.SETS


def _torque(name: str, commands: list[str]) -> dict[str, Any]:
    """Answers of the commands on the untouched recordings."""
    from .hide_in_real.generate import twin_of
    from .hide_in_real.recordings import SETS

    with tempfile.TemporaryDirectory() as scratch:
        cases, runs = Path(scratch, "cases"), Path(scratch, "runs")
        twin = twin_of(cases, SETS[name]())
        told = {}
        for command in commands:
            blackbox.run(cases, runs / command, {twin["name"]: twin}, COMMANDS[command], 1, 3600, ["named"])
            kept = runs / command / twin["name"] / "all"
            told[command] = blackbox.read(kept) or {}
            told[f"{command}_run"] = json.loads((kept / "run.json").read_text())
        return told


def _postures(name: str) -> dict[str, Any]:
    """What `diagnose` says of poses, in the same words."""
    from figaroh_jax.calibration.kinematic_diagnosis import diagnose_poses

    sets = _pose_sets()
    model, recordings = sets[name]()
    import calibration  # pyright: ignore[reportMissingImports]

    points = [replace(r, values=calibration.points_of(r.values)) if r.kind == "position" else r for r in recordings]
    found = diagnose_poses(model, points)
    position = found.calibration.position
    causes = [
        {
            "effect": c.name.effect,
            "at": list(c.name.at),
            "gain": {"holdout_before": c.gain.before, "holdout_after": c.gain.after},
        }
        for c in found.causes
    ]
    gain = {} if position is None else {"before": position.validated_before, "after": position.validated_after}
    return {"diagnose": {"verdict": found.verdict, "causes": causes, "holdout": gain | {"unit": "mm"}}}


def _lines(name: str, told: dict[str, Any]) -> list[str]:
    identified = [f"   `identify`, held out: {_pooled(told['identify'])}"] if told.get("identify") else []
    if "diagnose" not in told:
        return [f"## {name}", *(identified or [f"   no answer: {told['identify_run'].get('said', '')[-300:]}"])]
    answer = told["diagnose"]
    if not answer:
        return [f"## {name}: no answer", told.get("diagnose_run", {}).get("said", "")[-300:], *identified]
    held, run = answer["holdout"], told.get("diagnose_run", {})
    cost = f", {run['cpu_s']:.0f} CPU s, {run['peak_mb']:.0f} MiB" if run else ""
    lines = [f"## {name}: {answer['verdict']}, held out {_of(held, 'before')} -> {_of(held, 'after')}{cost}"]
    for cause in answer["causes"]:
        gain = cause["gain"]
        size = f"{gain['holdout_before']:.4g} -> {gain['holdout_after']:.4g}"
        others = ", ".join(f"{o['effect']} ({', '.join(o['at'])})" for o in cause.get("ambiguous_with", ()))
        lines.append(f"   {cause['effect']} ({', '.join(cause['at'])}): {size}" + (f"; or {others}" if others else ""))
    if own := answer.get("links"):
        gain = own["gain"]
        size = f"{gain['holdout_before']:.4g} with those of the file, {gain['holdout_after']:.4g} with fitted ones"
        lines.append(f"   links: {size}, {own['sigmas']:.1f} sigma")
        lines += [f"      {_moved(one)}" for one in own["moved"]]
    rest = answer.get("rest", {})
    if "relative" in rest:
        lines.append("   rest " + " ".join(f"{x:.3f}" for x in rest["relative"]) + " of each joint's torque")
        parts = sorted(rest.get("parts", ()), key=lambda p: -p["share"])[:PARTS]
        lines += [f"   rest goes with {p['kind']} at {', '.join(p['at'])} ({p['share']:.0%})" for p in parts]
    return [*lines, *identified]


def _moved(one: dict[str, Any]) -> str:
    """A link or rotor that is another than the file has, as `answer.json` tells it."""
    sizes = ", ".join(f"{n} {p['value']:.3g} +- {1.96 * p['std']:.2g}" for n, p in one["parameters"].items())
    instead = "".join(f" or {o['effect']} ({', '.join(o['at'])})" for o in one["instead"])
    note = f" ({one['note']})" if one["note"] else ""
    return f"{one['effect']} ({', '.join(one['at'])}){instead}: {sizes}{note}, {one['share']:.0%} with it"


def _pooled(result: dict[str, Any]) -> str:
    """Error of `identify` on the holdout recordings, as `diagnose` tells it: of all joints over all torque."""
    out = []
    for name, fit in result.get("holdout", {}).items():
        rms = np.asarray(fit["rms"])
        whole = rms / np.maximum(np.asarray(fit["relative"]), 1e-12)
        out.append(f"{np.sqrt((rms**2).sum() / (whole**2).sum()):.4f} ({name})")
    return ", ".join(out) or "no recording kept out"


def _of(gain: dict[str, Any], key: str) -> str:
    value = gain.get(key, gain.get(f"holdout_{key}"))
    return "-" if value is None else f"{value:.4f}"


if __name__ == "__main__":
    main()
