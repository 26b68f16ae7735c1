"""Pass or fail of a finished run against limits: one line a limit, `verification.json`, and JUnit XML for CI."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from xml.etree import ElementTree

from ..errors import InputError, as_written
from .run_directory import add_to_run

if TYPE_CHECKING:
    from ..formats.config import Limits

__all__ = ["DEFAULT_LIMITS", "JUNIT", "SIMULATED", "VERIFICATION", "Check", "figures", "junit", "read_run", "verify"]

VERIFICATION = "verification.json"
SIMULATED = "simulation.json"
JUNIT = 'name="figaroh-jax verify '  # by which such a file is known
_SIDES = {
    "verdict": "one of",
    "forbidden_causes": "none of",
    **dict.fromkeys(("gain", "p_value", "rank"), "at least"),
}
# `unexplained`: as `recordings.posture_checks.OFF`, which loads more than verify needs
DEFAULT_LIMITS: dict[str, Any] = {
    "verdict": ["nothing", "named"],
    "consistent": True,
    "fk_parity": 1e-9,
    "unexplained": 0.12,
}


class Check(NamedTuple):
    """One limit: what the run has, what it may have, and whether that passes; `skipped` where it was not measured."""

    limit: str
    status: Literal["pass", "fail", "skipped"]
    figure: Any
    bound: Any

    @property
    def line(self) -> str:
        """As `verify` prints it."""
        figure = "not measured" if self.figure is None else _text(self.figure)
        return f"{self.status:<8} {self.limit:<24} {figure}   (limit: {self.allowed})"

    @property
    def allowed(self) -> str:
        """The bound in words: which side of it passes."""
        name, bound = self.limit.split(" ")[0], _text(self.bound)
        return bound if name == "consistent" else f"{_SIDES.get(name, 'at most')} {bound}"


def verify(folder: Path, limits: Limits, *, write: bool = True) -> tuple[Check, ...]:
    """Judge the run in `folder`; `verification.json` is put into it unless `write` is False.

    Raises `InputError` where `folder` is no finished run.
    """
    with as_written(folder):
        found = figures(read_run(folder))
    given = {name: getattr(limits, name) for name in type(limits).model_fields if getattr(limits, name) is not None}
    with as_written(folder):
        checks = tuple(check for name, bound in given.items() for check in _judged(name, bound, found))
    if write:
        passed = all(check.status != "fail" for check in checks)
        content = {"passed": passed, "limits": [check._asdict() for check in checks]}
        add_to_run(folder, VERIFICATION, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    return checks


def read_run(folder: Path) -> dict[str, Any]:
    """`answer.json` and `result.json` of a run directory, under "answer" and "result" (None where there is none)."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a directory; give that of a run (--out of diagnose, identify, ...)")
    found: dict[str, Any] = {}
    for key in ("answer", "result"):
        path = folder / f"{key}.json"
        try:
            found[key] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: cannot be read as JSON: {error}") from None
        if found[key] is not None and not isinstance(found[key], dict):
            raise InputError(f"{path}: holds no object with keys, so no run wrote it")
    if found["answer"] is None and found["result"] is None and (folder / SIMULATED).is_file():
        raise InputError(
            f"{folder}: holds a simulation; runs of diagnose, identify and calibrate are verified and compared"
            " (answer.json or result.json), and simulations are compared with simulations"
        )
    if found["answer"] is None and found["result"] is None:
        raise InputError(f"{folder}: has neither answer.json nor result.json, so it is not a run directory")
    return found


def figures(run: dict[str, Any]) -> dict[str, Any]:
    """The figures of a run that limits are set on, by the names of LIMITS.yaml; None where one was not measured."""
    answer, result = run["answer"] or {}, run["result"] or {}
    causes = answer.get("causes") if run["answer"] else result.get("causes")
    verdict = answer.get("verdict", result.get("verdict") if "level" in result else None)
    if verdict is not None and not isinstance(verdict, str):
        raise TypeError("the verdict is not a string")
    return {
        "verdict": verdict,
        "p_value": _finite(answer.get("p_value")),
        "forbidden_causes": None if causes is None else [cause["effect"] for cause in causes],
        "holdout_relative": _holdout(answer, result),
        "gain": _gain(answer),
        "rank": result.get("rank") if "base_parameters" in result else None,
        "condition": _finite(result.get("condition")) if "base_parameters" in result else None,
        "relative_std": _relative_std(result),
        "consistent": all(link.get("consistent", True) for link in result["links"]) if result.get("links") else None,
        "position_mm": _finite((result.get("position") or {}).get("validated_after")),
        "orientation_deg": _finite((result.get("orientation") or {}).get("validated_after")),
        "fk_parity": _finite(result.get("fk_parity")),
        "unexplained": _finite(result.get("unexplained")),
    }


def _finite(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _holdout(answer: dict[str, Any], result: dict[str, Any]) -> dict[str, float | None]:
    """Relative error on held-out data: "all", and of each joint on held-out recordings."""
    if "holdout" in answer:
        relative = answer["holdout"].get("unit") == "relative RMS"
        whole = _finite(answer["holdout"].get("after")) if relative else None
        return {"all": whole, **{n: _finite(x) for n, x in answer["holdout"].get("joints", {}).items()}}
    found: dict[str, float | None] = {}
    for quality in (result.get("holdout") or {}).values():
        for name, value in zip(result.get("joints", []), quality.get("relative", []), strict=False):
            old, new = found.get(name), _finite(value)
            found[name] = new if old is None else max(old, new or 0.0)
    known = [x for x in found.values() if x is not None]
    return {"all": max(known) if known else None, **found}


def _gain(answer: dict[str, Any]) -> float | None:
    held = answer.get("holdout") or {}
    before, after = _finite(held.get("before")), _finite(held.get("after"))
    return None if not before or after is None else 1 - after / before


def _relative_std(result: dict[str, Any]) -> float | None:
    identified = [one for one in result.get("base_parameters", []) if one["status"] == "identified"]
    values = [abs(one["std"] / one["value"]) for one in identified if one["value"] and one["std"] is not None]
    return max(values) if values else None


def _judged(name: str, bound: Any, found: dict[str, Any]) -> Iterator[Check]:
    figure = found[name]
    if name == "holdout_relative":
        bounds = bound if isinstance(bound, dict) else {"all": bound}
        for joint, most in bounds.items():
            key = name if joint == "all" else f"{name} {joint}"
            yield _check(key, figure.get(joint), most, lambda x, most=most: x <= most)
        return
    if name == "forbidden_causes":
        yield _check(name, figure, list(bound), lambda x: not set(x) & set(bound))
    elif name == "verdict":
        yield _check(name, figure, list(bound), lambda x: x in bound)
    elif name == "consistent":
        yield _check(name, figure, bound, lambda x: x or not bound)
    elif _SIDES.get(name) == "at least":
        yield _check(name, figure, bound, lambda x: x >= bound)
    else:
        yield _check(name, figure, bound, lambda x: x <= bound)


def _check(name: str, figure: Any, bound: Any, passes: Callable[[Any], bool]) -> Check:
    return Check(name, "skipped" if figure is None else "pass" if passes(figure) else "fail", figure, bound)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(str, value)) or "none" if isinstance(value, (list, tuple)) else str(value)


def junit(folder: Path, checks: tuple[Check, ...]) -> str:
    """The checks as JUnit XML: one suite, one case a limit."""
    count = {status: str(sum(c.status == status for c in checks)) for status in ("fail", "skipped")}
    suite = ElementTree.Element(
        "testsuite",
        {"name": f"figaroh-jax verify {folder.name}", "tests": str(len(checks)), "failures": count["fail"]}
        | {"skipped": count["skipped"], "errors": "0"},
    )
    for check in checks:
        case = ElementTree.SubElement(suite, "testcase", {"classname": folder.name, "name": check.limit})
        if check.status == "fail":
            text = f"{_text(check.figure)} against the limit: {check.allowed}"
            ElementTree.SubElement(case, "failure", {"message": text}).text = check.line
        elif check.status == "skipped":
            ElementTree.SubElement(case, "skipped", {"message": "the run did not measure it"})
    ElementTree.indent(suite)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(suite, encoding="unicode") + "\n"
