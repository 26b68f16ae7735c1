"""Commands before and after a run: `new`, `verify`, `compare`, `list`, `view`, and what `rerun` runs again.

Each function takes the parsed arguments, prints and gives the exit status.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..reporting.provenance import read_provenance
from ..reporting.run_directory import write_file

if TYPE_CHECKING:
    from ..recordings.dataset import Driven
    from ..recordings.draft import Draft

__all__ = ["command_of", "compare", "list", "migrate", "new", "verify", "view"]


def new(args: argparse.Namespace) -> int:
    """Draft a task file, on standard output or where `--out` says."""
    from ..recordings.draft import draft_task

    if args.out is not None and args.out.exists():
        raise InputError(f"--out {args.out}: exists already; a draft replaces no file")

    def drafted() -> Draft:
        joints = None if args.joints is None else [name.strip() for name in args.joints.split(",")]
        if args.rate is not None and not 0 < args.rate < float("inf"):
            raise InputError(f"--rate {args.rate}: expected a positive number of Hz")
        constants, gains = _numbers(args.constants, "--constants"), _numbers(args.kp, "--kp")
        known = {"rate": args.rate, "unit": args.unit, "topic": args.topic, "constants": constants, "gains": gains}
        known |= {"gears": _numbers(args.gears, "--gears"), "folder": args.out and args.out.parent}
        known["passive"] = [name.strip() for name in args.passive.split(",")] if args.passive else ()
        return draft_task(args.model, args.recordings, joints=joints, drives=drives, **known)

    def drives(joints: Sequence[str]) -> tuple[Driven, ...]:
        from ..rollouts.reading import driven_joints, load_loop

        return driven_joints(load_loop(args.model, joints=joints)[0])

    draft = _asked(args, drafted) if args.interactive else drafted()
    if args.json:
        print(json.dumps(draft._asdict(), indent=2, ensure_ascii=False))
    elif args.out is None:
        print(draft.text, end="")
    if args.out is not None:
        write_file(args.out, draft.text, "--out")
        if not args.json:
            print("\n".join([*(f"assumed: {line}" for line in draft.assumed), f"Task: {args.out}"]))
    return 0


def migrate(args: argparse.Namespace) -> int:
    """Translate a configuration of FIGAROH, and say what became of each of its keys."""
    from ..recordings.migration import migrate as translated

    if args.out is not None and args.out.exists():
        raise InputError(f"--out {args.out}: exists already; a translation replaces no file")
    found = translated(args.config, args.model, args.recordings, job=args.job)
    if args.out is not None:
        write_file(args.out, found.text, "--out")
    if args.json:
        print(json.dumps(found._asdict(), indent=2, ensure_ascii=False))
    elif args.out is None:
        print(found.text, end="")
    else:
        print("\n".join([*found.keys, f"Task: {args.out}"]))
    return 0


def _asked(args: argparse.Namespace, drafted: Callable[[], Draft]) -> Draft:
    """The draft, once the user has answered what the recordings cannot decide; an empty answer gives up."""
    from ..recordings.draft_columns import Undecided

    while True:
        try:
            return drafted()
        except Undecided as question:
            print(f"{question}\n--{question.option} = ", end="", file=sys.stderr, flush=True)
            answer = sys.stdin.readline().strip()
            if not answer:
                raise
            try:
                setattr(args, question.option, _answered(question.option, answer))
            except InputError as error:  # a slip costs none of the answers before it
                print(f"{error}", file=sys.stderr)


def _answered(option: str, answer: str) -> str | float:
    """An answer as the option holds it; raises `InputError` for one that cannot be meant."""
    if option in ("constants", "kp", "gears"):
        _numbers(answer, f"--{option}")
    if option == "unit" and answer not in ("rad", "deg", "m", "mm"):
        raise InputError(f"--unit {answer}: expected rad, deg, m or mm")
    try:
        return float(answer) if option == "rate" else answer
    except ValueError:
        raise InputError(f"--rate {answer}: expected a positive number of Hz") from None


def _numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    try:
        return None if text is None else tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option} {text}: expected numbers with commas between them") from None


def verify(args: argparse.Namespace) -> int:
    """One line a limit; 1 where one fails."""
    from ..formats.config import Limits, load_limits
    from ..reporting.verification import DEFAULT_LIMITS, JUNIT, junit, verify as judged

    limits = load_limits(args.limits) if args.limits else Limits.model_validate(DEFAULT_LIMITS)
    checks = judged(args.run, limits)
    if args.junit:
        write_file(args.junit, junit(args.run.resolve(), checks), "--junit", JUNIT)
    if args.json:
        print(json.dumps([check._asdict() for check in checks], indent=2, ensure_ascii=False))
    else:
        print("\n".join(check.line for check in checks) or "no limit is set")
    return int(any(check.status == "fail" for check in checks))


def compare(args: argparse.Namespace) -> int:
    """Tables of all runs, and a page of them where `--out` names one."""
    from ..reporting.side_by_side import PAGE, compare_runs, comparison_page, comparison_text

    if len(args.runs) < 2:
        raise InputError("compare: one run directory is given; expected two or more, the first is the reference")
    sections = compare_runs(args.runs, args.units.split(",") if args.units else None)
    if args.out:
        write_file(args.out, comparison_page(args.runs, sections), "--out", PAGE)
    _print(sections, args.json, comparison_text(sections))
    if args.out and not args.json:
        print(f"\nPage: {args.out}")
    return 0


def view(args: argparse.Namespace) -> int:
    """The robot of a run in a browser, until the command is interrupted; of a design or a simulation its motion."""
    from ..reporting.motion_view import is_design, is_simulation, show_design_run, show_simulation_run
    from ..reporting.robot_view import show_run

    if not 0 < args.port < 65536:
        raise InputError(f"--port {args.port}: expected a number from 1 to 65535")
    moving = show_design_run if is_design(args.run) else show_simulation_run if is_simulation(args.run) else None
    server = show_run(args.run, args.port) if moving is None else moving(args.run, args.port)[0]
    print(f"The robot of {args.run}: http://localhost:{args.port} (Ctrl-C ends)", file=sys.stderr, flush=True)
    try:
        server.sleep_forever()
    finally:
        server.stop()
    return 0


def list(args: argparse.Namespace) -> int:
    """The runs below a folder."""
    from ..reporting.side_by_side import comparison_text, list_runs

    if not args.folder.is_dir():
        raise InputError(f"{args.folder} is not a directory")
    section = list_runs(args.folder)
    _print((section,), args.json, comparison_text([section]) if section.rows else f"no run below {args.folder}")
    return 0


def command_of(folder: Path) -> tuple[str, ...]:
    """The command line that made the run in `folder`, without `--out`; raises `InputError` where that is not said."""
    made = read_provenance(folder)
    options = [*made["options"]]
    if made["command"] not in _RUNS or not _own_options(options, _RUNS[made["command"]]):
        said = " ".join([made["command"], *options])[:200]
        raise InputError(f"{folder}: its provenance.json names a command that makes no run: {said}")
    if made["command"] == "simulate" and not Path(made["task"]).is_dir():
        raise InputError(f"{folder}: its model {made['task']} is not there any more; the motion is in simulation.csv")
    if made["command"] != "simulate" and not Path(made["task"]).is_file():
        raise InputError(f"{folder}: its task {made['task']} is not there any more; its text is in provenance.json")
    return (str(made["command"]), str(made["task"]), *options)


_OPTIONS = {"--backend": 1}
# commands of runs, with the options that they are said to have had, and how many words each takes
_RUNS: dict[str, dict[str, int]] = {
    "diagnose": _OPTIONS,
    "identify": _OPTIONS,
    "calibrate": _OPTIONS | {"--level": 1, "--no-priors": 0},
    "excite": _OPTIONS | {"--from": 1},
    "simulate": {"--command": 1, "--columns": 1, "--rate": 1, "--interpolate": 0, "--start": 1},
}


def _own_options(options: Sequence[str], known: Mapping[str, int]) -> bool:
    """Whether the words are options that a run writes into its provenance, and nothing else."""
    waiting = [*options]
    while waiting:
        count = known.get(waiting.pop(0))
        if count is None or any(word.startswith("-") for word in waiting[:count]) or len(waiting) < count:
            return False
        del waiting[:count]
    return True


def _print(sections, as_json: bool, text: str) -> None:
    print(json.dumps([section._asdict() for section in sections], indent=2, ensure_ascii=False) if as_json else text)
