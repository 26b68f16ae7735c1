"""Two versions of the package judged on the same rows kept out, and on other folds: what `parity.py` sees, traced.

    python benchmarks/parity_kept.py tx40|gains|trust|irb120 --cases DIR --out OUT before=/path/a now=/path/b
    python benchmarks/parity_kept.py slowed --cases DIR        # of this checkout

Cases are those of `parity.py`. `tx40`: each quarter of the recording kept out in turn; `gains`: two recordings of six
of a Panda with a wrong torque gain; `trust`: the same with other trust in the links; `irb120`: sixteen orders of the
postures, which make other folds. Prints the RMS error of the kept-out rows, relative to that of the torque, low passed
as the fit is, or the cross-validated error (mm). `slowed`: whether positions are taken down to the band of their
motion, and by how much (logarithm) that changes the baseline's error, of all joints together and joint by joint.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from parity import path_of  # beside this file
from scipy.signal import butter, sosfiltfilt

GAINS = ("torque_gain_panda_joint2_panda_single_seed_5293", "torque_gain_panda_joint2_panda_repeats_seed_66889")


def called(command: str, folder: Path, task: dict[str, Any], side: str, source: Path) -> tuple[dict[str, Any], Path]:
    """The answer of one version and its run directory."""
    (folder / "task.yaml").write_text(json.dumps(task))
    run = folder / f"run_{side}"
    environment = os.environ | {"PYTHONPATH": path_of(source), "JAX_PLATFORMS": "cpu"}
    words = [sys.executable, "-m", "figaroh_jax", command, str(folder / "task.yaml"), "--out", str(run), "--quiet"]
    subprocess.run(words, env=environment, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    answer = run / ("answer.json" if command == "diagnose" else "result.json")
    return json.loads(answer.read_text()), run


def error(run: Path, stem: str, torque: np.ndarray, rate: float, cutoff: float, skip: int) -> float:
    """RMS over the joints of the error of the predicted torque, each relative to its torque."""
    with np.load(run / "predictions.npz") as told:
        predicted = told[f"{stem}_torque"][: len(torque)]
    low = butter(4, cutoff / (rate / 2), output="sos")
    off, whole = (sosfiltfilt(low, x, axis=0)[skip:-skip] for x in (predicted - torque, torque))
    return float(np.sqrt(np.mean((off**2).mean(0) / (whole**2).mean(0))))


def tx40(cases: Path, out: Path, sides: dict[str, Path]) -> None:
    task = json.loads((cases / "tx40" / "task.yaml").read_text())
    with np.load(cases / "tx40" / "tx40.npz") as arrays:
        q, tau = arrays["q"], arrays["tau"]
    entry = {key: x for key, x in task["data"][0].items() if key != "file"}
    rate, cutoff = entry["rate"], task["preprocess"]["cutoff"]
    joint = tau @ np.array(task["transmission"]["torque"]).T
    begin, end = task["preprocess"].pop("window")
    edges = np.linspace(begin * rate, end * rate, 5).astype(int)
    for k in range(4):
        folder = out / f"tx40_{k}"
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(cases / "tx40" / "robot.urdf", folder)
        first, last = edges[k], edges[k + 1]
        data = []
        for name, i, j in (("a", edges[0], first), ("b", last, edges[-1]), ("held", first, last)):
            if j > i:
                np.savez(folder / f"{name}.npz", q=q[i:j], tau=tau[i:j])
                data.append(entry | {"file": f"{name}.npz", "role": "holdout" if name == "held" else "fit"})
        for side, source in sides.items():
            answer, run = called("diagnose", folder, task | {"data": data}, side, source)
            off = error(run, "held", joint[first:last], rate, cutoff, rate // 10)
            causes = [f"{one['effect']} {' '.join(one['at'])}" for one in answer["causes"]]
            print(f"quarter {k + 1}, {side}: {off:.4f}, {answer['verdict']}, {', '.join(causes)}", flush=True)


def gains(cases: Path, out: Path, sides: dict[str, Path], trusts: Sequence[float | None] = (None,)) -> None:
    for name in GAINS if trusts == (None,) else GAINS[:1]:
        given = json.loads((cases / name / "task.yaml").read_text())
        for trust, k in itertools.product(trusts, range(0, 6, 2) if trusts == (None,) else [0]):
            folder = out / f"{name}_{k}_{trust}"
            shutil.copytree(cases / name, folder, dirs_exist_ok=True)
            roles = ["holdout" if i in (k, k + 1) else "fit" for i in range(6)]
            data = [one | {"role": role} for one, role in zip(given["data"], roles, strict=True)]
            robot = given["robot"] | ({} if trust is None else {"trust": trust})
            for side, source in sides.items():
                _, run = called("diagnose", folder, given | {"data": data, "robot": robot}, side, source)
                off = []
                for one in data[k : k + 2]:
                    with np.load(folder / one["file"]) as arrays:
                        rate, tau = 1 / float(np.median(np.diff(arrays["t"]))), arrays["tau"].astype(float)
                    cutoff = given["preprocess"]["cutoff"]
                    off.append(error(run, Path(one["file"]).stem, tau, rate, cutoff, int(rate / 4)))
                print(f"{name} {k} trust {robot['trust']}, {side}: {' '.join(f'{x:.6f}' for x in off)}", flush=True)


def irb120(cases: Path, out: Path, sides: dict[str, Path], orders: int = 16) -> None:
    task = json.loads((cases / "irb120_wu2015" / "task.yaml").read_text())
    for seed in range(orders):
        folder = out / f"irb120_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(cases / "irb120_wu2015" / "robot.urdf", folder)
        for one in task["data"]:
            with np.load(cases / "irb120_wu2015" / one["file"]) as arrays:
                count = len(arrays["q"])
                order = np.random.default_rng(seed).permutation(count) if seed else np.arange(count)
                np.savez(folder / one["file"], **{key: arrays[key][order] for key in arrays.files})
        found = {side: called("calibrate", folder, task, side, source)[0] for side, source in sides.items()}
        told = (f"{side} {one['position']['validated_after']:.4f}" for side, one in found.items())
        print(f"order {seed}: {', '.join(told)}", flush=True)


def slowed(cases: Path) -> None:
    import figaroh_jax as fj
    from figaroh_jax.diagnosis import diagnosis, setting

    seen: list[np.ndarray] = []
    squares, kept = setting._baseline_squares, diagnosis.prepared_signals

    def noted(*given: Any) -> np.ndarray:
        seen.append(squares(*given))
        return seen[-1]

    class Chosen(Exception):
        pass

    def ended(*given: Any) -> Any:
        raise Chosen(kept(*given)[1])

    setting._baseline_squares, diagnosis.prepared_signals = noted, ended
    for file in sorted(cases.glob("*/task.yaml")):
        seen.clear()
        try:
            fj.diagnose_task(fj.load_task(file))
        except Chosen as chosen:
            if len(seen) > 1:
                plain, slow = seen[:2]
                whole, each = np.log(slow.sum() / plain.sum()) / 2, np.mean(np.log(slow / plain)) / 2
                print(
                    f"{file.parent.name}: {chosen.args[0]}, together {whole:+.4f}, joint by joint {each:+.4f}",
                    flush=True,
                )
        except fj.InputError:
            continue


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["tx40", "gains", "trust", "irb120", "slowed"])
    parser.add_argument("sides", nargs="*", metavar="NAME=FOLDER")
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("parity_kept"))
    args = parser.parse_intermixed_args()
    sides = {name: Path(folder).resolve() for name, folder in (one.split("=", 1) for one in args.sides)}
    kept = args.cases.resolve(), args.out.resolve(), sides
    if args.what == "slowed":
        slowed(args.cases.resolve())
    elif args.what == "trust":
        gains(*kept, trusts=(0.049, 0.051, 0.1))
    else:
        {"tx40": tx40, "gains": gains, "irb120": irb120}[args.what](*kept)


if __name__ == "__main__":
    main()
