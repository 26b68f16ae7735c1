"""The page of an identification: the report's style and plots around its own tables."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np

from ..identification.result import Identification
from .report import page_template, plot_data, plotly_source

__all__ = ["write_identification"]


def write_identification(found: Identification, path: Path, title: str) -> None:
    """Write the page of an identification to `path`; `title` is the robot's name."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    roles = [trace.role for trace in found.traces]
    text = page_template("identification.html").render(
        d=found,
        robot=title,
        columns={"given links": found.nominal, "fit": found.fit, "cross-validated": found.validated} | found.holdout,
        identified=sum(one.status == "identified" for one in found.base),
        judged=list(found.holdout.values())[-1] if found.holdout else found.validated,
        wrong=[link for link in found.links if not link.consistent],
        recordings=found.traces,
        shown=roles.index("holdout") if "holdout" in roles else 0,
        css=Markup((page / "report.css").read_text("utf-8")),
        js=Markup((page / "report.js").read_text("utf-8")),
        data=Markup(plot_data(np.zeros(len(found.joints)), found.torque_units, found.traces)),
        plotly=Markup(plotly_source()),
    )
    path.write_text(text, encoding="utf-8")
