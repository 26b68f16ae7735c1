"""Answers of two versions of the package side by side: verdicts, causes, parameters, held-out errors.

    python benchmarks/parity.py make --cases DIR [--seeds 31 32]               # needs Pinocchio and the recordings
    python benchmarks/parity.py pack --cases DIR --out FILE.tar.xz             # to travel; unpack: back
    python benchmarks/parity.py run --cases DIR --out OUT --jobs 60 before=/path/a now=/path/b
    python benchmarks/parity.py table --cases DIR --out OUT

`make` writes folders that hold everything: twelve public sets ($FIGAROH_JAX_DATA: seven of torque, five of postures),
four identifications, 64 hidden effects (`hidden_effects.py`: sixteen effects, TX40 with the first seed and Panda with
the second, with and without repeats), and 18 made identifications that are judged on recordings kept out. `run` starts
a process for each case and version and goes on where it was stopped. `table` prints what differs, of what is hidden who
finds it, and whose sizes lie nearer to the truth.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import os
import re
import resource
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ONE_THREAD |= {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}
FRESH = 9  # made recordings of each robot that are identified
CLOSE = 1e-6  # relative, of parameters that are the same
GRID = {"q": 2.0**19, "tau": 2.0**9}  # steps to a radian and to a N m, a tenth of the made sensors' noise
BYTES = (0, 8, 16, 24)
DIFFERENCES = {"q": 3, "tau": 1}  # that leave the smallest numbers


def make(folder: Path, seeds: list[int], jobs: int, only_made: bool) -> None:
    """Write all cases and `cases.json`."""
    sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests")]
    folder.mkdir(parents=True, exist_ok=True)
    cases = [] if only_made else [*_torques(folder), *_postures(folder), *_identifications(folder)]
    cases += [*_hidden(folder, seeds, jobs), *_fresh(folder, seeds)]
    (folder / "cases.json").write_text(json.dumps(cases, indent=1))
    print(f"{len(cases)} cases, {sum(f.stat().st_size for f in folder.rglob('*') if f.is_file()) / 1e6:.0f} MB")


def _torques(folder: Path) -> Iterator[dict[str, Any]]:
    from benchmarks.hide_in_real.recordings import SETS

    for name, load in SETS.items():
        one, here = load(), folder / name
        here.mkdir(exist_ok=True)
        (here / "robot.urdf").write_text(one.urdf)
        data = []
        for run in one.recordings:
            np.savez_compressed(here / f"{run.name}.npz", **run.arrays)  # pyright: ignore[reportArgumentType]
            data.append({"file": f"{run.name}.npz", **run.entry})
        task = one.task | {"robot": {"model": "robot.urdf", **one.task["robot"]}, "data": data}
        (here / "task.yaml").write_text(json.dumps(task))
        yield {"name": name, "task": f"{name}/task.yaml", "command": "diagnose"}


def _postures(folder: Path) -> Iterator[dict[str, Any]]:
    import calibration

    files = {"talos_contact": "talos_contact/talos_full_v2.urdf", "tiago_mocap, 34": "tiago_mocap/tiago_no_hand.urdf"}
    files |= {"irb120_wu2015": "irb120_wu2015/irb120.urdf", "panda_handeye_board": "panda_handeye_board/panda.urdf"}
    files |= {"mukca panda_3": "mukca_panda/panda.urdf"}
    for title, file in files.items():
        model, recordings = calibration.SETS[title]()
        name = title.split(",")[0].replace(" ", "_")
        here, data = folder / name, []
        here.mkdir(exist_ok=True)
        shutil.copy(calibration.DATA / file, here / "robot.urdf")
        for k, r in enumerate(recordings):
            np.savez_compressed(here / f"{k}.npz", q=r.position, seen=r.values)
            measurement = {r.kind: "seen", "base_frame": r.base_frame, "tool_frame": r.tool_frame}
            measurement |= {"unknown": list(r.unknown)} | ({"distance": r.distance} if r.distance else {})
            data.append({"file": f"{k}.npz", "position": "q", "role": r.role, "measurement": measurement})
        robot = {"model": "robot.urdf", "joints": list(model.joint_names)}
        (here / "task.yaml").write_text(json.dumps({"robot": robot, "data": data}))
        for command in ("diagnose", "calibrate"):
            yield {"name": f"{name} {command}", "task": f"{name}/task.yaml", "command": command}


def _identifications(folder: Path) -> Iterator[dict[str, Any]]:
    import calibration
    import real_tasks
    import yaml

    for name in ("tx40", "tiago", "panda", "ur10e"):
        here = folder / f"identify_{name}"
        here.mkdir(exist_ok=True)
        task = yaml.safe_load(getattr(real_tasks, f"{name}_task")(here, calibration.DATA).read_text())
        robot = Path(task["robot"]["model"])
        shutil.copy(robot, here / "robot.urdf")
        task["robot"]["model"] = "robot.urdf"
        for entry in task["data"]:
            file = here / entry["file"]  # of a file elsewhere its own path
            if file.parent != here:
                shutil.copy(file, here / file.name)
            entry["file"] = file.name
        (here / "task.yaml").write_text(json.dumps(task))
        yield {"name": f"{name} identify", "task": f"{here.name}/task.yaml", "command": "identify"}


def _hidden(folder: Path, seeds: list[int], jobs: int) -> Iterator[dict[str, Any]]:
    import hidden_effects

    effects = list(hidden_effects.EFFECTS[:16])  # those that the first version knew
    wishes = [(r, s, effect) for r, s in zip(("tx40", "panda"), seeds, strict=True) for effect in effects]
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for made in pool.map(_one_hidden, [folder] * len(wishes), *zip(*wishes, strict=True)):
            yield from made


def _one_hidden(folder: Path, robot: str, seed: int, effect: str) -> list[dict[str, Any]]:
    """The cases of one effect in one robot, with and without repeats."""
    sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests")]
    import hidden_effects

    args = argparse.Namespace(
        closed_loop=False, clean=0, trusted=False, foreign=False, left_out=0, size=0.05, noise=1.0
    )
    args.robots, args.seeds, args.effects, args.layouts = [robot], [seed], [effect], list(hidden_effects.LAYOUTS)
    made = []
    for label, case, _ in hidden_effects._cases(args):
        name = label.replace(" ", "_").replace("(", "").replace(")", "").replace(",", "")
        case.write(folder / name)
        _smaller(folder / name)
        truth = [{"effect": one.effect, "at": list(one.at), "parameters": one.parameters} for one in case.truth]
        made.append({"name": label, "task": f"{name}/task.yaml", "command": "diagnose", "truth": truth})
    return made


def _fresh(folder: Path, seeds: list[int]) -> Iterator[dict[str, Any]]:
    """Made recordings to identify, two of six kept out; in turns nothing, a link or a payload is wrong."""
    from generators import make_case

    for robot, seed in zip(("tx40", "panda"), seeds, strict=True):
        for k in range(FRESH):
            effects = [[], [("link_inertia", 0.05)], [("payload", 0.1)]][k % 3]
            case = make_case(effects, robot=robot, repeats=1, trajectories=6, seed=seed + 1000 * (k + 1))
            name = f"fresh_{robot}_{k}"
            case.write(folder / name)
            _smaller(folder / name)
            task = json.loads((folder / name / "task.yaml").read_text())
            task["data"][-2:] = [one | {"role": "holdout"} for one in task["data"][-2:]]
            (folder / name / "task.yaml").write_text(json.dumps(task))
            title = f"fresh {robot} {k}{' '.join(name for name, _ in effects)} identify"
            yield {"name": title, "task": f"{name}/task.yaml", "command": "identify", "links": case.links}


def _smaller(folder: Path) -> None:
    """Recordings rounded to a tenth of their noise and in single precision, for both versions alike."""
    for file in folder.glob("*.npz"):
        with np.load(file) as arrays:
            kept = {key: x if key == "t" else _rounded(key, x) / GRID[key] for key, x in arrays.items()}
        kept = {key: x if key == "t" else x.astype(np.float32) for key, x in kept.items()}
        np.savez_compressed(file, **kept)  # pyright: ignore[reportArgumentType]


def _rounded(key: str, values: np.ndarray) -> np.ndarray:
    return np.round(values.astype(float) * GRID[key]).astype(np.int64)


def pack(folder: Path, file: Path) -> None:
    """All cases in one archive: what is hidden as differences of whole numbers, a byte of each after the other."""
    cases = json.loads((folder / "cases.json").read_text())
    hidden = {Path(c["task"]).parent for c in cases if "truth" in c or c["name"].startswith("fresh")}
    with tarfile.open(file, "w:xz", preset=9) as archive:
        for one in sorted(x for x in folder.rglob("*") if x.is_file()):
            name = one.relative_to(folder)
            content = _packed(one) if one.suffix == ".npz" and name.parent in hidden else one.read_bytes()
            entry = tarfile.TarInfo(str(name))
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    print(f"{file.stat().st_size / 1e6:.1f} MB")


def _packed(file: Path) -> bytes:
    kept = {}
    with np.load(file) as arrays:
        for key, x in arrays.items():
            if key in GRID:
                whole = _rounded(key, x)
                for _ in range(DIFFERENCES[key]):
                    whole = np.diff(whole, axis=0, prepend=0)
                folded = np.abs(2 * whole) - (whole < 0)  # signs in the last bit
                kept[key] = np.stack([(folded.T >> shift) & 255 for shift in BYTES]).astype(np.uint8)
            else:
                kept[key] = x
    out = io.BytesIO()
    np.savez(out, **kept)
    return out.getvalue()


def unpack(file: Path, folder: Path) -> None:
    """The cases of such an archive, as `make` wrote them."""
    with tarfile.open(file, "r:xz") as archive:
        archive.extractall(folder, filter="data")
    for one in folder.rglob("*.npz"):
        with np.load(one) as arrays:
            kept = dict(arrays)
        if any(kept[key].dtype == np.uint8 for key in GRID if key in kept):
            for key, differences in DIFFERENCES.items():
                planes = [one.astype(np.int64) << shift for one, shift in zip(kept[key], BYTES, strict=True)]
                folded = np.sum(planes, axis=0).T
                whole = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
                for _ in range(differences):
                    whole = np.cumsum(whole, axis=0)
                kept[key] = (whole / GRID[key]).astype(np.float32)
            np.savez_compressed(one, **kept)


def run(folder: Path, out: Path, sides: dict[str, Path], args: argparse.Namespace) -> None:
    """Every case by every version, `jobs` processes at a time; none is begun after `limit` seconds."""
    cases, begin = json.loads((folder / "cases.json").read_text()), time.monotonic()
    wanted = [c for c in cases if not args.only or _has(c, args.only)]
    wanted.sort(key=lambda c: (not _has(c, args.first), zlib.crc32(c["name"].encode())))  # a fair part, if cut
    todo = [(c, s) for c in wanted for s in sides if not _kept(out, c, s).is_file()]
    print(f"{len(todo)} runs to make", flush=True)

    def one(case: dict[str, Any], side: str) -> str:
        late = time.monotonic() - begin > args.limit
        return f"{side} {case['name']}: left out, too late" if late else _called(folder, out, case, side, sides[side])

    with ThreadPoolExecutor(args.jobs) as pool:
        for k, line in enumerate(pool.map(lambda each: one(*each), todo), 1):
            print(f"[{k}/{len(todo)}] {line}", flush=True)


def _has(case: dict[str, Any], words: list[str]) -> bool:
    """Whether a word is part of the case's name; `public` means what is not made."""
    made = "truth" in case or case["name"].startswith("fresh")
    return any(not made if word == "public" else word in case["name"] for word in words)


def _kept(out: Path, case: dict[str, Any], side: str) -> Path:
    return out / side / f"{case['name'].replace('/', '_')}.json"


def _called(folder: Path, out: Path, case: dict[str, Any], side: str, source: Path) -> str:
    """One process; keeps its answer with seconds and memory."""
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": path_of(source), "JAX_PLATFORMS": "cpu"}
    with tempfile.TemporaryDirectory() as scratch:
        task, answer = str((folder / case["task"]).resolve()), Path(scratch) / "out"
        words = [sys.executable, "-m", "figaroh_jax", case["command"], task, "--out", str(answer), "--quiet"]
        environment["XDG_CACHE_HOME"] = str(out / "cache" / side)
        start = time.monotonic()
        process = subprocess.Popen(
            words, env=environment, cwd=scratch, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        assert process.stderr is not None
        said = process.stderr.read().decode(errors="replace")[-1000:]
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        found = next((answer / n for n in ("answer.json", "result.json") if (answer / n).is_file()), None)
        record = {"exit": process.returncode, "cpu_s": _cpu(used), "peak_mb": used.ru_maxrss / 1024, "said": said}
        record |= {"wall_s": time.monotonic() - start, "answer": json.loads(found.read_text()) if found else None}
    kept = _kept(out, case, side)
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(record))
    return f"{side} {case['name']}: exit {record['exit']}, {record['cpu_s']:.0f} CPU s"


def path_of(source: Path) -> str:
    """PYTHONPATH of one version: its folder before all that is there, without other folders of the package."""
    given = [Path(one) for one in os.environ.get("PYTHONPATH", "").split(os.pathsep) if one]
    others = [str(one) for one in given if not any((x / "figaroh_jax").is_dir() for x in (one, one.parent))]
    return os.pathsep.join([str(source), *others])


def _cpu(used: resource.struct_rusage) -> float:
    return used.ru_utime + used.ru_stime


def table(folder: Path, out: Path) -> None:
    """Case by case, the two versions that `out` holds; then counts, and how near the sizes lie to what is hidden."""
    sides = sorted(p.name for p in out.iterdir() if p.is_dir() and p.name != "cache")
    counts: Counter[str] = Counter()
    found: dict[str, Counter[str]] = {side: Counter() for side in sides}
    errors: dict[str, list[list[tuple[float, float, float]]]] = {"hidden effects": [], "base parameters": []}
    for case in json.loads((folder / "cases.json").read_text()):
        if not all(_kept(out, case, side).is_file() for side in sides):
            counts["not run"] += 1
            continue
        both = [json.loads(_kept(out, case, side).read_text()) for side in sides]
        answers = [one["answer"] for one in both]
        word = _compared(*answers) if all(answers) else f"exit {[one['exit'] for one in both]}"
        counts[word.split(",")[0].split(":")[0]] += 1
        right = ""
        if "truth" in case and all(answers):
            hits = {s: _right(case["truth"], a) for s, a in zip(sides, answers, strict=True)}
            for side, hit in hits.items():
                found[side][hit] += 1
            right = f"  [{' | '.join(f'{s}: {h}' for s, h in hits.items())}]"
            errors["hidden effects"] += _errors(case["truth"], answers)
        if "links" in case and all(answers):
            errors["base parameters"] += _errors_of_links(case["links"], answers)
        print(f"{case['name']}: {word}{right}")
    print(", ".join(f"{count} {kind}" for kind, count in sorted(counts.items())))
    for side in sides:
        print(f"{side}: {', '.join(f'{n} {hit}' for hit, n in found[side].most_common())} of hidden effects")
    for what, each in errors.items():
        if each:
            _told(what, sides, each)


def _told(what: str, sides: list[str], errors: list[list[tuple[float, float, float]]]) -> None:
    """How near the numbers of both versions lie to the truth, and how often inside of their intervals."""
    (a, sa, size), (b, sb, _) = np.moveaxis(np.array(errors), 0, -1)
    inside = [f"{side} {(e <= 1.96 * s).sum()}" for side, e, s in zip(sides, (a, b), (sa, sb), strict=True)]
    moved = np.abs(a - b) > 1e-3 * sa
    ratio = np.sum((b / sa) ** 2) / np.sum((a / sa) ** 2)
    print(
        f"sizes of {what} that both give: {len(a)}, in the 95 % interval {', '.join(inside)}; of {moved.sum()} that"
        f" moved {(b < a)[moved].sum()} are nearer to the truth in {sides[1]}; error in {sides[0]}'s sigma: squares"
        f" {ratio:.3f} times, median {np.median(a / sa):.3f} -> {np.median(b / sa):.3f}; in their own: mean square"
        f" {np.mean((a / sa) ** 2):.2f} -> {np.mean((b / sb) ** 2):.2f}; median sigma {np.median(sb / sa):.3f} times"
    )
    times, share, seen = np.log(np.maximum(b, 1e-300) / np.maximum(a, 1e-300)), (a / size, b / size), size > 0
    middle, spread = times.mean(), 1.96 * times.std(ddof=1) / np.sqrt(len(times))
    low, mean, high = np.exp([middle - spread, middle, middle + spread])
    parts = [f"{np.median(e[seen]):.4f}" for e in share]
    near = [f"{(e[seen] <= 0.05).sum()} and {(e[seen] <= 0.15).sum()}" for e in share]
    print(
        f"  in their own units: error {mean:.3f} times in the geometric mean [{low:.3f}, {high:.3f}]; over the truth:"
        f" median {' -> '.join(parts)}; of {seen.sum()} within 5 and 15 % {' -> '.join(near)}"
    )


def _errors_of_links(
    links: list[list[float]], answers: list[dict[str, Any]]
) -> Iterator[list[tuple[float, float, float]]]:
    """The same of the base parameters that are sums of links' alone and that both versions identify."""
    names = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
    true = {f"{name}{k}": x for k, ten in enumerate(links, 1) for name, x in zip(names, ten, strict=True)}
    both = [{p["expression"]: p for p in a["base_parameters"] if p["status"] == "identified"} for a in answers]
    for text in both[0].keys() & both[1].keys():
        terms = re.findall(r"([+-]?) ?(\d[\d.e-]* )?([A-Za-z_.]+\d[\w]*)", text)
        if all(name in true for _, _, name in terms):
            value = sum((-1 if sign == "-" else 1) * float(factor or 1) * true[name] for sign, factor, name in terms)
            yield [(abs(own[text]["value"] - value), own[text]["std"], abs(value)) for own in both]


def _errors(truth: list[dict[str, Any]], answers: list[dict[str, Any]]) -> Iterator[list[tuple[float, float, float]]]:
    """Distance to the truth, sigma and truth, by both versions, of every number of a hidden effect that both name."""
    for hidden in truth:
        causes = [
            [c for c in a["causes"] if (c["effect"], c["at"]) == (hidden["effect"], hidden["at"])] for a in answers
        ]
        for name, true in hidden.get("parameters", {}).items():
            own = [each[0]["parameters"].get(name) for each in causes if each]
            if len(own) == len(answers) and all(p and p["std"] for p in own):
                yield [(abs(p["value"] - true), p["std"], abs(true)) for p in own]


def _names(answer: dict[str, Any]) -> list[str]:
    return [f"{c['effect']}({','.join(c['at'])})" for c in answer.get("causes", [])]


def _right(truth: list[dict[str, Any]], answer: dict[str, Any]) -> str:
    wanted = {f"{t['effect']}({','.join(t['at'])})" for t in truth}
    alike = {f"{t['effect']}({','.join(t['at'])})" for c in answer["causes"] for t in c["ambiguous_with"]}
    names = _names(answer)
    if not names:
        return answer["verdict"]
    return "right" if names[0] in wanted else ("in the set" if wanted & alike else "wrong")


def _compared(before: dict[str, Any], now: dict[str, Any]) -> str:
    """What is the same of two answers, and by how much their parameters and held-out errors differ."""
    said = [[a.get("verdict"), sorted(_names(a))] for a in (before, now)]
    held = [_held(a) for a in (before, now)]
    error = f"held-out error {held[0]:.5g} -> {held[1]:.5g}" if None not in held else ""
    if said[0] != said[1]:
        text = " -> ".join(f"{verdict} {', '.join(names) or '-'}" for verdict, names in said)
        return f"different: {text}; {error}"
    sizes = [_sizes(a) for a in (before, now)]
    common = sorted(set(sizes[0]) & set(sizes[1]))
    apart = [abs(sizes[0][k][0] - sizes[1][k][0]) for k in common]
    relative = [d / max(abs(sizes[0][k][0]), abs(sizes[1][k][0]), 1e-12) for d, k in zip(apart, common, strict=True)]
    sigmas = [d / sizes[1][k][1] for d, k in zip(apart, common, strict=True) if sizes[1][k][1]]
    worst = max(relative, default=0.0)
    only = len(set(sizes[0]) ^ set(sizes[1]))
    if worst <= CLOSE and not only:
        return f"same: {said[1][0] or 'result'}, parameters within {worst:.0e}"
    most = f", {max(sigmas):.1e} sigma" if sigmas else ""
    more = f", {only} only in one" if only else ""
    return f"same verdict: {said[1][0] or 'result'}, parameters apart by {worst:.1e}{most}{more}; {error}"


def _held(answer: dict[str, Any]) -> float | None:
    if answer.get("position"):
        return answer["position"]["validated_after"]
    if "base_parameters" in answer and answer.get("holdout"):
        return float(np.mean([x for one in answer["holdout"].values() for x in one["relative"]]))
    if answer.get("cross_validation"):
        return float(np.sqrt(np.mean([x**2 for x in answer["cross_validation"]["rms"] if x is not None])))
    causes = answer.get("causes") or []
    return min((c["gain"]["holdout_after"] for c in causes), default=None)


def _sizes(answer: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Value and sigma of every parameter by its name."""
    found = {}
    for cause in answer.get("causes", []):
        for name, p in cause["parameters"].items():
            found[f"{cause['effect']} {cause['at']} {name}"] = p["value"], p["std"] or 0.0
    own = answer.get("parameters") or []
    for p in [*own, *answer.get("base_parameters", [])]:
        name = p.get("name") or p["expression"]
        if p["value"] is not None and p.get("status") != "gauge":
            found[name] = p["value"], p["std"] or 0.0
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["make", "pack", "unpack", "run", "table"])
    parser.add_argument("sides", nargs="*", metavar="NAME=FOLDER")
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=[31, 32])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="of the names; `public`: what is not made"
    )
    parser.add_argument("--first", nargs="+", default=[], metavar="WORD", help="run these before the others")
    parser.add_argument("--limit", type=float, default=float("inf"), help="seconds after which no run begins")
    parser.add_argument("--only-made", action="store_true", help="make no case of the public recordings")
    args = parser.parse_intermixed_args()  # versions may stand behind options
    if args.step == "make":
        make(args.cases, args.seeds, args.jobs, args.only_made)
    elif args.step in ("pack", "unpack"):
        pack(args.cases, args.out) if args.step == "pack" else unpack(args.out, args.cases)
    elif args.step == "run":
        sides = {name: Path(folder).resolve() for name, folder in (one.split("=", 1) for one in args.sides)}
        run(args.cases, args.out.resolve(), sides, args)
    else:
        table(args.cases, args.out)


if __name__ == "__main__":
    main()
