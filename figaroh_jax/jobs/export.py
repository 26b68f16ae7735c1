"""The loop of a finished run of rollouts in the words of a simulator."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from ..errors import InputError, as_written
from ..reporting.run_directory import refusals, write_file
from ..rollouts import callback
from ..rollouts.export import for_simulator, with_drives
from ..rollouts.stored import LOOP

__all__ = ["LOOP", "export_loop"]


def export_loop(model: Path, simulator: str, out: Path | None = None) -> str:
    """The loop of a run (its directory, or `model` in it) in the words of a simulator; with `out`, written there too.

    For MuJoCo `out` also gets `robot.xml`, with everything that MuJoCo has words for, and `callback.py` with
    `loop.json`, which do the rest step by step. Raises `InputError` for another directory, and for a simulator that
    is not known.
    """
    model = model / "model" if (model / "model" / LOOP).is_file() else model
    try:
        content = json.loads((model / LOOP).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{model}: no readable {LOOP}; {_advice(model)}") from None
    with as_written(model / LOOP):
        text = json.dumps(for_simulator(content, simulator), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        files = {f"{simulator}.json": text}
        if simulator == "mujoco" and out is not None:
            files["robot.xml"] = with_drives(model / "robot.xml", content)
            files["callback.py"] = Path(callback.__file__).read_text(encoding="utf-8")
            files[LOOP] = json.dumps(content, indent=2) + "\n"
    if out is not None:
        _write_files(out, files)
    return text


def _advice(model: Path) -> str:
    """What to name instead of a directory that holds no loop."""
    model = model / "model" if (model / "model" / "effects.yaml").is_file() else model
    if (model / "effects.yaml").is_file():
        files = ", ".join(name for name in ("robot.urdf", "robot.xml", "effects.yaml") if (model / name).is_file())
        return f"only rollouts (a command, no torque) have one; the model of this run is in its {files}"
    return "name the `model` directory of a rollout's run"


def _write_files(out: Path, files: Mapping[str, str]) -> None:
    """Files into a folder that may be there, all or none; one that says something else stops it."""
    for name, text in files.items():
        path = out / name
        with refusals(out):
            if os.path.lexists(path) and not (path.is_file() and path.read_bytes() == text.encode()):
                raise InputError(f"--out {out}: {name} exists with other content; name another folder")
    with refusals(out):
        out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_file(out / name, text, "--out")
