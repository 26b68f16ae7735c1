"""Effects hidden in real recordings, each beside its untouched twin; any tool can be entered through its command line.

    python -m benchmarks.hide_in_real generate --cases CASES --seed 0           # needs Pinocchio and $FIGAROH_JAX_DATA
    python -m benchmarks.hide_in_real run --cases CASES --out RUNS --jobs 4     # needs numpy and the tool
    python -m benchmarks.hide_in_real score --cases CASES --out RUNS            # tables, and RUNS/results.json

`run` takes up where it was stopped. `--only ur10e stribeck` keeps the cases whose name holds one of the words.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from .. import blackbox
from .scoring import score


def main() -> None:
    """Generate, run or score, as the arguments ask."""
    args = _arguments()
    if args.step == "generate":
        from .generate import generate

        generate(args.cases, args.seed, args.robots, args.effects, args.sizes)
        return
    if args.step == "oracle":
        from .generate import with_oracle

        with_oracle(args.cases)
        return
    cases = blackbox.load_cases(args.cases, args.only)
    if args.step == "run":
        if args.visible:
            cases = {name: case for name, case in cases.items() if case.get("visible", True)}
        command = args.command or blackbox.default_command()
        blackbox.run(args.cases, args.out, cases, command, args.jobs, args.limit, args.modes)
    else:
        print(score(cases, args.out, args.modes))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(dest="step", required=True)
    made = steps.add_parser("generate", help="write the cases")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--robots", nargs="+", help="default: all seven")
    made.add_argument("--effects", nargs="+", help="default: twelve for every robot")
    made.add_argument("--sizes", nargs="+", type=float, default=[0.05, 0.1, 0.2])
    asked = steps.add_parser(
        "oracle", help="tell of cases that were made before whether the kept-out data bear them out"
    )
    called = steps.add_parser("run", help="call the command for every case")
    called.add_argument("--command", help=f"default: {blackbox.COMMAND}; `here MODULE:FUNCTION ...`: in this process")
    called.add_argument("--jobs", type=int, default=1)
    called.add_argument("--limit", type=float, default=1800, help="s of one call")
    called.add_argument("--visible", action="store_true", help="without the effects that the baseline takes in")
    told = steps.add_parser("score", help="compare the answers with the truth")
    for step in (called, told):
        step.add_argument("--only", nargs="+", default=[], metavar="WORD")
        step.add_argument("--modes", nargs="+", choices=["named", "forbidden"], default=["named", "forbidden"])
        step.add_argument("--out", type=Path, required=True)
    for step in (made, asked, called, told):
        step.add_argument("--cases", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
