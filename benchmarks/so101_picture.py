"""Draws what `rollouts.py so101_sage` (or `so101_thirds --out`) printed: friction and gains beside the published ones.

python benchmarks/so101_picture.py so101_whole.txt docs/images/so101.svg
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np

JOINTS = {"shoulder_pan": "pan", "shoulder_lift": "lift", "elbow_flex": "elbow", "wrist_flex": "wrist flex",
          "wrist_roll": "wrist roll"}  # fmt: skip
KP, KD = 17.8, 0.6  # of the drives as they are stated there
FRICTION = {"Playground": 1e-4, "Menagerie": 0.052, "Isaac Lab": 0.35}
GAIN = {"reference servo": 17.8, "Isaac Lab": 48.0, "Menagerie": 998.0}
WIDTH, ROW, LEFT, PANEL, TOP = 880, 28, 96, 350, 72
BLUE, GREY, TEXT = "#2563eb", "#9ca3af", "#374151"


def numbers(text: str, name: str, factor: float) -> dict[str, tuple[float, float]]:
    """Value and half of the 95 % interval at each joint."""
    found = re.findall(rf"^ +{name} (\w+) +(\S+) \+- (\S+)$", text, re.MULTILINE)
    return {joint: (factor * float(value), factor * float(half)) for joint, value, half in found if joint in JOINTS}


def panel(
    left: float, title: str, own: dict[str, tuple[float, float]], published: dict[str, float],
    ends: tuple[float, float], log: bool,
) -> list[str]:  # fmt: skip
    """Intervals by joint, published values as lines through all of them; what is beyond the axis ends at it."""
    scale = np.log10 if log else (lambda value: np.asarray(value, float))
    low, high = scale(ends[0]), scale(ends[1])
    x = lambda value: left + PANEL * float((scale(np.clip(value, *ends)) - low) / (high - low))  # noqa: E731
    bottom = TOP + ROW * len(JOINTS) - 8
    parts = [f'<text x="{left}" y="20" font-weight="600" fill="{TEXT}">{title}</text>']
    for k, (name, value) in enumerate(published.items()):
        y, anchor = (
            44 + 15 * (k % 2),
            "start" if x(value) < left + 20 else "end" if x(value) > left + PANEL - 20 else "middle",
        )
        parts.append(
            f'<line x1="{x(value):.1f}" x2="{x(value):.1f}" y1="{y + 4}" y2="{bottom}" stroke="{GREY}" '
            f'stroke-dasharray="4 3"/><text x="{x(value):.1f}" y="{y}" text-anchor="{anchor}" fill="{TEXT}" '
            f'font-size="11">{name} {value:g}</text>'
        )
    for k, (value, half) in ((k, own[joint]) for k, joint in enumerate(JOINTS) if joint in own):
        y = TOP + 10 + ROW * k
        parts.append(
            f'<line x1="{x(value - half):.1f}" x2="{x(value + half):.1f}" y1="{y}" y2="{y}" stroke="{BLUE}" '
            f'stroke-width="6" stroke-opacity=".4"/><circle cx="{x(value):.1f}" cy="{y}" r="4.5" fill="{BLUE}"/>'
        )
    ticks = (1, 10, 100, 1000) if log else (0, 0.2, 0.4, 0.6)
    for tick in ticks:
        if ends[0] <= tick <= ends[1]:
            parts.append(f'<text x="{x(tick):.1f}" y="{bottom + 14}" text-anchor="middle" fill="{TEXT}" '
                         f'font-size="11">{tick:g}</text>')  # fmt: skip
    return parts


def main(source: str, target: str) -> None:
    text = Path(source).read_text()
    friction, gain = numbers(text, "friction", 1.0), numbers(text, "scale", KP)
    height = TOP + ROW * len(JOINTS) + 34
    parts = [f'<text x="{LEFT - 12}" y="{TOP + 14 + ROW * k}" text-anchor="end" fill="{TEXT}">{name}</text>'
             for k, name in enumerate(JOINTS.values())]  # fmt: skip
    parts += panel(LEFT, "Sliding friction, N m", friction, FRICTION, (0.0, 0.65), log=False)
    parts += panel(LEFT + PANEL + 50, "Gain, N m/rad (logarithmic)", gain, GAIN, (5.0, 1100.0), log=True)
    parts.append(f'<text x="{LEFT}" y="{height - 6}" fill="{TEXT}" font-size="11">Dots and bars: what recordings of '
                 "one arm say, with 95 % intervals. Dashed: published.</text>")  # fmt: skip
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif"'
    Path(target).write_text(
        f'{head} font-size="13" role="img" aria-label="friction and gain of five joints beside published values">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}</svg>\n'
    )


if __name__ == "__main__":
    main(*sys.argv[1:3])
