"""Commands killed at random moments, and every call by which they write refused once: the old or the new run is there.

    python benchmarks/kills.py                       # 200 kills, 50 refusals of each kind of call that writes
    python benchmarks/kills.py --kills 20 --failures 2

A folder holds a task with its files, things of the user's beside them, and an earlier run. Each kill is a fresh process
that runs one command and gets SIGKILL, SIGTERM or SIGINT at a random moment; each failure is a command in which one of
the calls that open, write, synchronise, rename, make or remove something raises (no space, input/output error,
interrupted call, Ctrl-C). After each, the checksums of all that is the user's are as before, the run directory is the
earlier run or the new one, whole, and every single file is absent or whole. What a killed process leaves hidden is gone
once each command has run again. What the commands compute is computed once, before; the rest is as ever.
"""

from __future__ import annotations

import argparse
import builtins
import contextlib
import errno
import hashlib
import io
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
COMMANDS = (
    "diagnose",
    "identify",
    "calibrate",
    "excite",
    "demo",
    "rerun",
    "verify",
    "compare",
    "list",
    "new",
    "export",
)
LINES = {  # of the commands that take no task
    "rerun": ["runs/kept", "--out", "runs/out", "--quiet"],
    "verify": ["runs/out"],
    "compare": ["runs/out", "runs/kept", "--out", "runs/page.html"],
    "list": ["runs"],
    "new": ["robot.urdf", "run1.npz", "--joints", "shoulder,elbow,slide", "--out", "runs/task.yaml"],
    "export": ["loop", "--for", "mujoco", "--out", "runs/exported"],
}
EXCITE = """robot: {model: robot.urdf}
excite: {basis: {quintic: 3}, duration: 2, starts: 1, limits: {acceleration: 7}, noise: 0.02}
"""
TASKS = {"calibrate": "poses.yaml", "excite": "excite.yaml"}  # those of the other commands: task.yaml
ENDS = {"page.html": "</html>\n", "task.yaml": "\n", "mujoco.json": "}\n", "robot.xml": "</mujoco>\n"}
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
ERRORS: tuple[Callable[[], BaseException], ...] = (
    lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    lambda: OSError(errno.EIO, os.strerror(errno.EIO)),
    lambda: InterruptedError(errno.EINTR, os.strerror(errno.EINTR)),
    KeyboardInterrupt,
)


def prepare(folder: Path) -> None:
    """The user's folder: tasks, robot, recordings, things of the user's, and results to be written, computed once."""
    import fake_diagnosis
    import numpy as np
    import tasks

    from figaroh_jax.calibration.calibration import calibrate_task
    from figaroh_jax.effects.extended import extend
    from figaroh_jax.excitation.task import excite_task
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.identification.identification import identify_task

    tasks.write(folder)
    (folder / "source").mkdir()
    (folder / "source" / "main.c").write_text("int main(void) { return 0; }\n")
    (folder / "result.json").write_text('{"mine": true}\n')
    (folder / "thesis.tex").write_text("years of work\n" * 1000)
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0.2] + [0, 0, 0.25]
    points = rng.standard_normal((40, 3)) * 0.001 + q
    np.savez(folder / "poses.npz", q=q, p=points)
    poses = {
        "robot": {"model": "robot.urdf"},
        "data": [
            {
                "file": "poses.npz",
                "position": "q",
                "measurement": {"position": "p", "tool_frame": "tool0", "unknown": ["base_frame", "tool_frame"]},
            }
        ],
    }
    import yaml

    (folder / "poses.yaml").write_text(yaml.safe_dump(poses))
    from dataclasses import replace

    found: dict[str, Any] = {
        "diagnose": replace(fake_diagnosis.named(), model=extend(load_urdf(folder / "robot.urdf"))),
        "identify": identify_task(load_task(folder / "task.yaml")),
        "calibrate": calibrate_task(load_task(folder / "poses.yaml"), level="frames"),
    }
    (folder / "excite.yaml").write_text(EXCITE)
    found["excite"] = excite_task(load_task(folder / "excite.yaml"))
    demo = ROOT / "figaroh_jax" / "demo"
    found["demo"] = replace(fake_diagnosis.named(), model=extend(load_urdf(demo / "robot.urdf")))
    (folder.parent / "found.pickle").write_bytes(pickle.dumps(found))
    from generators import servo_arm

    from figaroh_jax.rollouts.reading import load_loop
    from figaroh_jax.rollouts.stored import add_loop

    (folder / "loop").mkdir()
    (folder / "loop" / "robot.xml").write_text(servo_arm.model_text())
    add_loop(folder / "loop", load_loop(folder / "loop" / "robot.xml")[0])
    _right_recording(folder / "run1.npz", found["diagnose"].model)
    (folder / "runs").mkdir()
    os.chdir(folder)
    assert command(folder, "diagnose", "runs/kept") == 0


def _right_recording(file: Path, model: Any) -> None:
    """The recording's torque as the model has it, so that a draft can be made of it."""
    import numpy as np

    import figaroh_jax as fj

    arrays = dict(np.load(file))
    acceleration = np.gradient(arrays["dq"], arrays["t"], axis=0)
    arrays["tau"] = np.asarray(fj.inverse_dynamics(model.robot, arrays["q"], arrays["dq"], acceleration))
    np.savez(file, **arrays)


def made_before(folder: Path, name: str) -> None:
    """What the command finds in the place of the single file that it writes: nothing, or an earlier page."""
    from figaroh_jax.reporting.side_by_side import PAGE

    for made in ("runs/task.yaml", "runs/exported/mujoco.json", "runs/exported/robot.xml"):
        (folder / made).unlink(missing_ok=True)
    if name == "compare":
        (folder / "runs" / "page.html").write_text(f"{PAGE}</html>\n")


def command(folder: Path, name: str, out: str = "runs/out") -> int:
    """One command in the user's folder; what it would compute is there."""
    from figaroh_jax import cli
    from figaroh_jax.jobs import diagnosis, excitation, identification, postures

    found = pickle.loads((folder.parent / "found.pickle").read_bytes())
    diagnosis.diagnose_task = lambda *args, **more: found["demo" if name == "demo" else "diagnose"]
    identification.identify_task = lambda *args, **more: found["identify"]
    excitation.excite_task = lambda *args, **more: found["excite"]
    postures.calibrate_task = lambda *args, **more: found["calibrate"]
    os.chdir(folder)
    if name in LINES:
        return cli.main([name, *LINES[name]])
    task = [] if name == "demo" else [TASKS.get(name, "task.yaml")]
    return cli.main([name, *task, "--out", out, "--quiet"])


def checksums(folder: Path) -> dict[str, str]:
    """What is the user's: everything but the run directory and hidden folders of runs beside it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if parts[0] != "runs":
            found["/".join(parts)] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def whole(out: Path) -> str | None:
    """The kind of run in the directory; None where it is not whole, or a single file beside it is not."""
    from figaroh_jax.reporting import marker, run_directory

    for path in (*out.parent.glob("*.*"), *(out.parent / "exported").glob("*")):
        if path.is_file() and path.name in ENDS and not path.read_text().endswith(ENDS[path.name]):
            return None
    if not out.is_dir() or marker.altered(out, run_directory._LEFT) is not None:
        return None
    names = {path.name for path in out.iterdir()}
    written = marker.written(out) or {}
    there = {"verification.json"}  # the marker lists it before it is there
    if set(written) - there - {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}:
        return None
    kinds = {"answer.json": "answer", "parameters.csv": "parameters", "excitation.json": "excitation"}
    return next((kind for file, kind in kinds.items() if file in names), "calibration")


def child(folder: Path, name: str, act: Callable[[], None] = lambda: None) -> int:
    """Fork a process that runs one command; its number. The parent has imported everything and computed nothing."""
    pid = os.fork()
    if pid:
        return pid
    with contextlib.suppress(BaseException):
        signal.signal(signal.SIGINT, signal.default_int_handler)
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (1, 2):
            os.dup2(null, stream)
        act()
        made_before(folder, name)
        os._exit(command(folder, name))
    os._exit(99)


def ended(pid: int, within: float) -> int | None:
    """Status of a process once it has ended; None where it has not within so many seconds."""
    end = time.monotonic() + within
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status
        time.sleep(0.002)
    return None


def kills(folder: Path, count: int, source: random.Random) -> Counter[str]:
    """Kill commands at random moments, most while they write; count what was found after each."""
    out, counted = folder / "runs" / "out", Counter[str]()
    before = checksums(folder)
    lasts = {}
    for name in COMMANDS:
        begin = time.monotonic()
        status = ended(child(folder, name), 600)
        assert name in LINES or whole(out), name
        assert status == 0, f"{name} ended with {status}"
        lasts[name] = time.monotonic() - begin
    number = 0
    while counted["killed"] < count and number < 5 * count:
        number += 1
        name = COMMANDS[number % len(COMMANDS)]
        old, before_it = whole(out), _hidden(out)
        pid = child(folder, name)
        moment = source.uniform(0, 0.9) * lasts[name]
        if number % 3:  # once it has begun to write, and a little later
            begin = time.monotonic()
            while time.monotonic() - begin < 2 * lasts[name] and _hidden(out) <= before_it:
                time.sleep(0.0005)
            moment = source.uniform(0, 0.25) * lasts[name]
        status = ended(pid, moment)
        number_of_signal = source.choice(SIGNALS)
        if status is None:
            os.kill(pid, number_of_signal)
            status = ended(pid, 60)
        if status is None:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            counted["did not end when asked to"] += 1
        new = whole(out)
        counted["killed" if status != 0 else "was done before"] += 1
        counted["run not whole"] += new is None
        counted["file of the user's touched"] += checksums(folder) != before
        counted["the other run is there"] += new != old
        litter = bool(_hidden(out) - before_it)
        counted["hidden things left by SIGKILL"] += litter and number_of_signal == signal.SIGKILL
        counted["hidden things left otherwise"] += litter and number_of_signal != signal.SIGKILL
        counted[name] += status != 0
    for left in out.parent.glob(".figaroh-jax-*"):
        os.utime(left, (0, 0))  # those that say nothing are removed after a minute
    for name in COMMANDS:
        assert ended(child(folder, name), 600) == 0, f"{name} after all kills"
    counted["hidden things left once all commands have run again"] = len(_hidden(out))
    return counted


def _hidden(out: Path) -> set[Path]:
    """What is hidden beside the run directory, in it and beside exported files."""
    return {path for folder in (out.parent, out, out.parent / "exported") for path in folder.glob(".figaroh-jax-*")}


class Refusing:
    """Stands in the place of the calls that write: the chosen one raises, before it does anything or after."""

    def __init__(self, out: Path, chosen: tuple[str, int], error: Callable[[], BaseException], after: bool) -> None:
        self.below, self.chosen, self.error, self.after = str(out.parent), chosen, error, after
        self.calls: list[str] = []

    def point(self, name: str, act: Callable[[], Any]) -> Any:
        self.calls.append(name)
        if (name, self.calls.count(name)) != self.chosen:  # the so-manieth of its kind
            return act()
        if self.after:
            act()
        raise self.error()

    def wrap(self, module: Any, name: str) -> Callable[..., Any]:
        original = getattr(module, name)

        def call(*args: Any, **more: Any) -> Any:
            if name == "open" and not args[1] & (os.O_WRONLY | os.O_RDWR):
                return original(*args, **more)
            named = [os.fsdecode(x) for x in args[:2] if isinstance(x, (str, bytes, os.PathLike))]
            if named and not any(self.below in text for text in named):
                return original(*args, **more)
            return self.point(name, lambda: original(*args, **more))

        return call

    def opened(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, mode: str = "r", *args: Any, **more: Any) -> Any:
            writes = any(letter in mode for letter in "wax+")
            numbered = isinstance(file, int)
            path = os.readlink(f"/proc/self/fd/{file}") if numbered else file
            if not writes or not isinstance(path, (str, os.PathLike)) or self.below not in str(Path(path).absolute()):
                return original(file, mode, *args, **more)
            open_it = partial(original, file, mode, *args, **more)
            stream = open_it() if numbered else self.point("open", open_it)
            inner = stream.write
            return _Writing(stream, lambda data: self.point("write", lambda: inner(data)))

        return call


class _Writing:
    """A stream whose `write` is another function."""

    def __init__(self, stream: Any, write: Callable[[Any], Any]) -> None:
        self.stream, self.write = stream, write

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *error: Any) -> None:
        self.stream.close()

    def __iter__(self) -> Iterator[Any]:
        return iter(self.stream)


_CALLS = ("mkdir", "rename", "replace", "link", "unlink", "rmdir", "fsync", "open")


@contextlib.contextmanager
def refusing(
    out: Path, chosen: tuple[str, int], error: Callable[[], BaseException], after: bool, one_step: bool
) -> Iterator[Refusing]:
    """The calls of this process that write below the run directory's parent, one of them refused.

    Without `one_step` the system cannot exchange two directories.
    """
    from figaroh_jax.reporting import run_directory

    switch = Refusing(out, chosen, error, after)
    changed = [(os, name, switch.wrap(os, name)) for name in _CALLS]
    if one_step:
        changed += [(run_directory, "_exchange", switch.wrap(run_directory, "_exchange"))]
    else:
        changed += [(run_directory, "_renameat2", lambda: None)]
    changed += [(io, "open", switch.opened(io.open)), (builtins, "open", switch.opened(builtins.open))]
    before = [(module, name, getattr(module, name)) for module, name, _ in changed]
    try:
        for module, name, value in changed:
            setattr(module, name, value)
        yield switch
    finally:
        for module, name, value in before:
            setattr(module, name, value)


WRITING = ("diagnose", "rerun", "verify", "compare", "new", "export")  # whose calls are refused


def failures(folder: Path, count: int, source: random.Random, calls: Sequence[str] = ()) -> Counter[str]:
    """Refuse calls that write, one a run, `count` of each kind; count what was found after each."""
    out, counted = folder / "runs" / "out", Counter[str]()
    before, kinds = checksums(folder), Counter[str]()
    points: dict[str, list[tuple[Any, ...]]] = {}
    for name in WRITING:
        for one_step in (True, False) if name == "diagnose" else (True,):
            made_before(folder, name)
            with (
                refusing(out, ("", 0), ERRORS[0], False, one_step) as switch,
                contextlib.redirect_stdout(io.StringIO()),
            ):
                assert command(folder, name) in (0, 1), name
            for kind, number in Counter(switch.calls).items():
                ways = [(name, k + 1, kind) for k in range(number)]
                ways = [(*way, error, after, one_step) for way in ways for error in ERRORS for after in (False, True)]
                points.setdefault(kind, []).extend(ways)
    for kind in [kind for kind in points if calls and kind not in calls]:
        del points[kind]
    for some in points.values():
        source.shuffle(some)
    chosen = [point for some in points.values() for point in (some * -(-count // len(some)))[:count]]
    for name, number, kind, error, after, one_step in chosen:
        errors = io.StringIO()
        made_before(folder, name)
        with refusing(out, (kind, number), error, after, one_step) as switch, contextlib.redirect_stderr(errors):
            with contextlib.redirect_stdout(io.StringIO()):
                status = command(folder, name)
        refused = switch.calls.count(kind) >= number
        kinds[kind if refused else f"{kind} not reached"] += 1
        counted["failures"] += refused
        counted[f"{name}: run not whole"] += whole(out) is None
        counted["file of the user's touched"] += checksums(folder) != before
        counted[f"{name}: status other than 0, 1, 2, 130"] += status not in (0, 1, 2, 130)
        counted[f"{name}: no single line of message"] += status == 2 and errors.getvalue().count("\n") != 1
        for left in [*_hidden(out), *out.parent.glob("out-*")]:
            counted[f"left beside: {'hidden' if left.name[0] == '.' else 'the finished run'}"] += 1
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        if whole(out) is None:
            shutil.rmtree(out, ignore_errors=True)
            assert command(folder, "diagnose") == 0
    print(f"calls refused: {dict(kinds)}")
    return counted


def main() -> int:
    """Both studies; status 1 where a run was not whole or a file of the user's was touched."""
    parser = argparse.ArgumentParser(description="Kill commands and refuse their writes; see what is left.")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--failures", type=int, default=50, help="of each kind of call")
    parser.add_argument("--calls", nargs="*", default=(), help="refuse these alone: rename, link, ...")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "user"
        folder.mkdir()
        os.environ["XDG_CACHE_HOME"] = str(Path(temporary) / "cache")
        pid = os.fork()  # what computes has threads, after which a process must not fork
        if not pid:
            import jax

            jax.config.update("jax_enable_x64", True)
            prepare(folder)
            sys.stdout.flush()
            os._exit(0)
        assert os.waitpid(pid, 0)[1] == 0, "the results could not be computed"
        import figaroh_jax.calibration.calibration
        import figaroh_jax.diagnosis.diagnosis
        import figaroh_jax.identification.identification
        import figaroh_jax.recordings.draft
        import figaroh_jax.reporting.calibration_files
        import figaroh_jax.reporting.identification_report
        import figaroh_jax.reporting.report
        import figaroh_jax.reporting.side_by_side
        import figaroh_jax.reporting.terminal
        import figaroh_jax.reporting.verification
        import figaroh_jax.rollouts.export  # noqa: F401

        source = random.Random(args.seed)
        wrong = 0
        here = os.getcwd()
        refused = partial(failures, calls=args.calls)
        for name, study, count in (("kills", kills, args.kills), ("failures", refused, args.failures)):
            counted = study(folder, count, source) if count else Counter()
            print(f"{name}: { ({key: value for key, value in counted.items() if value}) }", flush=True)
            bad = ("not whole", "of the user's touched", "status other", "no single line", "did not end", "run again")
            wrong += sum(value for key, value in counted.items() if any(words in key for words in bad))
        os.chdir(here)
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
