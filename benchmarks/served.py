"""A process that stays and calls the tool for one case after another, so that its programs are compiled once.

python -m benchmarks.served          # requests as JSON on lines of its input, what came of each on a line of output
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

from . import blackbox


class Server:
    """One such process, begun at its first call and after one that it did not come back from."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None

    def call(self, folder: Path, out: Path, case: blackbox.Case, job: blackbox.Job, command: str, limit: float) -> str:
        """`blackbox.call_tool`; a call of more than `limit` seconds ends with the process and leaves no answer."""
        if self.process is None:
            words, flags = [sys.executable, "-m", "benchmarks.served"], os.environ | blackbox.ONE_THREAD
            self.process = subprocess.Popen(words, stdin=-1, stdout=-1, stderr=subprocess.DEVNULL, text=True, env=flags)
        assert self.process.stdin and self.process.stdout
        asked = {"folder": str(folder), "out": str(out), "case": case, "forbid": job.forbid, "command": command}
        try:
            print(json.dumps(asked), file=self.process.stdin, flush=True)
            said = self.process.stdout.readline() if select.select([self.process.stdout], [], [], limit)[0] else ""
        except BrokenPipeError:
            said = ""
        if not said:
            self.end()
            return f"{job.folder}: no answer within {limit:.0f} s"
        return json.loads(said)

    def end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


def main() -> None:
    """Answer requests until there are no more."""
    answers = os.fdopen(os.dup(1), "w")  # what the tool prints is none of them
    os.dup2(2, 1)
    for line in sys.stdin:
        asked: dict[str, Any] = json.loads(line)
        case, forbid = asked["case"], tuple(asked["forbid"])
        job = blackbox.Job(case["name"], forbid)
        told = blackbox.call_tool(Path(asked["folder"]), Path(asked["out"]), case, job, asked["command"], float("inf"))
        print(json.dumps(told), file=answers, flush=True)


if __name__ == "__main__":
    main()
