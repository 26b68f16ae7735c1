"""Runs any tool over the cases of a benchmark through its command line, and grades its answers.

A benchmark leaves `cases.json` in a folder of cases and, for every case, a task whose recordings may lie elsewhere plus
what is to be added to them. `run` writes each task out, calls the command and keeps `answer.json`; it needs numpy
alone, takes up where it was stopped, and works where the generator's packages are missing. `grade` compares the answer
of a case with that of its untouched twin (none: with nothing).

Form of an entry of `cases.json`, keys that are not needed left out:
    name, group, size       for the table
    task                    the task, its recordings in `data` relative to the folder of cases
    added                   file of what is added to the recordings' arrays: "<stem of the file>/<array>"
    model                   text file of the robot beside it, copied as "robot.urdf"
    twin                    name of the case without the effect
    truth                   list of {effect, at, also, parameters, scale}; empty: nothing is hidden; `also` are further
                            names of the place, `accept` lists all (effect, at) that are right in place of both
    forbid                  names forbidden in a second run, in which the truth is left out of the catalogue
    visible                 whether the data show it at all
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = "here"  # `here MODULE:FUNCTION WORD ...` calls a Python tool in this process: no start, one call at a time
COMMAND = "figaroh-jax diagnose {task} --out {out} --quiet"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ONE_THREAD |= {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}
EQUIVALENT = ({"torque_delay", "torque_lag"}, {"torque_offset", "asymmetric_coulomb_friction"})

Case = dict[str, Any]
Name = tuple[str, tuple[str, ...]]
Told = tuple[Name, dict[str, Any]]  # a cause of an answer


@dataclass(frozen=True)
class Job:
    """One call of the command: a case, with or without effects forbidden."""

    case: str
    forbid: tuple[str, ...] = ()

    @property
    def folder(self) -> str:
        return f"{self.case}/forbid-{'+'.join(self.forbid)}" if self.forbid else f"{self.case}/all"


def load_cases(folder: Path, wanted: Sequence[str] = ()) -> dict[str, Case]:
    """Cases by name; `wanted` keeps those whose name holds one of its words, and the twins of these."""
    cases = {case["name"]: case for case in json.loads((folder / "cases.json").read_text())["cases"]}
    kept = [n for n in cases if not wanted or any(word in n for word in wanted)]
    kept += [cases[n]["twin"] for n in kept if cases[n].get("twin")]
    return {n: case for n, case in cases.items() if n in kept}


def jobs_of(cases: dict[str, Case], modes: Iterable[str]) -> list[Job]:
    """Calls that the cases need, twins first: they are shared."""
    found: dict[Job, int] = {}
    for name, case in cases.items():
        twin = case.get("twin")
        for forbid in [()] * ("named" in modes) + [tuple(case.get("forbid", ()))] * ("forbidden" in modes):
            if not forbid and "named" not in modes:  # nothing to forbid
                continue
            found.setdefault(Job(name, forbid), 1 if twin else 0)
            if twin:
                found.setdefault(Job(twin, forbid), 0)
    return sorted(found, key=lambda job: (found[job], job.folder))


def run(
    folder: Path, out: Path, cases: dict[str, Case], command: str, jobs: int, limit: float, modes: Iterable[str]
) -> None:
    """Call the command for all that has no result yet, `jobs` at a time; `limit` is in seconds of a call."""
    todo = [job for job in jobs_of(cases, modes) if not (out / job.folder / "run.json").is_file()]
    print(f"{len(todo)} calls to make", flush=True)
    started = time.monotonic()
    with ThreadPoolExecutor(jobs) as pool:
        calls = [pool.submit(call_tool, folder, out, cases[job.case], job, command, limit) for job in todo]
        for count, call in enumerate(calls, 1):
            print(f"[{count}/{len(todo)} {time.monotonic() - started:.0f} s] {call.result()}", flush=True)


def call_tool(folder: Path, out: Path, case: Case, job: Job, command: str, limit: float) -> str:
    with tempfile.TemporaryDirectory() as scratch:
        task = write_task(folder, Path(scratch), case, job.forbid)
        answer = Path(scratch) / "out"
        words = [word.format(task=task, out=answer) for word in shlex.split(command)]
        record = _here(words[1:]) if words[0] == HERE else _timed(words, limit)
        kept = out / job.folder
        kept.mkdir(parents=True, exist_ok=True)
        for file in ("answer.json", "result.json"):
            if (answer / file).is_file():
                shutil.copy(answer / file, kept)
        (kept / "run.json").write_text(json.dumps({"command": command, **record}))
    return f"{job.folder}: exit {record['exit']}, {record['cpu_s']:.0f} CPU s{_brief(kept)}"


def _timed(words: list[str], limit: float) -> dict[str, Any]:
    """Exit status, CPU seconds, memory and the end of what was said of one process."""
    with tempfile.TemporaryFile() as said:
        start = time.monotonic()
        process = subprocess.Popen(words, stdout=said, stderr=said, env=os.environ | ONE_THREAD)
        code, used = _waited(process, limit)
        said.seek(0, os.SEEK_END)
        said.seek(max(0, said.tell() - 2000))
        text = said.read().decode(errors="replace")
    cpu = used.ru_utime + used.ru_stime
    wall = time.monotonic() - start
    return {"exit": code, "cpu_s": cpu, "wall_s": wall, "peak_mb": used.ru_maxrss / 1024, "said": text}


def _here(arguments: list[str]) -> dict[str, Any]:
    """The same of a tool's own function for its command line, in this process, where its programs stay loaded."""
    module, function = arguments[0].split(":")
    main = getattr(importlib.import_module(module), function)
    start, clock, said = time.process_time(), time.monotonic(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(arguments[1:])
    used = {"cpu_s": time.process_time() - start, "wall_s": time.monotonic() - clock}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # of the process until now
    return {"exit": code, **used, "peak_mb": peak, "said": said.getvalue()[-2000:]}


def _waited(process: subprocess.Popen[bytes], limit: float) -> tuple[int, resource.struct_rusage]:
    end = time.monotonic() + limit
    while True:
        pid, status, used = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, used
        if time.monotonic() > end:
            process.kill()
            end = np.inf
        time.sleep(0.05)


def _brief(kept: Path) -> str:
    answer = read(kept)
    if answer is None:
        return ", no answer"
    if "verdict" not in answer:  # of another command than a diagnosis
        return ""
    return f", {answer['verdict']} {'; '.join(_word(name) for name, _ in causes(answer))}"


def write_task(folder: Path, scratch: Path, case: Case, forbid: Sequence[str] = ()) -> Path:
    """The case as a user would have it: recordings, model and task in one folder."""
    task = json.loads(json.dumps(case["task"]))
    shutil.copy(folder / case["model"], scratch / "robot.urdf")
    added = np.load(folder / case["added"]) if case.get("added") else {}
    for entry in task["data"]:
        source = folder / entry["file"]
        with np.load(source) as file:
            arrays = {key: file[key] for key in file.files}
        for key in arrays:
            if f"{source.stem}/{key}" in added:
                arrays[key] = arrays[key] + added[f"{source.stem}/{key}"]
        entry["file"] = source.name
        np.savez(scratch / source.name, **arrays)
    if forbid:
        task["diagnose"] = task.get("diagnose", {}) | {"forbid": list(forbid)}
    path = scratch / "task.yaml"
    path.write_text(json.dumps(task, indent=1))  # JSON is YAML
    return path


def read(kept: Path) -> dict[str, Any] | None:
    """The answer of a call; None where there is none."""
    file = kept / "answer.json"
    file = file if file.is_file() else kept / "result.json"
    return json.loads(file.read_text()) if file.is_file() else None


def causes(answer: dict[str, Any]) -> list[Told]:
    """What an answer names; `unknown` and `nothing` name nothing."""
    if answer["verdict"] not in ("named", "named+rest"):
        return []
    return [((c["effect"], tuple(c["at"])), c) for c in answer["causes"]]


def _word(name: Name) -> str:
    return f"{name[0]} ({', '.join(name[1])})"


def same_effect(a: str, b: str) -> bool:
    """Whether two names are one, or cannot be told apart by any torque."""
    return a == b or any({a, b} <= names for names in EQUIVALENT)


def accepts(truth: dict[str, Any], name: Name) -> bool:
    """Whether a name is right for a hidden effect, at its place."""
    if "accept" in truth:
        return any(name == (effect, tuple(at)) for effect, at in truth["accept"])
    places = [tuple(truth["at"]), *((link,) for link in truth.get("also", ()))]
    names = {truth["effect"], *truth.get("names", ())}
    return name[1] in places and any(same_effect(name[0], n) for n in names)


@dataclass(frozen=True)
class Grade:
    """How a case went: `right`, `more` (right and another), `set`, `wrong`, `silent` or `failed`; errors of sizes."""

    grade: str
    new: tuple[Name, ...] = ()
    false: tuple[Name, ...] = ()
    sizes: tuple[float, ...] = ()
    inside: tuple[bool, ...] = ()  # whether the interval of each parameter holds the truth


_NONE = (None, None)


def grade(case: Case, answer: dict[str, Any] | None, twin: dict[str, Any] | None) -> Grade:
    """Compare what is new in an answer with what was hidden."""
    if answer is None or (case.get("twin") and twin is None):
        return Grade("failed")
    before = causes(twin) if twin else []
    told = causes(answer)
    new = _more_than(told, before)
    truths = case["truth"]
    hits, sizes, inside = [], [], []
    for truth in truths:
        name, hit = min(
            ((n, c) for n, c in new if accepts(truth, n)), key=lambda t: _distance(t[1], truth), default=_NONE
        )
        # one more of what the twin has is all new, and not its growth
        olds = (c for n, c in before if accepts(truth, n) and n != name)
        old = min(olds, key=lambda c: _distance(c, truth), default=None)
        if hit is None and old is not None:
            hit = next((c for n, c in told if accepts(truth, n) and _grown(truth, c, old)), None)
        hits.append(hit)
        if hit is not None:
            sizes.append(size_error(truth, hit, old))
            inside += _inside(truth, hit) if old is None else []
    told_before = _alternatives(twin)  # the twin's answer left it open whether it is this
    again = {n for n, c in new if any(c is hit for hit in hits)}  # that a truth has taken: one more of it is none
    spare = [(n, c) for n, c in new if not any(c is hit for hit in hits)]
    open_ = [(n, c) for n, c in spare if n in again or not any(accepts(t, n) for t in truths)]
    false = [(n, c) for n, c in open_ if n not in told_before]
    names, wrong = tuple(n for n, _ in new), tuple(n for n, _ in false)
    if truths and all(h is not None for h in hits):
        return Grade("more" if wrong else "right", names, wrong, tuple(sizes), tuple(inside))
    if any(_in_set(t, c) for t in truths for _, c in false):
        return Grade("set", names, tuple(n for n, c in false if not any(_in_set(t, c) for t in truths)))
    return Grade("wrong" if false else "silent", names, wrong)


def _more_than(told: list[Told], before: list[Told]) -> list[Told]:
    """The causes that a twin's answer lacks; of one more of what it has, that which is least like the twin's."""
    new = [(n, c) for n, c in told if not any(n[1] == o[1] and same_effect(n[0], o[0]) for o, _ in before)]
    for name in dict.fromkeys(n for n, _ in before):
        more = [c for n, c in told if n == name]
        for old in (c for n, c in before if n == name):
            if more:
                more.pop(min(range(len(more)), key=lambda k: _distance(more[k], old)))
        new += [(name, c) for c in more]
    return new


def _distance(one: dict[str, Any], other: dict[str, Any]) -> float:
    """How much the numbers that two causes (or a cause and a truth) share differ, relative."""
    a, b = (
        {k: float(v["value"] if isinstance(v, dict) else v) for k, v in c["parameters"].items()} for c in (one, other)
    )
    shared = [k for k in a.keys() & b.keys() if np.isfinite(a[k] - b[k])]
    return sum(abs(a[k] - b[k]) / max(abs(a[k]), abs(b[k]), 1e-12) for k in shared) if shared else np.inf


def _alternatives(twin: dict[str, Any] | None) -> set[Name]:
    """Names that an answer gives as possible in place of those that it puts first."""
    if twin is None:
        return set()
    return {(o["effect"], tuple(o["at"])) for _, cause in causes(twin) for o in cause.get("ambiguous_with", ())}


def _in_set(truth: dict[str, Any], cause: dict[str, Any]) -> bool:
    return any(accepts(truth, (o["effect"], tuple(o["at"]))) for o in cause.get("ambiguous_with", ()))


def _grown(truth: dict[str, Any], cause: dict[str, Any], old: dict[str, Any]) -> bool:
    """Whether a cause that the twin has too changed by between half and one and a half times the truth."""
    error = size_error(truth, cause, old)
    return bool(error < 0.5)


def _values(cause: dict[str, Any] | None) -> dict[str, float]:
    return {k: float(p["value"]) for k, p in cause["parameters"].items()} if cause else {}


def vector(values: dict[str, float], truth: dict[str, Any]) -> np.ndarray:
    """What an effect's size is judged by, in units of `truth.scale`: amplitudes, first moments, torque at a speed."""
    if not values:
        return np.zeros(1)
    if "mass" in values and "com_x" in values:
        return values["mass"] * np.array([values[f"com_{k}"] for k in "xyz"])
    if "mx" in values:
        return np.array([values[f"m{k}"] for k in "xyz"])
    if "order" in values:
        return np.array([np.hypot(values["sine"], values["cosine"])])
    speeds = np.array(truth.get("speeds", [1.0]))
    if "exponent" in values:
        return np.array([values["strength"] * np.sqrt(np.mean(speeds ** (2 * values["exponent"])))])
    if "speed" in values:
        return np.array([values["force"] * np.sqrt(np.mean(np.exp(-2 * (speeds / values["speed"]) ** 2)))])
    scale = truth.get("scale", {})
    left_out = {"sign", "rest", "time"} if len(values) > 1 else set()
    return np.array([values[k] * scale.get(k, 1.0) for k in sorted(values) if k not in left_out])


def size_error(truth: dict[str, Any], cause: dict[str, Any], old: dict[str, Any] | None) -> float:
    """Relative error of a cause's size, what the twin has of it subtracted."""
    if not truth["parameters"]:
        return float("nan")
    real, found, before = (vector(v, truth) for v in (truth["parameters"], _values(cause), _values(old)))
    if len(found) != len(real):
        return float("nan")
    return float(np.linalg.norm(found - before - real) / np.linalg.norm(real))


def _inside(truth: dict[str, Any], cause: dict[str, Any]) -> list[bool]:
    """For each parameter with a standard deviation: whether the truth lies in its 90 % interval."""
    given = {k: p for k, p in cause["parameters"].items() if p.get("std") and k in truth["parameters"]}
    return [abs(p["value"] - truth["parameters"][k]) < 1.645 * p["std"] for k, p in given.items() if k != "sign"]


def digest(*words: object) -> int:
    """A seed made of words, the same in every process."""
    return int.from_bytes(hashlib.sha256(" ".join(map(str, words)).encode()).digest()[:4], "little")


def commit() -> str:
    """The commit of this checkout, marked where files differ from it."""
    root = Path(__file__).resolve().parent
    said = subprocess.run(["git", "-C", str(root), "describe", "--always", "--dirty"], capture_output=True, text=True)
    return said.stdout.strip() or "unknown"


def default_command() -> str:
    """The project's own command, by this interpreter."""
    return COMMAND.replace("figaroh-jax", f"{shlex.quote(sys.executable)} -m figaroh_jax")
