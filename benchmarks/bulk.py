"""The diagnosis's studies in one pool of processes, the heaviest first, so that a lent machine is full until it goes.

    python -m benchmarks.bulk --out RESULTS --seed 0 --jobs 30 --seconds 500        # all studies
    python -m benchmarks.bulk --out RESULTS --seed 0 --only real closed_loop        # those whose name holds a word

Cases are made while the first of them are run. RESULTS/<study> holds `cases.json` and, under `runs`, every answer as it
comes; what has an answer is not run again. At the end, or later, `--score` prints the tables of all that ran.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from . import blackbox
from .hide_and_name.scoring import score as score_made
from .hide_in_real.scoring import score as score_real
from .served import Server

REAL = ("ur10e", "kuka", "panda", "tx40", "tiago", "dfki_simple_pendulum", "dfki_double_pendulum")
LIMIT = 400.0  # s of a call
MAKERS = 3  # processes that make the cases of a study, at the least
COMMAND = f"{blackbox.HERE} figaroh_jax.cli:main diagnose {{task}} --out {{out}} --quiet"  # in processes that stay


class Due(NamedTuple):
    """A call, when it is due (the lower, the sooner), and what its programs are shared with."""

    when: float
    place: int
    like: str
    call: Callable[[Server], str]


class Study(NamedTuple):
    """Cases that one command makes, and when each is due: None, never; the lower, the sooner."""

    name: str
    module: str
    made: tuple[str, ...]
    due: Callable[[dict[str, Any], bool], float | None]  # of a case; whether its truth is forbidden
    made_at: float = -1.0  # when its cases are made


def studies(seed: int) -> list[Study]:
    """All of them, with seeds of their own."""
    real = [
        Study(f"real_{r}", "hide_in_real", ("--seed", str(seed), "--sizes", "0.1", "0.2", "--robots", r), _due_real)
        for r in REAL
    ]
    made = {
        "closed_loop": ("closed_loop", 40, (), _due_closed_loop),
        "inverse_hidden": ("inverse", 0, ("0.05-", "0.15-", "0.02-"), _due_inverse),
        **{f"inverse_clean_{k}": ("inverse", 50, ("/clean",), _due_inverse) for k in range(4)},
        "kinematic": ("kinematic", 60, (), _due_kinematic),
    }
    others = [
        Study(
            name,
            "hide_and_name",
            ("--seed", str(seed + 1 + k), "--kinds", kind, "--clean", str(clean)) + (("--only", *only) if only else ()),
            due,
            {"closed_loop": -1.0, "inverse": 3.7, "kinematic": 5.9}[kind],
        )
        for k, (name, (kind, clean, only, due)) in enumerate(made.items())
    ]
    return [*real, *others]


def _due_real(case: dict[str, Any], forbidden: bool) -> float | None:
    heavy = 0.0 if case["group"] in ("ur10e", "kuka") else 0.1
    if not case["truth"]:
        return heavy - 0.05 if not forbidden else None  # twins of forbidden cases come with these
    if not case["visible"]:
        return None
    if not forbidden:
        return heavy
    return 0.5 + heavy if case["size"] > 0.15 else 0.7 + heavy


def _due_closed_loop(case: dict[str, Any], forbidden: bool) -> float | None:
    if not case["truth"]:
        return None if forbidden else 1.1
    return 1.2 if forbidden else 1.0


def _due_inverse(case: dict[str, Any], forbidden: bool) -> float | None:
    if case["family"] == "clean":
        return None if forbidden else 5.0
    if 0.03 < case["size"] < 0.1:
        return None if forbidden else 3.8
    if forbidden:  # of the large ones: whether they are told apart from what is left of the catalogue
        return 4.1 if case["size"] > 0.1 else None
    return 7.0 if case["size"] > 0.1 else 7.1


def _due_kinematic(case: dict[str, Any], forbidden: bool) -> float | None:
    return None if forbidden else 6.0


def main() -> None:
    """Run what is asked for, then tell how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=500.0, help="after which no further call begins")
    parser.add_argument("--grace", type=float, default=40.0, help="s that calls then have to end")
    parser.add_argument("--cases", type=Path, help="folder of the cases' recordings (default: --out)")
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--before", type=float, default=100.0, help="leaves out what is due at this or later")
    parser.add_argument("--score", action="store_true", help="only the tables")
    args = parser.parse_args()
    kept = [s for s in studies(args.seed) if not args.only or any(word in s.name for word in args.only)]
    sets = [r for r in REAL if not args.only or any(word in ("real_sets", r) for word in args.only)]
    if not args.score:
        Pool(args, kept, sets).run()
    _tell(args.out)


class Pool:
    """Generators, calls and what is due next."""

    def __init__(self, args: argparse.Namespace, kept: list[Study], sets: list[str]) -> None:
        self.args, self.end, self.studies = args, time.monotonic() + args.seconds, max(len(kept), 1)
        self.due: list[Due] = []
        self.count, self.busy, self.changed = 0, 0, threading.Condition()
        for study in kept:
            self.add(study.made_at, "", lambda server, s=study: self.made(s))
        for name in sets:
            self.add(9.0, name, lambda server, n=name: self.real_set(n))

    def add(self, when: float, like: str, call: Callable[[Server], str]) -> None:
        """A call that is due: those of the same time in the order they came, what is `like` the last one first."""
        with self.changed:
            self.count += 1
            self.due.append(Due(when, self.count, like, call))
            self.changed.notify()

    def run(self) -> None:
        """Until nothing is due or the time is over."""
        threads = [threading.Thread(target=self.work, daemon=True) for _ in range(self.args.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def work(self) -> None:
        """One call after another, in a process of its own."""
        server, last = Server(), ""
        while (due := self.taken(last)) is not None:
            try:
                said = due.call(server)
            except Exception as error:  # the others go on
                said = f"{due.like}: {error!r}"
            last = due.like
            print(f"[{time.monotonic() - self.end + self.args.seconds:.0f} s] {said}", flush=True)
            with self.changed:
                self.busy -= 1
                self.changed.notify_all()
        server.end()

    def taken(self, last: str) -> Due | None:
        """What is due next for a process whose last call was of that kind; None at the end."""
        with self.changed:
            while not self.due and self.busy and time.monotonic() < self.end:
                self.changed.wait(1.0)
            if not self.due or time.monotonic() >= self.end:
                return None
            one = min(self.due, key=lambda d: (d.when, d.like != last, d.place))
            self.due.remove(one)
            self.busy += 1
            return one

    def left(self) -> float:
        """Seconds that a call may take."""
        return max(1.0, min(LIMIT, self.end + self.args.grace - time.monotonic()))

    def folder(self, study: Study) -> Path:
        return (self.args.cases or self.args.out) / study.name

    def made(self, study: Study) -> str:
        """Makes the cases of a study and puts their calls into the queue."""
        folder, kept = self.folder(study), self.args.out / study.name
        folder.mkdir(parents=True, exist_ok=True)
        kept.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, "-m", f"benchmarks.{study.module}", "generate", "--cases", str(folder), *study.made]
        if study.module == "hide_and_name":
            words += ["--jobs", str(max(MAKERS, self.args.jobs // self.studies))]
        ran = subprocess.run(words, capture_output=True, text=True)
        if ran.returncode:
            return f"{study.name}: no cases\n{ran.stderr[-1500:]}"
        (kept / "cases.json").write_text((folder / "cases.json").read_text())
        cases = blackbox.load_cases(folder)
        jobs: dict[blackbox.Job, float] = {}
        for name, case in cases.items():
            for forbid in ((), tuple(case.get("forbid", ()))):
                when = study.due(case, bool(forbid))
                if when is None or (forbid and not case["truth"]):
                    continue
                for needed in (name, case["twin"]) if "twin" in case else (name,):
                    job = blackbox.Job(needed, forbid)
                    jobs[job] = min(when, jobs.get(job, when))
        jobs = {j: w for j, w in jobs.items() if w < self.args.before}
        for job, when in jobs.items():
            if not (kept / "runs" / job.folder / "run.json").is_file():
                like = f"{study.name} {cases[job.case]['model']}" if study.name.startswith("real_") else study.name
                self.add(when, like, lambda server, j=job: self.called(server, study, cases[j.case], j))
        return f"{study.name}: {len(cases)} cases, {len(jobs)} calls"

    def called(self, server: Server, study: Study, case: dict[str, Any], job: blackbox.Job) -> str:
        """One call of the tool; one that the end of the time stops is no answer."""
        runs = self.args.out / study.name / "runs"
        return server.call(self.folder(study), runs, case, job, COMMAND, self.left())

    def real_set(self, name: str) -> str:
        """The untouched recordings of a robot, beside `identify`."""
        out = self.args.out / "real_sets"
        out.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, "-m", "benchmarks.real", "--only", name, "--out", str(out / f"{name}.json")]
        try:
            ran = subprocess.run(words, capture_output=True, text=True, timeout=self.left())
        except subprocess.TimeoutExpired:
            return f"real set {name}: not finished"
        (out / f"{name}.txt").write_text(ran.stdout + ran.stderr[-1500:])
        return f"real set {name}: done"


def _tell(out: Path) -> None:
    """The tables of all studies that have answers."""
    cases: dict[str, dict[str, Any]] = {}
    for file in sorted(out.glob("real_*/cases.json")):
        cases |= {f"{file.parent.name}/runs/{n}": c for n, c in blackbox.load_cases(file.parent).items()}
    if cases:
        for name, case in cases.items():
            if "twin" in case:
                case["twin"] = f"{name.split('/runs/')[0]}/runs/{case['twin']}"
        print(score_real(cases, out, ["named", "forbidden"]))
        (out / "results.json").rename(out / "real.json")
    for name in ("closed_loop", "inverse", "kinematic"):
        made: dict[str, dict[str, Any]] = {}
        for file in sorted(out.glob(f"{name}*/cases.json")):
            for case in blackbox.load_cases(file.parent).values():
                case["name"] = f"{file.parent.name}/runs/{case['name']}"
                made[case["name"]] = case
        if made:
            print(f"\n{name}:", score_made(made, out, ["named", "forbidden"]))
            (out / "results.json").rename(out / f"{name}.json")
    for file in sorted(out.glob("real_sets/*.txt")):
        print(file.read_text())


if __name__ == "__main__":
    main()
