"""Nothing of the library talks to the network: a whole command runs where no socket can be made."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import socket, sys
def refused(event, args):
    if event in ("socket.__new__", "socket.connect", "socket.bind", "socket.getaddrinfo", "socket.gethostbyname"):
        raise RuntimeError(f"the network was asked for: {event} {args}")
sys.addaudithook(refused)
from figaroh_jax import cli
sys.exit(cli.main(sys.argv[1:]))
"""


def test_the_guard_itself_refuses():
    code = CODE.replace("from figaroh_jax import cli", "socket.socket()")
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "the network was asked for" in run.stderr


@pytest.mark.parametrize("command", ["diagnose", "calibrate"])
def test_commands_that_read_and_refuse_need_no_network(tmp_path: Path, command: str):
    import tasks

    task = tasks.task()
    task["preprocess"] = {"window": [100.0, 200.0]}  # all is read before this is found
    file = tasks.write(tmp_path, task)
    run = subprocess.run([sys.executable, "-c", CODE, command, str(file)], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 2 and "figaroh-jax: error: " in run.stderr, run.stderr
    assert "network" not in run.stderr


@pytest.mark.slow
def test_the_demo_needs_no_network(tmp_path: Path):
    run = subprocess.run([sys.executable, "-c", CODE, "demo", "--quiet"], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "demo_diagnosis" / "report.html").is_file()
