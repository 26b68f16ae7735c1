"""Model files with wrong links: whether `diagnose` tells what is wrong with them, over fresh seeds.

    python benchmarks/wrong_links.py --seeds 1 2 3 [--kinds hand moved rotor rotors load gain right]

Each is a bench arm of `tests/wrong_links.py`, whose recordings Pinocchio makes: a hand that is not mounted, a forearm
whose mass lies elsewhere, a rotor, rotors at every joint, these with a load, one gain of all torques, or links that are
as believed. One line a run: `right` is told first (also where the search names it), `alike` among what does as well,
`beside` something else that is there; a name is `wrong` where a cause is named that is not there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import wrong_links

import figaroh_jax as fj
from figaroh_jax.diagnosis.diagnosis import diagnose
from figaroh_jax.formats.robotfile import welded_to


def run(kind: str, seed: int) -> str:
    """The word for what is told of the links, the number that is told, the verdict with what it names."""
    with tempfile.TemporaryDirectory() as folder:
        wrong = wrong_links.KINDS[kind](Path(folder), seed)
        model = fj.load_urdf(wrong.file)
        found = diagnose(model, wrong.recordings, fj.Preprocess(cutoff=10), welded=welded_to(model, wrong.file))
    first = found.links.moved[0] if found.links is not None and found.links.moved else None
    named = {cause.name for cause in found.causes}
    numbers = {} if first is None else first.numbers
    if wrong.told in named:
        word = "right"
        numbers = next(cause.parameters for cause in found.causes if cause.name == wrong.told)
    elif first is None:
        word = "right" if wrong.told is None else "silent"
    elif first.name == wrong.told:
        word = "right"
    else:
        word = "alike" if wrong.told in first.instead else "beside" if first.name in wrong.beside else "other"
    size = f", {wrong.number} {numbers[wrong.number].value:.3g} for {wrong.size:.3g}" if wrong.number in numbers else ""
    note = f" ({first.note})" if first is not None and first.note else ""
    names = "+".join(map(str, sorted(named))) or "-"
    false = " wrong name" if named - {wrong.told, *wrong.beside} else ""
    return f"{word}{size}; told {first and first.name}{note}; {found.verdict} {names}{false}"


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--kinds", nargs="+", choices=wrong_links.KINDS, default=list(wrong_links.KINDS))
    args = parser.parse_args()
    for kind in args.kinds:
        for seed in args.seeds:
            print(f"{kind} {seed}: {run(kind, seed)}", flush=True)


if __name__ == "__main__":
    main()
