"""The report: one self-contained page, everything escaped, readable in a browser at both sizes and in print."""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import browser
import fake_diagnosis
import numpy as np
import pytest
from rich.console import Console

from figaroh_jax import DEMO
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.reporting import report
from figaroh_jax.reporting.picture import robot_picture
from figaroh_jax.reporting.provenance import provenance
from figaroh_jax.reporting.terminal import show, summary
from figaroh_jax.reporting.wording import error, fall, interval, number, phrase, sentence
from figaroh_jax.results import Diagnosis, Estimate, Experiment, Gain, Name, Nearest, Part, Rest

LAPTOP, PHONE = (1280, 800), (390, 844)
VARIANTS = {name: getattr(fake_diagnosis, name)() for name in ("named", "partly", "unknown", "nothing")}
HOSTILE = '</script><img src=x onerror="window.hacked=1">{{ 7 * 7 }}&\'[b]'


def _written(diagnosis: Diagnosis, folder: Path, title: str = "tx40") -> Path:
    path = folder / "report.html"
    report.write_report(diagnosis, path, title)
    return path


def _own(path: Path) -> str:
    """The page without the plotting library."""
    return re.sub(r'(?s)<script type="text/plain" id="plotly">.*?</script>', "", path.read_text("utf-8"))


def test_sentence_names_cause_place_and_gain():
    one = replace(VARIANTS["named"], causes=VARIANTS["named"].causes[:1], holdout=Gain(0.139, 0.0718))
    assert sentence(one, "tx40") == (
        "The simulation of tx40 is missing transmission coupling at joint_5 + joint_6: "
        "its error on held-out data falls from 13.9 % to 7.2 %."
    )


def test_sentence_says_which_alternative_remains():
    assert "rotor inertia at joint_3 (or link inertia at link_3)" in sentence(VARIANTS["named"], "tx40")


def test_sentence_names_nothing_where_nothing_or_no_name_was_found():
    assert "no missing effect is detectable" in sentence(VARIANTS["nothing"], "tx40")
    assert "consistent with noise" in sentence(VARIANTS["nothing"], "tx40")
    assert "no effect in the catalogue explains" in sentence(VARIANTS["unknown"], "tx40")
    assert "remains unexplained" in sentence(VARIANTS["partly"], "tx40")


def test_what_is_more_than_noise_is_not_called_noise_where_it_does_not_count():
    quiet = VARIANTS["nothing"]
    told = replace(quiet, p_value=0.0025, rest=replace(quiet.rest, tolerated="it is small"))
    assert "not noise alone (p < 0.01), but it is small" in sentence(told, "tx40")
    assert "consistent with noise" not in sentence(told, "tx40")


@pytest.mark.parametrize(("variant", "said"), [("partly", "joint_2, 0.4 N m"), ("unknown", "joint_4: 0.31 N m")])
def test_a_rest_is_told_with_its_size_on_page_and_terminal(variant: str, said: str, tmp_path: Path):
    whole = f"2.4 % of the torque of joint_2; {said}"  # where most is left, then what else is known
    console = Console(width=300, record=True, file=io.StringIO())
    console.print(summary(VARIANTS[variant], "tx40"))
    assert f"Unexplained residual: {whole}" in console.export_text()
    assert whole in _own(_written(VARIANTS[variant], tmp_path)).replace("\xa0", " ")


def test_what_data_cannot_tell_from_noise_is_not_called_agreement(tmp_path: Path):
    quiet = VARIANTS["nothing"]
    relative = np.array([0.0, 0.013, 0.0, 0.104, 0.0, 0.0])
    left = Rest(relative, undecided="16 s of motion without repeats (702 rows a joint) are not enough to tell that")
    told = replace(quiet, rest=left, experiment=Experiment("about 70 s of such motion in all"))
    said = sentence(told, "tx40")
    assert "agrees with the data" not in said and "consistent with noise" not in said
    assert "up to 10.4 % of the torque of joint_4 is left, and 16 s of motion" in said
    console = Console(width=300, record=True, file=io.StringIO())
    console.print(summary(told, "tx40"))
    shown = console.export_text()
    assert said in shown and "Measure next: about 70 s of such motion in all" in shown
    page = _own(_written(told, tmp_path)).replace("\xa0", " ")
    assert "nothing can be named" in page and "nothing missing" not in page
    assert "agrees with the data" not in page and "consistent with noise" not in page
    assert "Up to 10.4 % of the torque of joint_4 is left" in page and "About 70 s of such motion" in page


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (Estimate(0.01127, 0.00021, "kg m2"), "0.01127 ± 0.00041 kg m²"),
        (Estimate(-1.957, 0.5, "N m"), "−1.96 ± 0.98 N m"),
        (Estimate(123.4, 20.0, "N m/rad"), "123 ± 39 N m/rad"),
        (Estimate(1.0, 0.0, ""), "1"),
        (Estimate(0.5, float("nan"), "s"), "0.5 s"),
        (Estimate(2.5e-9, 1e-10, "rad"), "(2.50 ± 0.20) × 10⁻⁹ rad"),
        (Estimate(3.2e7, 1e6, "N m/rad"), "(3.20 ± 0.20) × 10⁷ N m/rad"),
        (Estimate(1.5, 1e-9, "rad"), "1.500000 ± 2e−09 rad"),
        (Estimate(1.5e-6, 1e-14, "s"), "(1.500000 ± 2e−08) × 10⁻⁶ s"),
        (Estimate(0.24, 1.5e4, "rad"), "not determined by this data"),
    ],
)
def test_interval_shows_the_digits_that_count(estimate: Estimate, text: str):
    assert interval(estimate) == text


def test_relative_errors_are_percentages_and_others_keep_their_unit():
    assert error(0.00213, "relative RMS") == "0.21 %"
    assert error(1.5, "N m") == "1.5 N m"
    assert error(float("nan"), "relative RMS") == "unknown"


def test_a_small_fall_is_told_with_the_digits_that_show_it():
    assert fall(0.0573, 0.0271, "relative RMS") == ("5.7 %", "2.7 %")
    assert fall(0.02641, 0.02551, "relative RMS") == ("2.64 %", "2.55 %")
    assert fall(0.02641, 0.02635, "relative RMS") == ("2.64 %", "2.63 %")
    assert fall(0.004031, 0.004028, "rad") == ("4.031 mrad", "4.028 mrad")
    assert fall(0.02, 0.02, "relative RMS") == ("2.0 %", "2.0 %")


def test_effect_outside_the_catalogue_still_reads_as_words():
    assert phrase(Name("sticky_cable", ("j1",))) == "sticky cable at j1"


@pytest.mark.parametrize("variant", VARIANTS)
def test_page_asks_for_nothing_from_outside(variant: str, tmp_path: Path):
    own = _own(_written(VARIANTS[variant], tmp_path))
    assert not re.search(r'(?:src|href)="(?!#|data:)|@import|url\(|https?://', own)


def test_page_escapes_every_name_that_a_user_chooses(tmp_path: Path):
    path = _written(_hostile(), tmp_path, HOSTILE)
    own = _own(path)
    assert "<img" not in own and "{{ 7" in own and "49" not in re.findall(r"<h1.*?</h1>", own)[0]
    assert own.count("</script>") == 4 and path.read_text("utf-8").count("</script>") == 5


def test_page_stays_light_beside_the_plotting_library(tmp_path: Path):
    assert len(_own(_written(VARIANTS["named"], tmp_path))) < 400_000


def test_page_survives_numbers_that_are_not_finite(tmp_path: Path):
    clean = VARIANTS["named"]
    broken = replace(
        clean,
        p_value=float("nan"),
        noise=np.full(6, np.nan),
        holdout=Gain(float("nan"), float("inf")),
        traces=(replace(clean.traces[0], velocity=np.full_like(clean.traces[0].velocity, np.nan)),),
    )
    own = re.sub(r"[A-Za-z0-9+/=]{40,}", "", _own(_written(broken, tmp_path)))  # less the packed channels
    assert not re.search(r"\b(nan|inf|infinity)\b", own, re.IGNORECASE)


def test_page_opens_the_joint_with_most_to_explain_where_no_cause_is_named(tmp_path: Path):
    assert re.findall(r'id="(joint-\d)" data-joint="\d" open', _own(_written(VARIANTS["unknown"], tmp_path))) == [
        "joint-5"
    ]


def test_page_shows_a_held_out_recording_that_has_no_torque(tmp_path: Path):
    blind = tuple(replace(trace, measured=None) for trace in VARIANTS["named"].traces)
    own = _own(_written(replace(VARIANTS["named"], traces=blind), tmp_path))
    stored = json.loads(re.findall(r'(?s)id="data">(.*?)</script>', own)[0])
    assert set(stored["recordings"][1][0]) == {"time", "position", "velocity", "before", "after"}


def test_thinning_keeps_every_peak():
    rng = np.random.default_rng(3)
    signal = rng.standard_normal((10_000, 2))
    signal[[1234, 8765], [0, 1]] = 50.0
    rows = report._thinned(signal, 500)
    assert rows.shape[0] <= 500 and (np.diff(rows, axis=0) >= 0).all()
    assert 1234 in rows[:, 0] and 8765 in rows[:, 1]


def test_packing_keeps_a_channel_to_a_thirty_thousandth_of_its_range():
    values = np.random.default_rng(4).standard_normal(1000) * 30.0
    values[7] = np.nan
    packed = report._packed(values)
    steps = np.frombuffer(base64.b64decode(packed["d"]), "<i2")
    assert steps[7] == -32768
    kept = np.isfinite(values)
    back = packed["o"] + packed["s"] * steps[kept]
    np.testing.assert_allclose(back, values[kept], rtol=0, atol=np.ptp(values[kept]) / 60_000)


@pytest.mark.parametrize(("value", "told"), [(99.6, "100"), (-123.4, "−120"), (0.0123, "0.012"), (3.2e9, "3.2e+09")])
def test_numbers_of_a_few_digits_are_written_out(value: float, told: str):
    assert number(value, 2) == told


@pytest.mark.parametrize("variant", VARIANTS)
def test_lines_of_the_summary_end_in_no_space(variant: str, capsys):
    show(VARIANTS[variant], "tx40")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 5 and not [line for line in lines if line != line.rstrip()]


def test_page_tells_errors_that_are_nearly_alike_by_the_digits_of_its_headline(tmp_path: Path):
    near = replace(VARIANTS["partly"], holdout=Gain(0.0274, 0.0266))
    own = _own(_written(near, tmp_path)).replace("\xa0", " ")
    assert "<b>2.74 %</b>" in own and "<b>2.66 %</b>" in own


def test_page_that_leaves_a_rest_does_not_say_that_nothing_is_open(tmp_path: Path):
    sure = replace(VARIANTS["partly"], experiment=None)
    own = _own(_written(sure, tmp_path))
    assert "no ambiguity is left" not in own and "for the rest, look at the plots below" in own


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[browser.Page]:
    if browser.find() is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium runs the report's browser tests")
    with browser.page(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.parametrize("size", [LAPTOP, PHONE], ids=["laptop", "phone"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_browser_shows_the_finding_on_the_first_screen(
    tab: browser.Page, variant: str, size: tuple[int, int], tmp_path: Path
):
    tab.open(_written(VARIANTS[variant], tmp_path), *size, phone=size == PHONE)
    shown = tab.value("document.getElementById('verdict').textContent")
    assert shown.replace("\xa0", " ") == sentence(VARIANTS[variant], "tx40")
    for part in ("#verdict", ".found", ".gain", ".apart", ".next"):
        bottom = tab.value(f"document.querySelector('{part}').getBoundingClientRect().bottom")
        assert 0 < bottom <= size[1], f"{part} ends at {bottom}"
    assert tab.value("document.documentElement.scrollWidth") <= size[0]
    assert tab.problems == []


def test_browser_keeps_the_names_of_joints_whole_on_a_phone(tab: browser.Page, tmp_path: Path):
    """On one line each, in every table of joints, beside whatever the residual varies with."""
    joints = tuple(f"lwr_{k}_joint" for k in range(6))
    parts = tuple(replace(part, at=(joints[1],)) for part in VARIANTS["partly"].rest.parts)
    rest = replace(VARIANTS["partly"].rest, parts=parts)
    tab.open(_written(replace(VARIANTS["partly"], joints=joints, rest=rest), tmp_path), *PHONE, phone=True)
    names = "[...document.querySelectorAll('table.joints tbody th, table.anatomy tbody th')]"
    tab.value(f"{names}.forEach((th) => {{ th.innerHTML = `<span>${{th.textContent}}</span>`; }})")
    lines = tab.value(f"{names}.map((th) => th.firstChild.getClientRects().length)")
    assert len(lines) == 18 and set(lines) == {1}


@pytest.mark.parametrize(
    ("size", "dark"),
    [pytest.param(LAPTOP, False, marks=pytest.mark.slow), (PHONE, False), (LAPTOP, True)],
    ids=["laptop", "phone", "dark"],
)
def test_browser_draws_the_plots_of_every_joint(tab: browser.Page, size: tuple[int, int], dark: bool, tmp_path: Path):
    tab.open(_written(VARIANTS["named"], tmp_path), *size, phone=size == PHONE, dark=dark)
    _unfold(tab)
    lines = tab.value("[...document.querySelectorAll('.plot.tall')].map((p) => p.querySelectorAll('.js-line').length)")
    assert lines == [5] * 6  # measured, two simulated, two residuals
    points = tab.value(
        "[...document.querySelectorAll('.plot:not(.tall)')].map((p) => p.querySelectorAll('.point').length)"
    )
    assert len(points) == 12 and min(points) == 2 * 900  # before and after, at every sample of the held-out recording
    assert tab.value("document.documentElement.scrollWidth") <= size[0]
    assert tab.value("document.getElementById('trouble').hidden")
    assert tab.problems == []


def test_browser_redraws_for_another_recording(tab: browser.Page, tmp_path: Path):
    tab.open(_written(VARIANTS["named"], tmp_path), *LAPTOP)
    tab.value("document.querySelector('details.joint[open]').scrollIntoView()")
    tab.wait("document.querySelector('details.joint[data-drawn]') !== null")
    last = "Math.max(...document.querySelector('details.joint[data-drawn] .tall').data[0].x)"
    assert tab.value(last) == pytest.approx(8.99, abs=1e-3)
    tab.value(
        "(() => { const s = document.getElementById('recording'); s.value = '0'; "
        "s.dispatchEvent(new Event('change')); })()"
    )
    assert tab.value(last) == pytest.approx(39.99, abs=0.1)
    assert tab.problems == []


def test_browser_draws_predictions_of_a_recording_without_torque(tab: browser.Page, tmp_path: Path):
    blind = tuple(replace(trace, measured=None) for trace in VARIANTS["named"].traces)
    tab.open(_written(replace(VARIANTS["named"], traces=blind), tmp_path), *LAPTOP)
    tab.value("document.querySelector('details.joint[open]').scrollIntoView()")
    tab.wait("document.querySelector('details.joint[data-drawn]') !== null")
    drawn = "document.querySelector('details.joint[data-drawn]')"
    assert tab.value(f"{drawn}.querySelectorAll('.js-line').length") == 2
    assert tab.value(f"{drawn}.querySelectorAll('figure[hidden]').length") == 2
    assert tab.problems == []


def test_browser_runs_nothing_that_a_name_smuggles_in(tab: browser.Page, tmp_path: Path):
    tab.open(_written(_hostile(), tmp_path, HOSTILE), *LAPTOP)
    _unfold(tab)
    assert tab.value("window.hacked === undefined")
    assert tab.value("document.getElementById('verdict').textContent").count(HOSTILE) >= 1
    assert tab.problems == []


@pytest.mark.parametrize(("variant", "dark"), [("partly", False), ("partly", True), ("nothing", False)])
def test_axe_finds_no_violation(tab: browser.Page, variant: str, dark: bool, tmp_path: Path):
    """Names, contrast, order of headings, nesting: the rules of axe-core; `benchmarks/pages.py` unfolds every plot."""
    axe = importlib.util.find_spec("axe_core_python")
    assert axe is not None and axe.submodule_search_locations
    tab.open(_written(VARIANTS[variant], tmp_path), *LAPTOP, dark=dark)
    tab.value("document.querySelectorAll('details.more').forEach((d) => { d.open = true; })")
    tab.value(Path(axe.submodule_search_locations[0], "axe.min.js").read_text("utf-8") + ";undefined")
    rules = "{runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'best-practice']}"
    found = tab.value(
        f"axe.run({{exclude: ['.main-svg']}}, {rules}).then((r) => r.violations.map((v) => v.id + v.nodes[0].html))"
    )
    assert found == []


def test_browser_zooms_the_plots_beside_the_time_and_gives_the_parameters_as_csv(tab: browser.Page, tmp_path: Path):
    tab.open(_written(VARIANTS["named"], tmp_path), *LAPTOP)
    tab.value("document.querySelector('details.joint[open]').scrollIntoView()")
    tab.wait("document.querySelector('details.joint[data-drawn]') !== null")
    drawn = "document.querySelector('details.joint[data-drawn]')"
    tab.value(f"Plotly.relayout({drawn}.querySelector('.tall'), {{'xaxis.range': [1.0, 2.0]}}).then(() => null)")
    shown = f"{drawn}.querySelector('[data-plot=position]').data[0].y.filter((y) => y !== null).length"
    tab.wait(f"{shown} < 150")
    tab.value("HTMLAnchorElement.prototype.click = function () { window.saved = [this.download, this.href]; }")
    tab.value("document.querySelector('button[data-to=file]').dispatchEvent(new Event('click'))")
    name, address = tab.value("window.saved")
    rows = unquote(address).split("utf-8,")[1].splitlines()
    cause = VARIANTS["named"].causes[0]
    first, estimate = next(iter(cause.parameters.items()))
    assert name == "parameters.csv" and rows[0] == "effect,at,parameter,value,std,unit"
    expected = [cause.name.effect, " ".join(cause.name.at), first, repr(estimate.value), repr(estimate.std)]
    assert rows[1].split(",")[:5] == expected
    assert tab.problems == []


def test_what_made_a_run_stands_at_the_foot_and_the_page_stays_below_its_size(tmp_path: Path):
    task = tmp_path / "task.yaml"
    task.write_text("robot: {}")
    (tmp_path / "provenance.json").write_text(provenance("diagnose", task, [task], "native"))
    rng = np.random.default_rng(2)
    wide = {key: rng.normal(size=(6000, 6)) for key in ("position", "velocity", "before", "after", "measured")}
    traces = tuple(
        replace(trace, time=np.arange(6000) * 0.01, shares={}, **wide) for trace in VARIANTS["named"].traces * 8
    )
    path = _written(replace(VARIANTS["named"], traces=traces), tmp_path)
    assert "What made this run" in _own(path) and "sha256" in _own(path)
    assert path.stat().st_size < 1_500_000


def test_a_picture_shows_the_robot_and_names_what_is_affected():
    model = load_urdf(DEMO)
    text = robot_picture(model, affected={"elbow"})
    found = ElementTree.fromstring(text)  # noqa: S314 (the library's own text)
    assert "affected: elbow" in found.attrib["aria-label"] and len(found.findall("circle")) == len(model.joints)
    assert [one.text for one in found.findall("text")] == ["elbow"]
    moved = robot_picture(model, affected=(), nominal=model, magnify=20.0)
    assert moved.count('class="nominal"') == len(model.joints) + 1


_BOXES = """((s) => [...document.querySelectorAll(s)].map((e) => {
  const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; }))"""


@pytest.mark.parametrize("affected", [(0,), (1, 2), (0, 1, 2, 3)])
def test_names_in_a_picture_touch_neither_each_other_nor_the_robot(
    affected: tuple[int, ...], tab: browser.Page, tmp_path: Path
):
    """By the boxes that the browser draws; long names do not leave the picture."""
    style = Path(report.__file__).parents[1].joinpath("page", "report.css").read_text("utf-8")
    for longer in ("", "_of_the_left_arm_of_the_robot"):
        model = load_urdf(DEMO)
        joints = tuple(joint._replace(name=joint.name + longer) for joint in model.joints)
        text = robot_picture(replace(model, joints=joints), affected={joints[k].name for k in affected})
        page = tmp_path / "picture.html"
        page.write_text(f'<meta charset="utf-8"><style>{style}</style><figure class="robot">{text}</figure>')
        tab.open(page, *LAPTOP)
        parts = ("svg text", "svg circle, svg path.link, svg path.hit", "svg")
        names, others, (whole,) = (tab.value(f"{_BOXES}('{part}')") for part in parts)
        assert len(names) == len(affected) and len(others) > len(joints)
        for k, (left, top, right, bottom) in enumerate(names):
            for a, b, c, d in (*names[:k], *others):
                assert right <= a or c <= left or bottom <= b or d <= top
            assert whole[0] <= left and right <= whole[2] and whole[1] <= top and bottom <= whole[3]


def test_browser_prints_every_joint(tab: browser.Page, tmp_path: Path):
    tab.open(_written(VARIANTS["named"], tmp_path), *LAPTOP)
    tab.wait("window.Plotly !== undefined")
    assert tab.pdf().startswith(b"%PDF")
    assert tab.value("document.querySelectorAll('details.joint[data-drawn]').length") == 6
    assert tab.problems == []


def _unfold(tab: browser.Page) -> None:
    """Open every joint and scroll to it, as a reader would, for the plots are drawn when they come into sight."""
    for index in range(6):
        joint = f"document.getElementById('joint-{index}')"
        tab.value(f"(() => {{ const joint = {joint}; joint.open = true; joint.scrollIntoView(); }})()")
        tab.wait(f"'drawn' in {joint}.dataset")


def _hostile() -> Diagnosis:
    clean = VARIANTS["named"]
    joints = (HOSTILE, *clean.joints[1:])
    cause = replace(
        clean.causes[0], name=Name(HOSTILE, (HOSTILE,)), note=HOSTILE, ambiguous_with=(Name("x", (HOSTILE,)),)
    )
    name, part = Name(HOSTILE, (HOSTILE,)), Part("recording", (HOSTILE,), 0.3, file=HOSTILE)
    traces = tuple(replace(trace, name=HOSTILE, shares={HOSTILE: trace.before}) for trace in clean.traces)
    return replace(
        clean,
        verdict="named+rest",
        joints=joints,
        causes=(cause,),
        traces=traces,
        rest=Rest(np.full(6, 0.1), (part,), (Nearest(name, 0.2, HOSTILE),), HOSTILE),
        notes=(HOSTILE,),
        holdout_scheme=HOSTILE,
        candidates=(replace(clean.candidates[0], name=Name(HOSTILE, (HOSTILE,))),),
    )
