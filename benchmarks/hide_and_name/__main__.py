"""Effects hidden in made recordings: inverse dynamics, closed loop with stiction, postures; any tool can be entered.

    python -m benchmarks.hide_and_name generate --cases CASES --seed 0 --jobs 4   # needs Pinocchio, MuJoCo, robot files
    python -m benchmarks.hide_and_name run --cases CASES --out RUNS --jobs 30     # needs numpy and the tool
    python -m benchmarks.hide_and_name score --cases CASES --out RUNS             # tables, and RUNS/results.json

`generate` and `run` take up where they were stopped. `--kinds` and `--only WORD ...` keep parts of the cases;
`--modes forbidden` is the catalogue without what is hidden.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from .. import blackbox
from .scoring import score

KINDS = ("inverse", "closed_loop", "kinematic")


def main() -> None:
    """Generate, run or score, as the arguments ask."""
    args = _arguments()
    if args.step == "generate":
        from .generate import generate

        args.cases.mkdir(parents=True, exist_ok=True)
        generate(args.cases, args.seed, args.kinds, args.clean, args.jobs, args.only)
        return
    cases = blackbox.load_cases(args.cases, args.only)
    if args.step == "run":
        command = args.command or blackbox.default_command()
        blackbox.run(args.cases, args.out, cases, command, args.jobs, args.limit, args.modes)
    else:
        print(score(cases, args.out, args.modes))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(dest="step", required=True)
    made = steps.add_parser("generate", help="write the cases")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    made.add_argument("--clean", type=int, default=40, metavar="N", help="cases of each kind without any effect")
    called = steps.add_parser("run", help="call the command for every case")
    called.add_argument("--command", help=f"default: {blackbox.COMMAND}; `here MODULE:FUNCTION ...`: in this process")
    called.add_argument("--limit", type=float, default=1800, help="s of one call")
    told = steps.add_parser("score", help="compare the answers with the truth")
    for step in (made, called):
        step.add_argument("--jobs", type=int, default=1)
    for step in (called, told):
        step.add_argument("--modes", nargs="+", choices=["named", "forbidden"], default=["named", "forbidden"])
        step.add_argument("--out", type=Path, required=True)
    for step in (made, called, told):
        step.add_argument("--only", nargs="+", default=[], metavar="WORD")
        step.add_argument("--cases", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
