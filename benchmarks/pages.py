"""Pages in a browser: size, time to load, accessibility by axe-core, what the Tab key reaches, screenshots.

`python benchmarks/pages.py RUN_DIR... --shots FOLDER` opens every `report.html` (or a page named itself) in Chromium at
1300 and 390 px, light and dark, without network, and prints one line each; exit status 1 where axe finds a violation.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import browser  # noqa: E402

SIZES = {"wide": (1300, 900), "phone": (390, 844)}


def axe_source() -> str:
    """axe-core's script, from the package that the tests install."""
    spec = importlib.util.find_spec("axe_core_python")
    assert spec is not None and spec.submodule_search_locations, "pip install axe-core-python"
    return Path(spec.submodule_search_locations[0], "axe.min.js").read_text(encoding="utf-8")


def violations(tab: browser.Page, source: str) -> list[dict[str, Any]]:
    """What axe finds on the page as it stands, with every part unfolded."""
    tab.value("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    for joint in range(tab.value("document.querySelectorAll('details.joint').length")):
        one = f"document.querySelectorAll('details.joint')[{joint}]"  # plots are drawn when they come into sight
        tab.value(f"{one}.scrollIntoView()")
        tab.wait(f"'drawn' in {one}.dataset")
    time.sleep(0.8)
    tab.value(f"{source};undefined")
    rules = "{runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'best-practice']}"
    return tab.value(
        f"axe.run({{exclude: ['.main-svg']}}, {rules}).then((r) => r.violations.map((v) => ({{id: v.id, help: v.help,"
        " nodes: v.nodes.slice(0, 3).map((n) => n.html.slice(0, 160) + ' | ' + (n.any[0] || {}).message)})))"
    )


FOCUSABLE = "a[href], button, select, input, summary, [tabindex='0']"
SEEN = """(() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const box = e.getBoundingClientRect(), style = getComputedStyle(e);
  const ring = (style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) > 0) || style.boxShadow !== 'none';
  const inside = box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
  e.dataset.reached = '';
  return [e.tagName + ' ' + (e.getAttribute('aria-label') || e.textContent.trim()).slice(0, 40), ring, inside];
})()"""


def keyboard(tab: browser.Page) -> list[str]:
    """What the Tab key does not reach, or reaches without a ring around it or outside of the window."""
    tab.value("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    tab.value("(() => { scrollTo(0, 0); document.activeElement.blur(); })()")
    shown = f'[...document.querySelectorAll("{FOCUSABLE}")].filter((e) => e.checkVisibility() && !e.disabled)'
    wrong = []
    for _ in range(tab.value(f"{shown}.length") + 400):
        tab.press("Tab", 9)
        found = tab.value(SEEN)
        if found is None:
            break
        name, ring, inside = found
        wrong += [f"no ring: {name}"] if not ring else []
        wrong += [f"outside of the window: {name}"] if not inside else []
    label = "(e.getAttribute('aria-label') || e.textContent.trim()).slice(0, 40)"
    missed = tab.value(f"{shown}.filter((e) => !('reached' in e.dataset)).map((e) => e.tagName + ' ' + {label})")
    return [*dict.fromkeys(wrong), *(f"not reached: {name}" for name in missed)]


def docs_pictures(page: Path, folder: Path) -> int:
    """The first screen in light and dark, as the docs show it."""
    with tempfile.TemporaryDirectory() as profile, browser.page(Path(profile)) as tab:
        for name, dark in (("report", False), ("report_dark", True)):
            tab.open(page.resolve(), *SIZES["wide"], dark=dark)
            time.sleep(1.5)
            tab.screenshot(folder / f"{name}.png")
    return 0


def view_picture(run: Path, file: Path) -> int:
    """The robot of a run in its 3D view (extra `view`), rendered without a graphics card."""
    from figaroh_jax.reporting.robot_view import show_run

    server = show_run(run, VIEW_PORT)
    software = ("--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader")
    try:
        with tempfile.TemporaryDirectory() as profile, browser.page(Path(profile), software) as tab:
            tab.open_address(f"http://localhost:{VIEW_PORT}", 1100, 640)
            time.sleep(10.0)
            tab.value("document.querySelectorAll('.mantine-Notification-closeButton').forEach((b) => b.click())")
            time.sleep(2.0)
            tab.screenshot(file)
    finally:
        server.stop()
    return 0


VIEW_PORT = 18099


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--shots", type=Path, help="folder of the screenshots")
    parser.add_argument("--axe", type=Path, help="another axe.min.js than that of axe-core-python")
    parser.add_argument("--docs", type=Path, help="write report.png and report_dark.png of the first page, and stop")
    parser.add_argument("--view", type=Path, help="write a picture of the first run's 3D view here, and stop")
    asked = parser.parse_args()
    if asked.view:
        return view_picture(asked.pages[0], asked.view)
    if asked.docs:
        return docs_pictures(asked.pages[0] / "report.html", asked.docs)
    source = asked.axe.read_text(encoding="utf-8") if asked.axe else axe_source()
    if asked.shots:
        asked.shots.mkdir(parents=True, exist_ok=True)
    found = 0
    with tempfile.TemporaryDirectory() as folder, browser.page(Path(folder)) as tab:
        for given in asked.pages:
            page = (given / "report.html" if given.is_dir() else given).resolve()
            for name, size in SIZES.items():
                for dark in (False, True):
                    started = time.perf_counter()
                    tab.open(page, *size, phone=name == "phone", dark=dark)
                    loaded = time.perf_counter() - started
                    time.sleep(1.0)
                    label = f"{given.stem if given.suffix else given.name}_{name}_{'dark' if dark else 'light'}"
                    if asked.shots:
                        tab.screenshot(asked.shots / f"{label}_first.png")
                    wrong = violations(tab, source)
                    if asked.shots:
                        tab.screenshot(asked.shots / f"{label}.png", whole=True)
                    keys = keyboard(tab) if not dark else []
                    wide = tab.value("document.documentElement.scrollWidth")
                    found += len(wrong) + len(keys) + len(tab.problems) + (wide > size[0])
                    print(
                        f"{label}: {page.stat().st_size / 1e6:.2f} MB, loaded in {1e3 * loaded:.0f} ms, width {wide},"
                        f" {len(wrong)} violations, {len(tab.problems)} problems on the console"
                        + ("" if dark else f", {len(keys)} of the keyboard")
                    )
                    print(*(f"    {key}" for key in keys), sep="\n", end="\n" if keys else "")
                    for one in wrong:
                        print("   ", one["id"], one["help"], *one["nodes"], sep="\n      ")
                    for problem in tab.problems:
                        print("   ", problem[:300])
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
