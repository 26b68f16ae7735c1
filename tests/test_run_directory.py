"""Run directories: nothing of a user's is lost, the old or the new run is there whole, every refusal is one message."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import tasks

from figaroh_jax import cli
from figaroh_jax.errors import InputError
from figaroh_jax.reporting import run_directory
from figaroh_jax.reporting.run_directory import MARKER, check_directory, task_inputs, whole_directory


def write(out: Path, text: str = "{}", inputs: tuple[Path, ...] = ()) -> None:
    """A run of two files, one of them in a folder."""
    with whole_directory(out, inputs) as folder:
        (folder / "answer.json").write_text(text)
        (folder / "model").mkdir()
        (folder / "model" / "robot.urdf").write_text("<robot/>")


def checksums(folder: Path) -> dict[str, str]:
    """Everything in a folder, with the hash of its bytes, and where links point to."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"-> {os.readlink(path)}"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def refused(out: Path, words: str, inputs: tuple[Path, ...] = ()) -> None:
    """The directory is refused before and while it is written; the message is one line."""
    with pytest.raises(InputError, match=words) as caught:
        check_directory(out, inputs)
    assert str(caught.value).startswith("--out ") and "\n" not in str(caught.value)
    with pytest.raises(InputError, match=words):
        write(out, inputs=inputs)


def test_a_run_is_replaced_by_the_next_one(tmp_path: Path):
    out = tmp_path / "out"
    write(out, "old")
    (out / "model" / "robot.urdf").unlink()  # what the user took away is no loss
    write(out, "new")
    assert (out / "answer.json").read_text() == "new"
    assert sorted(os.listdir(out)) == ["answer.json", MARKER, "model"]
    assert os.listdir(tmp_path) == ["out"]


def test_the_folder_of_the_task_is_never_a_run_directory(tmp_path: Path, monkeypatch, capsys):
    """A `result.json` or `answer.json` of whatever origin does not make a folder an earlier run."""
    monkeypatch.chdir(tmp_path)
    tasks.write(tmp_path)
    (tmp_path / "result.json").write_text("{}")
    (tmp_path / "answer.json").write_text("{}")
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "main.c").write_text("int main;")
    before = checksums(tmp_path)
    for out in (".", str(tmp_path), "../" + tmp_path.name, "source/..", "/"):
        for command in ("diagnose", "identify", "calibrate"):
            assert cli.main([command, "task.yaml", "--out", out, "--quiet"]) == 2
            message = capsys.readouterr().err
            assert message.startswith("figaroh-jax: error: --out ") and message.count("\n") == 1
    monkeypatch.chdir(tmp_path.parent)
    assert cli.main(["diagnose", str(tmp_path / "task.yaml"), "--out", str(tmp_path), "--quiet"]) == 2
    assert "earlier version" in capsys.readouterr().err
    assert checksums(tmp_path) == before


SPOIL = {
    "a file was added": (lambda out: (out / "notes.txt").write_text("mine"), "'notes.txt' was not written by the run"),
    "a file was added below": (lambda out: (out / "model" / "notes.txt").write_text("mine"), "'model/notes.txt'"),
    "a hidden file was added": (lambda out: (out / ".git").write_text("mine"), "'.git' was not"),
    "a folder was added": (lambda out: (out / "plots").mkdir(), "'plots' was not written"),
    "a link was added": (lambda out: (out / "plots").symlink_to("model"), "'plots' was not written"),
    "a file was edited": (lambda out: (out / "answer.json").write_text("()"), "'answer.json' was changed"),
    "a file became a link": (
        lambda out: (
            shutil.move(out / "answer.json", out.parent / "mine"),
            (out / "answer.json").symlink_to("../mine"),
        ),
        "'answer.json' was changed",
    ),
    "a file became a folder": (
        lambda out: ((out / "answer.json").unlink(), (out / "answer.json").mkdir()),
        "'answer.json' was changed",
    ),
    "the marker was cut": (lambda out: os.truncate(out / MARKER, 40), "damaged"),
    "the marker was edited": (
        lambda out: (out / MARKER).write_text((out / MARKER).read_text().replace("answer", "result")),
        "damaged",
    ),
    "the marker is a list": (lambda out: (out / MARKER).write_text("[]"), "damaged"),
    "the marker is huge": (lambda out: os.truncate(out / MARKER, 1 << 21), "damaged"),
    "the marker is gone": (lambda out: (out / MARKER).unlink(), "earlier version"),
}


@pytest.mark.parametrize("kind", SPOIL)
def test_what_a_user_did_to_a_run_stops_the_next_one(tmp_path: Path, kind: str):
    spoil, words = SPOIL[kind]
    out = tmp_path / "out"
    write(out)
    spoil(out)
    before = checksums(tmp_path)
    refused(out, words)
    assert checksums(tmp_path) == before


def test_a_marker_cannot_point_outside_its_directory(tmp_path: Path):
    out, mine = tmp_path / "out", tmp_path / "mine"
    write(out)
    mine.write_text("years of work")
    for name in ("../mine", str(mine)):
        files = {name: {"bytes": mine.stat().st_size, "sha256": hashlib.sha256(mine.read_bytes()).hexdigest()}}
        digest = hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()
        (out / MARKER).write_text(json.dumps({"format": 1, "files": files, "sha256": digest}))
        refused(out, "damaged")
    assert mine.read_text() == "years of work"


def test_links_files_and_loops_are_refused(tmp_path: Path):
    write(tmp_path / "real")
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_text("")
    before = checksums(tmp_path)
    refused(tmp_path / "link", "is a symbolic link")
    refused(tmp_path / "dangling", "is a symbolic link")
    refused(tmp_path / "loop" / "out", "loop")
    refused(tmp_path / "file", "a file is there")
    refused(tmp_path / "file" / "out", "is a file")
    refused(tmp_path / ("n" * 300), "name is too long")
    refused(Path("\0"), "null byte")
    assert checksums(tmp_path) == before


def test_a_directory_above_or_with_an_input_is_refused(tmp_path: Path):
    """An earlier run's model or predictions may be the next task's robot or recording."""
    out = tmp_path / "out"
    write(out)
    refused(out, "robot.urdf, which this command reads", (out / "model" / "robot.urdf",))
    refused(out, "which this command reads", (out,))
    (tmp_path / "link.urdf").symlink_to(out / "model" / "robot.urdf")
    refused(out, "which this command reads", (tmp_path / "link.urdf",))
    write(out, inputs=(tmp_path / "elsewhere.urdf",))


def test_every_file_of_a_task_is_an_input(tmp_path: Path):
    tasks.write(tmp_path)
    (tmp_path / "parts").mkdir()
    (tmp_path / "robot.urdf").write_text(
        "<robot><mesh filename='parts/link.stl'/><mesh filename=\"gone.stl\"/><include file='parts/more.xml'/></robot>"
    )
    (tmp_path / "parts" / "link.stl").write_text("")
    (tmp_path / "parts" / "more.xml").write_text("<mujoco><include file='parts/last.xml'/></mujoco>")
    (tmp_path / "parts" / "last.xml").write_text("<mujoco><include file='robot.urdf'/></mujoco>")
    (tmp_path / "child.yaml").write_text("extends: task.yaml\n")
    found = {path.resolve().relative_to(tmp_path).as_posix() for path in task_inputs(tmp_path / "child.yaml")}
    names = {"child.yaml", "task.yaml", "robot.urdf", "run1.npz", "run2.npz"}
    assert found == names | {"parts/link.stl", "parts/more.xml", "parts/last.xml"}


def test_the_way_to_the_directory_is_resolved_first(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("o"), "old")
    write(Path("o/../o"), "new")
    assert (tmp_path / "o" / "answer.json").read_text() == "new"
    write(Path("fresh/../p"))
    assert sorted(os.listdir(tmp_path)) == ["o", "p"]


@pytest.mark.parametrize("exchange", [True, False], ids=["one step", "two steps"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError, OSError(errno.EIO, "broken")])
@pytest.mark.parametrize("after", [False, True], ids=["before the step", "after it"])
def test_an_interrupt_at_any_rename_leaves_the_old_or_the_new_run(tmp_path, monkeypatch, exchange, error, after):
    out = tmp_path / "out"
    write(out, "old")
    if not exchange:
        monkeypatch.setattr(run_directory, "_renameat2", lambda: None)
    for fails in range(4):
        calls = []

        def rename(self, target, fails=fails, calls=calls):
            calls.append(target)
            if len(calls) - 1 == fails and not after:
                raise error
            os.rename(self, target)
            if len(calls) - 1 == fails:
                raise error
            return target

        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", rename)
            try:
                write(out, "new")
            except BaseException as caught:
                assert not isinstance(caught, OSError)
        assert (out / "answer.json").read_text() in ("old", "new")
        check_directory(out)
        for saved in set(os.listdir(tmp_path)) - {"out"}:  # a finished run that could not be put in its place
            assert (tmp_path / saved / "answer.json").read_text() == "new"
            shutil.rmtree(tmp_path / saved)
        write(out, "old")


def test_a_run_that_a_kill_left_between_two_renames_comes_back(tmp_path: Path):
    out = tmp_path / "out"
    write(out, "old")
    (tmp_path / ".figaroh-jax-abc" / "earlier").mkdir(parents=True)
    out.rename(tmp_path / ".figaroh-jax-abc" / "earlier" / "out")
    check_directory(out)
    assert (out / "answer.json").read_text() == "old"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO, errno.ENOENT, errno.EACCES, errno.EDQUOT])
def test_a_refusal_of_the_file_system_is_one_message_and_changes_nothing(tmp_path: Path, number: int):
    out = tmp_path / "out"
    write(out, "old")
    before = checksums(tmp_path)
    with pytest.raises(InputError, match="cannot be written: .*nothing there was changed") as caught:
        with whole_directory(out) as folder:
            (folder / "half.txt").write_text("half")
            raise OSError(number, os.strerror(number), str(folder))
    assert "\n" not in str(caught.value) and "figaroh-jax-" not in str(caught.value)
    assert checksums(tmp_path) == before


def test_folders_made_on_the_way_go_again_when_the_run_fails(tmp_path: Path):
    with pytest.raises(RuntimeError), whole_directory(tmp_path / "a" / "b" / "out"):
        raise RuntimeError
    assert not os.listdir(tmp_path)


def test_what_is_put_into_the_directory_meanwhile_is_kept(tmp_path: Path):
    for start in (lambda out: None, Path.mkdir, write):
        out = tmp_path / "out"
        start(out)
        with pytest.raises(InputError, match="The finished run was kept: it is in .*out-2"):
            with whole_directory(out) as folder:
                (folder / "answer.json").write_text("new")
                out.mkdir(exist_ok=True)
                (out / "notes.txt").write_text("mine")
        assert (out / "notes.txt").read_text() == "mine"
        assert (tmp_path / "out-2" / "answer.json").read_text() == "new"
        assert sorted(os.listdir(tmp_path)) == ["out", "out-2"]
        shutil.rmtree(out)
        shutil.rmtree(tmp_path / "out-2")


def test_a_working_directory_that_vanished_is_one_message(tmp_path: Path):
    code = "import os, sys; os.mkdir('gone'); os.chdir('gone'); os.rmdir('../gone');" + (
        "from figaroh_jax.reporting.run_directory import check_directory; from pathlib import Path\n"
        "try: check_directory(Path('out'))\n"
        "except ValueError as error: print(error)"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0 and "--out out" in run.stdout, run.stderr


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_to_end_cleans_up_and_is_the_exit_status(tmp_path: Path, monkeypatch, name: str):
    number = getattr(signal, name)

    def run(args):
        with whole_directory(tmp_path / "out") as folder:
            (folder / "half.txt").write_text("half")
            signal.raise_signal(number)

    monkeypatch.setattr(cli, "_run", run)
    before = signal.signal(number, signal.SIG_DFL)  # under nohup a process ignores SIGHUP
    try:
        assert cli.main(["demo"]) == 128 + number
        assert not os.listdir(tmp_path)
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_a_refusal_of_the_file_system_outside_the_run_is_no_internal_error(monkeypatch, capsys):
    def run(args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/some/where")

    monkeypatch.setattr(cli, "_run", run)
    assert cli.main(["demo"]) == 2
    message = capsys.readouterr().err
    assert "internal" not in message and "No space left on device: '/some/where'" in message


def test_what_a_killed_run_left_is_removed_by_the_next_one_and_nothing_else(tmp_path: Path):
    code = f"""
import os, signal
from contextlib import suppress
from pathlib import Path
from figaroh_jax.reporting.run_directory import whole_directory
with whole_directory(Path({str(tmp_path)!r}) / "out") as new:
    (new / "answer.json").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code])
    (left,) = tmp_path.glob(".figaroh-jax-*")
    other, empty = tmp_path / ".figaroh-jax-mine", tmp_path / ".figaroh-jax-empty"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    empty.mkdir()
    with run_directory.whole_directory(tmp_path / "elsewhere"):  # a run that is under way
        (held,) = set(tmp_path.glob(".figaroh-jax-*")) - {left, other, empty}
        write(tmp_path / "third")
        assert held.is_dir()
    assert not left.exists() and not held.exists() and (other / "thesis.tex").is_file() and empty.is_dir()


def test_a_file_of_the_user_s_is_never_replaced_by_one_of_ours(tmp_path: Path):
    file = tmp_path / "page.html"
    run_directory.write_file(file, "<page>1", "--out", "<page>")
    run_directory.write_file(file, "<page>2", "--out", "<page>")
    assert file.read_text() == "<page>2"
    file.write_text("thesis")
    for own in ("<page>", None):
        with pytest.raises(InputError, match="was not written by this command"):
            run_directory.write_file(file, "<page>3", "--out", own)
    run_directory.write_file(file, "thesis", "--out")
    for name, words in (("", "is a directory"), ("n" * 300, "too long"), ("a\0b", "null byte"), ("x/y", "vanished")):
        with pytest.raises(InputError, match=words):
            run_directory.write_file(tmp_path / name, "text", "--out")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"] and file.read_text() == "thesis"


@pytest.mark.parametrize("call", ["open", "fsync", "replace", "link"])
def test_a_refusal_leaves_the_file_that_was_there(tmp_path: Path, monkeypatch, call: str):
    def full(*args, **more):
        raise OSError(errno.ENOSPC, "full")

    file = tmp_path / "page.html"
    if call != "link":
        file.write_text("<page>1")
    monkeypatch.setattr(os, call, full)
    if call == "link":  # a file system without second names
        run_directory.write_file(file, "<page>2", "--out", "<page>")
        assert file.read_text() == "<page>2"
    else:
        with pytest.raises(InputError, match="the disk is full"):
            run_directory.write_file(file, "<page>2", "--out", "<page>")
        assert file.read_text() == "<page>1"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_is_added_to_a_run_only_where_it_is_the_run_s(tmp_path: Path):
    out = tmp_path / "out"
    write(out)
    for text in ("first", "second"):
        run_directory.add_to_run(out, "verification.json", text)
        run_directory.check_directory(out)
    (out / "verification.json").write_text("mine")
    with pytest.raises(InputError, match="was not written by this run"):
        run_directory.add_to_run(out, "verification.json", "third")
    assert (out / "verification.json").read_text() == "mine"


@pytest.mark.parametrize("call", ["fsync", "replace", "link", "unlink"])
def test_a_run_is_whole_wherever_a_file_s_addition_stops(tmp_path: Path, monkeypatch, call: str):
    out = tmp_path / "out"
    for count in range(6):
        write(out)
        run_directory.add_to_run(out, "verification.json", "first")
        calls, original = [], getattr(os, call)

        def stop(*args, original=original, calls=calls, count=count, **more):
            calls.append(args)
            if len(calls) > count:
                raise KeyboardInterrupt
            return original(*args, **more)

        with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
            patch.setattr(os, call, stop)
            run_directory.add_to_run(out, "verification.json", "second")
        run_directory.check_directory(out)
