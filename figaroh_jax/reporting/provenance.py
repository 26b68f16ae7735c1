"""What made a run: command, task, hashes of everything read, versions, machine and time, as `provenance.json`."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from ..errors import InputError

__all__ = ["PROVENANCE", "provenance", "read_provenance"]

PROVENANCE = "provenance.json"
_PACKAGES = ("figaroh-jax", "jax", "jaxlib", "equinox", "numpy", "scipy", "mujoco", "pin")


def provenance(command: str, task: Path, inputs: Iterable[Path], backend: str, options: Sequence[str] = ()) -> str:
    """The text of `provenance.json`; `inputs` are the files that the task reads, its own among them.

    Of `simulate` the folder of the model stands in the place of the task.
    """
    content: dict[str, Any] = {
        "command": command,
        "options": [*options, *(["--backend", backend] if backend != "native" else [])],
        "task": str(task.resolve()),
        "task_text": task.read_text(encoding="utf-8", errors="replace") if task.is_file() else "",
        "inputs": [_hashed(path) for path in dict.fromkeys(p.resolve() for p in inputs)],
        "versions": {"python": platform.python_version()} | _versions(),
        "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
        "seed": 0,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_provenance(folder: Path) -> dict[str, Any]:
    """What made the run in `folder`; raises `InputError` where that is not said."""
    path = folder / PROVENANCE
    if not path.is_file():
        what = f"holds no {PROVENANCE}" if folder.is_dir() else "is not a directory"
        raise InputError(f"{folder}: {what}; name the directory of a run (--out of diagnose, identify, ...)")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict) or not {"command", "task", "options"} <= content.keys():
            raise ValueError("keys are missing")
        words = [content["command"], content["task"], *content["options"]]
        if not all(isinstance(word, str) and "\0" not in word for word in words):
            raise ValueError("command, task and options are not strings")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: what made this run cannot be read ({error}); name a run directory") from None
    return content


def _hashed(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"file": str(path), "bytes": path.stat().st_size, "sha256": digest}


def _version(package: metadata.Distribution) -> str:
    """As `package.version`, which parses a package's whole description (.05 CPU s for these)."""
    head = (package.read_text("METADATA") or "").partition("\n\n")[0]
    return next((line[8:].strip() for line in head.splitlines() if line.startswith("Version:")), package.version)


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = _version(metadata.distribution(name))
        except metadata.PackageNotFoundError:
            continue
    return found
