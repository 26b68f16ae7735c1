"""Commands killed at random moments, and every call by which they write refused once: the old or the new run is there.

    python benchmarks/kills.py                       # 200 kills, every write refused in four ways: about ten minutes
    python benchmarks/kills.py --kills 20 --failures 20

A folder holds a task with its files, things of the user's beside them, and an earlier run. Each kill is a fresh process
that runs one command and gets SIGKILL, SIGTERM or SIGINT at a random moment; each failure is a command in which one of
the calls that open, write, synchronise, rename, make or remove something raises (no space, input/output error,
interrupted call, Ctrl-C). After each, the checksums of all that is the user's are as before, and the run directory is
the earlier run or the new one, whole. What the commands compute is computed once, before; the rest is as ever.
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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
COMMANDS = ("diagnose", "identify", "calibrate", "demo")
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
    demo = ROOT / "figaroh_jax" / "demo"
    found["demo"] = replace(fake_diagnosis.named(), model=extend(load_urdf(demo / "robot.urdf")))
    (folder.parent / "found.pickle").write_bytes(pickle.dumps(found))


def command(folder: Path, name: str) -> int:
    """One command in the user's folder; what it would compute is there."""
    from figaroh_jax import cli
    from figaroh_jax.calibration import calibration
    from figaroh_jax.diagnosis import diagnosis
    from figaroh_jax.identification import identification

    found = pickle.loads((folder.parent / "found.pickle").read_bytes())
    diagnosis.diagnose_task = lambda *args, **more: found[name]
    identification.identify_task = lambda *args, **more: found["identify"]
    calibration.calibrate_task = lambda *args, **more: found["calibrate"]
    os.chdir(folder)
    task = [] if name == "demo" else ["poses.yaml" if name == "calibrate" else "task.yaml"]
    return cli.main([name, *task, "--out", "runs/out", "--quiet"])


def checksums(folder: Path) -> dict[str, str]:
    """What is the user's: everything but the run directory and hidden folders of runs beside it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if parts[0] != "runs":
            found["/".join(parts)] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def whole(out: Path) -> str | None:
    """The kind of run in the directory; None where it is not whole."""
    from figaroh_jax.reporting import run_directory

    if not out.is_dir() or run_directory._altered(out) is not None:
        return None
    names = {path.name for path in out.iterdir()}
    written = run_directory._written(out) or {}
    if set(written) - {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}:
        return None
    return "answer" if "answer.json" in names else "parameters" if "parameters.csv" in names else "calibration"


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
        assert status == 0, f"{name} ended with {status}"
        lasts[name] = time.monotonic() - begin
    number = 0
    while counted["killed"] < count and number < 5 * count:
        number += 1
        name = COMMANDS[number % len(COMMANDS)]
        old = whole(out)
        pid = child(folder, name)
        moment = source.uniform(0, 0.9) * lasts[name]
        if number % 3:  # once it has begun to write, and a little later
            begin = time.monotonic()
            while time.monotonic() - begin < 10 * lasts[name] and not list(out.parent.glob(".figaroh-jax-*/new")):
                time.sleep(0.001)
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
        litter = list(out.parent.glob(".figaroh-jax-*"))
        counted["hidden folder left by SIGKILL"] += bool(litter) and number_of_signal == signal.SIGKILL
        counted["hidden folder left otherwise"] += bool(litter) and number_of_signal != signal.SIGKILL
        for left in litter:
            shutil.rmtree(left)
    return counted


class Refusing:
    """Stands in the place of the calls that write: the chosen one raises, before it does anything or after."""

    def __init__(self, out: Path, chosen: int, error: Callable[[], BaseException], after: bool) -> None:
        self.below, self.chosen, self.error, self.after = str(out.parent), chosen, error, after
        self.calls: list[str] = []

    def point(self, name: str, act: Callable[[], Any]) -> Any:
        self.calls.append(name)
        if len(self.calls) - 1 != self.chosen:
            return act()
        if self.after:
            act()
        raise self.error()

    def wrap(self, module: Any, name: str) -> Callable[..., Any]:
        original = getattr(module, name)

        def call(*args: Any, **more: Any) -> Any:
            named = [os.fsdecode(x) for x in args[:2] if isinstance(x, (str, bytes, os.PathLike))]
            if named and not any(self.below in text for text in named):
                return original(*args, **more)
            return self.point(name, lambda: original(*args, **more))

        return call

    def opened(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, mode: str = "r", *args: Any, **more: Any) -> Any:
            writes = any(letter in mode for letter in "wax+")
            if not writes or not isinstance(file, (str, os.PathLike)) or self.below not in os.fspath(file):
                return original(file, mode, *args, **more)
            stream = self.point("open", lambda: original(file, mode, *args, **more))
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


@contextlib.contextmanager
def refusing(
    out: Path, chosen: int, error: Callable[[], BaseException], after: bool, one_step: bool
) -> Iterator[Refusing]:
    """The calls of this process that write below the run directory's parent, one of them refused.

    Without `one_step` the system cannot exchange two directories.
    """
    from figaroh_jax.reporting import run_directory

    switch = Refusing(out, chosen, error, after)
    changed = [(os, name, switch.wrap(os, name)) for name in ("mkdir", "rename", "replace", "unlink", "rmdir", "fsync")]
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


def failures(folder: Path, count: int, source: random.Random) -> Counter[str]:
    """Refuse each of the calls that write, one a run; count what was found after each."""
    out, counted = folder / "runs" / "out", Counter[str]()
    before, kinds = checksums(folder), Counter[str]()
    points = []
    for one_step in (True, False):
        with refusing(out, -1, ERRORS[0], False, one_step) as all_of_them, contextlib.redirect_stdout(io.StringIO()):
            assert command(folder, "diagnose") == 0
        each = range(len(all_of_them.calls))
        points += [(k, error, after, one_step) for k in each for error in ERRORS for after in (False, True)]
    source.shuffle(points)
    for chosen, error, after, one_step in points[:count]:
        errors = io.StringIO()
        with refusing(out, chosen, error, after, one_step) as switch, contextlib.redirect_stderr(errors):
            with contextlib.redirect_stdout(io.StringIO()):
                status = command(folder, "diagnose")
        kinds[switch.calls[chosen]] += 1
        counted["failures"] += 1
        counted["run not whole"] += whole(out) is None
        counted["file of the user's touched"] += checksums(folder) != before
        counted["status other than 0, 2, 130"] += status not in (0, 2, 130)
        counted["no single line of message"] += status == 2 and errors.getvalue().count("\n") != 1
        for left in [*out.parent.glob(".figaroh-jax-*"), *out.parent.glob("out-*")]:
            counted[f"left beside: {'hidden folder' if left.name[0] == '.' else 'the finished run'}"] += 1
            shutil.rmtree(left)
        if whole(out) is None:
            shutil.rmtree(out, ignore_errors=True)
    print(f"calls refused: {dict(kinds)} of {dict(Counter(all_of_them.calls))} in a run")
    return counted


def main() -> int:
    """Both studies; status 1 where a run was not whole or a file of the user's was touched."""
    parser = argparse.ArgumentParser(description="Kill commands and refuse their writes; see what is left.")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--failures", type=int, default=400)
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
        import figaroh_jax.reporting.calibration_files
        import figaroh_jax.reporting.identification_report
        import figaroh_jax.reporting.report
        import figaroh_jax.reporting.terminal  # noqa: F401

        source = random.Random(args.seed)
        wrong = 0
        here = os.getcwd()
        for name, study, count in (("kills", kills, args.kills), ("failures", failures, args.failures)):
            counted = study(folder, count, source) if count else Counter()
            print(f"{name}: { ({key: value for key, value in counted.items() if value}) }", flush=True)
            bad = ("run not whole", "file of the user's touched", "status other than 0, 2, 130")
            wrong += sum(counted[key] for key in (*bad, "no single line of message", "did not end when asked to"))
        os.chdir(here)
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
