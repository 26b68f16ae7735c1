"""The command `figaroh-jax`: a thin layer that reads arguments, sets JAX up and turns errors into messages.

Exit status: 0 the job ran, 1 a verdict failed (`verify`) or a limit is not met (`excite`), 2 the input is wrong (one
message on standard error), 70 a fault of the program itself, 130 interrupted, 143 asked to end (SIGTERM).
"""

from __future__ import annotations

import argparse
import atexit
import gc
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from importlib import resources
from pathlib import Path
from typing import Any

from .errors import InputError

__all__ = ["main"]

# The matrices are small: more threads wait for each other, at three times the CPU seconds. A GPU, whose memory another
# program may hold, takes twice as long as the CPU beside it. What the user sets stays.
_MACHINE = {
    "JAX_PLATFORMS": "cpu",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
_TASKS = {  # commands that take a task file
    "diagnose": "the main job, on your own task file",
    "identify": "fit the dynamics: links, friction, intervals",
    "calibrate": "fit the kinematics from measured poses or points",
    "excite": "design the most informative motion within limits",
}
_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8  # of glibc's mallopt
_NEW_OBJECTS = 400_000  # between two searches of Python for circles of objects that nobody holds
_READING = 0.03  # of a command's work, for the progress bar
_OTHERS = ("verify", "compare", "list", "new", "migrate", "view")  # commands before and after a run
_DESCRIPTION = "Name what a robot's simulation gets wrong, extend the model with it and measure the gain."


_STATUS = (
    "Exit status: 0 the job ran, whatever it found; 1 a limit failed (verify) or is not met (excite); 2 the input is"
    " wrong; 70 a fault of the program; 130 interrupted; 143 asked to end."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (default: the process's own) and return its exit status."""
    try:
        args = _parser().parse_args(argv)
    except SystemExit as asked:  # --help, or wrong usage, which argparse has explained
        return asked.code if isinstance(asked.code, int) else 2
    try:
        with _ended_by_signals():
            return _run(args)
    except KeyboardInterrupt:
        return 130
    except _Ended as ended:
        return 128 + ended.signal
    except Exception as error:
        return _explain(error, args.traceback)


class _Ended(BaseException):
    """The system asks the process to end; what is half-written is cleaned up on the way out."""

    def __init__(self, signal: int) -> None:
        self.signal = signal


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP are raised as `_Ended`, in the main thread, where nobody handles them otherwise."""
    taken = {}

    def end(number: int, frame: Any) -> None:
        raise _Ended(number)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                taken[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, before in taken.items():
            signal.signal(number, before)


def _keep_freed_memory() -> None:
    """Have the C library keep the memory of arrays that are gone for those that follow.

    glibc gives each large array back to the system, which clears every page of the next one: with ten minutes of data
    that was a fifth of the CPU seconds. And JAX's threads take from the same memory as Python's: kept apart, each would
    hold what it once needed. Other C libraries do as they do.
    """
    if sys.platform.startswith("linux"):
        import ctypes

        with suppress(OSError, AttributeError):
            set_option = ctypes.CDLL(None).mallopt
            set_option(_MMAP_MAX, 0)
            set_option(_TRIM_THRESHOLD, 2**31 - 1)
            set_option(_ARENA_MAX, 1)


def _drop_standard_output() -> None:
    """What Python would still write at exit goes nowhere."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(args: argparse.Namespace) -> int:
    for name, value in _MACHINE.items():
        os.environ.setdefault(name, value)
    _keep_freed_memory()
    gc.set_threshold(_NEW_OBJECTS)  # what imports make lives on: with Python's 700 the searches take .2 s of a run
    atexit.register(gc.freeze)  # and .1 s more at the end, where the system takes all memory back
    if args.command in _OTHERS:
        from .jobs import tools

        shown = io.StringIO()  # first the verdict, then the text: a reader that has gone changes no exit status
        with redirect_stdout(shown):
            status = getattr(tools, args.command)(args)
        _write_out(shown.getvalue())
        return status
    if args.command == "rerun":
        args = _again(args)
    task = args.task if args.command in _TASKS else None
    if task is not None:
        from .formats.taskfile import read_task

        read_task(task)  # a file that is missing or no YAML is told before two seconds of imports
    _set_up_jax(cache=not args.no_cache)
    if args.command == "export":
        from .jobs.export import export_loop

        _write_out(export_loop(args.task, args.simulator, args.out))
        return 0
    if args.command == "simulate":
        return _simulate(args)
    return _run_job(args)


def _run_job(args: argparse.Namespace) -> int:
    """A command that writes a run directory: the work, then what is said about it."""
    from .jobs.commands import COMMANDS
    from .jobs.run import REPORT
    from .recordings.progress import listener
    from .reporting import terminal, wording

    if args.command == "excite" and args.task is None:
        args.task = _task_of_run(args.of_run)
    command = COMMANDS["diagnose" if args.command == "demo" else args.command]
    with resources.as_file(resources.files("figaroh_jax") / "demo") as demo:
        task_file = args.task or demo / "task.yaml"
        out = args.out or Path(f"{args.task.stem if args.task else 'demo'}_{command.noun}")
        with terminal.Progress(quiet=args.quiet) as progress:
            listener.set(lambda phase, share: progress(phase, _READING * share))
            done = command.run(task_file, out, progress, args.backend, **_own_options(args))
    with _standard_output():
        if args.json:
            sys.stdout.write(done.to_json())
        else:
            done.show(args.verbose)
            print(wording.fitted(f"Report: {out / REPORT}"))
    if done.failure is None:
        return 0
    print(f"figaroh-jax: limit not met: {_one_line(done.failure)}", file=sys.stderr)
    return 1


def _simulate(args: argparse.Namespace) -> int:
    from .jobs.simulation import simulate
    from .reporting import terminal

    folder = args.task.resolve()
    out = args.out or Path(f"{(folder.parent if folder.name == 'model' else folder).name}_simulation")
    with terminal.Progress(quiet=args.quiet) as progress:
        columns = args.columns.split(",") if args.columns else ()
        own = {"interpolate": args.interpolate, "start": args.start, "columns": columns, "rate": args.rate}
        done = simulate(args.task, args.file, out, progress, **own)
    with _standard_output():
        if args.json:
            sys.stdout.write(done.to_json())
        else:
            done.show(args.verbose)
            print(f"Motion: {out / 'simulation.csv'}")
            print(f"Report: {out / 'report.html'}")
    return 0


def _write_out(text: str) -> None:
    if sys.stdout.isatty():
        from .reporting.wording import fitted

        text = fitted(text)
    with _standard_output():
        sys.stdout.write(text)


@contextmanager
def _standard_output() -> Iterator[None]:
    """Standard output that may end early (`| head`) or refuse; by then the run is written."""
    with suppress(AttributeError):
        sys.stdout.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
        sys.stdout.flush()
    except (BrokenPipeError, SystemExit):  # rich turns the one into the other
        _drop_standard_output()
    except OSError as error:
        _drop_standard_output()
        raise InputError(f"the summary cannot be written to standard output: {error.strerror or error}") from None


def _again(args: argparse.Namespace) -> argparse.Namespace:
    """The arguments of the command that made a run, for another directory."""
    from .jobs.tools import command_of

    command = command_of(args.run)
    out = args.out or args.run.with_name(f"{args.run.resolve().name}_again")
    flags = [flag for flag in ("json", "verbose", "quiet", "traceback", "no_cache") if getattr(args, flag)]
    return _parser().parse_args([*command, "--out", str(out), *(f"--{flag.replace('_', '-')}" for flag in flags)])


def _task_of_run(run: Path | None) -> Path:
    """The task file of a finished run."""
    from .jobs.tools import command_of

    if run is None:
        raise InputError("excite needs a TASK.yaml, or --from with the run directory of a diagnosis")
    return Path(command_of(run)[1])


def _own_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options that one command alone has."""
    if args.command == "excite":
        return {"of_run": args.of_run}
    return {"level": args.level, "priors": args.priors} if args.command == "calibrate" else {}


def _explain(error: Exception, with_traceback: bool) -> int:
    wrong_input = isinstance(error, (InputError, OSError))
    if with_traceback:
        traceback.print_exception(error)
    kind = "error" if wrong_input else f"internal error: {type(error).__name__}"
    hint = "" if wrong_input or with_traceback else " (--traceback shows where; please report it)"
    text = _one_line(str(error))
    with suppress(OSError):
        print(f"figaroh-jax: {kind}: {text}{hint}", file=sys.stderr)
    return 2 if wrong_input else 70


def _one_line(text: str) -> str:
    """The text on one line, nothing in it that a terminal would act on."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))
    return line if len(line) <= 4000 else f"{line[:3000]} ... {line[-900:]}"


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--out", type=Path, metavar="DIR", help="run directory; an earlier run there is replaced")
    common.add_argument("--json", action="store_true", help="print the answer as JSON instead of the summary")
    common.add_argument("--verbose", action="store_true", help="show the notes in full instead of their number")
    common.add_argument("--quiet", action="store_true", help="no progress on standard error")
    common.add_argument("--traceback", action="store_true", help="show where an error was raised")
    common.add_argument(
        "--backend",
        default="native",
        metavar="NAME",
        help="simulator of the rigid body: native (default), mujoco, pinocchio, mjx or any other that is installed",
    )
    common.add_argument("--no-cache", action="store_true", help="keep no compiled programs for the next run")
    parser = argparse.ArgumentParser(prog="figaroh-jax", description=_DESCRIPTION, epilog=_STATUS)
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, explained in _TASKS.items():
        command = commands.add_parser(name, parents=[common], help=explained)
        command.add_argument("task", type=Path, metavar="TASK.yaml", nargs="?" if name == "excite" else None)
        if name == "excite":
            of_run = "a finished diagnosis: design the motion that resolves its ambiguities"
            command.add_argument("--from", dest="of_run", type=Path, metavar="RUN_DIR", help=of_run)
        if name == "calibrate":
            command.add_argument("--level", help="frames, joint_offset or full, in place of what predicts best")
            command.add_argument("--no-priors", dest="priors", action="store_false", help="plain least squares")
    again = commands.add_parser("rerun", parents=[common], help="repeat the command that made a run directory")
    again.add_argument("run", type=Path, metavar="DIR")
    _add_tools(commands)
    export = commands.add_parser("export", help="write a rollout's model for a simulator")
    export.add_argument("--out", type=Path, metavar="DIR", help="write it there too, beside what the folder holds")
    export.add_argument("--traceback", action="store_true", help="show where an error was raised")
    for unused in ("--json", "--quiet", "--verbose", "--no-cache"):  # what is printed is JSON, and nothing else
        export.add_argument(unused, action="store_true", help=argparse.SUPPRESS)
    export.add_argument("--backend", help=argparse.SUPPRESS)
    export.add_argument("task", type=Path, metavar="MODEL_DIR", help="a run directory, or `model` in it")
    export.add_argument("--for", dest="simulator", required=True, metavar="NAME", help="mujoco, newton, isaaclab, ...")
    moved = commands.add_parser("simulate", help="move a run's model by the commands of a file")
    moved.add_argument("task", type=Path, metavar="MODEL_DIR", help="a run directory, or its `model`")
    moved.add_argument("--command", dest="file", type=Path, required=True, metavar="FILE", help="time and commands")
    moved.add_argument("--columns", metavar="NAME,...", help="columns of the commands, or their one array")
    moved.add_argument("--rate", type=float, metavar="HZ", help="rate of a file that has no time column")
    moved.add_argument("--interpolate", action="store_true", help="join the rows by lines instead of holding each")
    moved.add_argument("--start", metavar="JOINT=VALUE,...", help="start (rad, m) in place of FILE's positions")
    moved.add_argument("--out", type=Path, metavar="DIR", help="run directory; an earlier run there is replaced")
    moved.add_argument("--json", action="store_true", help="print the answer as JSON instead of the summary")
    moved.add_argument("--quiet", action="store_true", help="no progress on standard error")
    moved.add_argument("--traceback", action="store_true", help="show where an error was raised")
    moved.add_argument("--no-cache", action="store_true", help="keep no compiled programs for the next run")
    moved.add_argument("--verbose", action="store_true", help=argparse.SUPPRESS)
    demo = commands.add_parser("demo", parents=[common], help="the main job on an embedded recording, no file needed")
    demo.set_defaults(task=None)
    return parser


def _add_tools(commands: Any) -> None:
    """Commands before and after a run."""
    tool = argparse.ArgumentParser(add_help=False)
    tool.add_argument("--json", action="store_true", help="print JSON instead of the table")
    tool.add_argument("--traceback", action="store_true", help="show where an error was raised")
    new = commands.add_parser("new", parents=[tool], help="draft a task file from a model and recordings")
    new.add_argument("model", type=Path, metavar="MODEL")
    new.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    new.add_argument("--out", type=Path, metavar="TASK.yaml", help="default: the draft is printed")
    new.add_argument("--joints", help="comma-separated joints of the columns, in their order")
    new.add_argument("--passive", help="comma-separated joints that nothing drives: their torque is zero")
    new.add_argument("--rate", type=float, metavar="HZ", help="rate of recordings that have no time column")
    new.add_argument("--constants", help="comma-separated N m per unit of the torque columns, in the joints' order")
    new.add_argument("--gears", help="comma-separated motor turns per joint turn, where positions are those of motors")
    new.add_argument(
        "--unit", choices=("rad", "deg", "m", "mm"), help="unit of the positions, where the recording does not show it"
    )
    new.add_argument("--topic", metavar="NAME", help="topic of bags that hold several topics of joints")
    new.add_argument("--kp", help="comma-separated gains of position servos (N m/rad), for a command without torque")
    new.add_argument("--interactive", action="store_true", help="ask for what the recordings cannot decide")
    migrate = commands.add_parser("migrate", parents=[tool], help="a configuration of FIGAROH as a task file")
    migrate.add_argument("config", type=Path, metavar="CONFIG.yaml")
    migrate.add_argument("model", type=Path, metavar="MODEL")
    migrate.add_argument("recordings", type=Path, nargs="*", metavar="RECORDING")
    migrate.add_argument(
        "--job", choices=("identify", "calibrate"), help="of a configuration of both; default: identify"
    )
    migrate.add_argument("--out", type=Path, metavar="TASK.yaml", help="default: the task is printed")
    verify = commands.add_parser("verify", parents=[tool], help="pass or fail of a finished run; exit status 1 on fail")
    verify.add_argument("run", type=Path, metavar="DIR")
    verify.add_argument(
        "--limits", type=Path, metavar="LIMITS.yaml", help="default: named, consistent, exported exactly"
    )
    verify.add_argument("--junit", type=Path, metavar="FILE", help="write the checks as JUnit XML too")
    compare = commands.add_parser("compare", parents=[tool], help="runs side by side; the first is the reference")
    compare.add_argument("runs", type=Path, nargs="+", metavar="DIR")
    compare.add_argument("--out", type=Path, metavar="FILE.html", help="write a page with overlays too")
    compare.add_argument("--units", metavar="A,A,B,B", help="robot of each run: what differs between robots and days")
    shown = "the robot of a run in a browser, with the named joints in colour; a design or simulation moving"
    view = commands.add_parser("view", help=shown)
    view.add_argument("--traceback", action="store_true", help="show where an error was raised")
    view.add_argument("run", type=Path, metavar="DIR")
    view.add_argument("--port", type=int, default=8080, help="of the address http://localhost:PORT (default 8080)")
    listing = commands.add_parser("list", parents=[tool], help="the runs below a folder, in a table")
    listing.add_argument("folder", type=Path, nargs="?", default=Path(), metavar="FOLDER")


def _version() -> str:
    from . import __version__

    return f"figaroh-jax {__version__}"


def _set_up_jax(cache: bool) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
    else:
        from .compiled.executable_cache import keep_programs

        keep_programs()


if __name__ == "__main__":
    sys.exit(main())
