"""`python -m benchmarks.pages REPORT/index.html --out FILE.json`: axe-core on a report and the live page.

Needs `pip install playwright axe-playwright-python` and chromium on the PATH. --shots DIR saves screenshots.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from dejavu_torch import open_source
from dejavu_torch.data.camera import Frame
from dejavu_torch.live.localizer import LiveMatch
from dejavu_torch.live.page import Page, Snapshot, as_picture

WIDTHS, HEIGHT = (360, 800, 1600), 900
SCHEMES = ("light", "dark")
OPEN = "all => all.forEach(one => one.open = true)"


@contextmanager
def live_page(places: int = 256) -> Iterator[str]:
    """The address of a live page that shows one accepted frame."""
    first, second = (
        next(open_source(f"sim:aerial?frames={places}&traverse={one}").batches(places)) for one in (0, 1)
    )
    place = places // 2
    posterior = torch.exp(-(((torch.arange(places + 1.0) - place) / 3) ** 2)) + 1e-4
    posterior /= posterior.sum()
    score = -math.log(posterior[place])
    match = LiveMatch(place, place, "", score, float(posterior[place]), 0.99, True, 12.5)
    pixels = (second[place].permute(1, 2, 0).clamp(0, 1) * 255).byte().numpy()
    snapshot = Snapshot(Frame(place, 4.2, pixels), match, posterior, True, place, 3, 11.0, 19.0)
    with Page(0, "a camera on a map", lambda frame: (frame, as_picture(first[frame]))) as page:
        page.show(snapshot)
        yield page.url


def check_pages(addresses: Mapping[str, str], shots: Path | None = None) -> dict[str, Any]:
    """Run axe-core on pages, by name, at three widths, light and dark, with all folds open.

    Returns:
        Versions, and a row for each page, width and scheme: `violations` as [impact, rule, elements], and
        `overflow`, by how many pixels the page is wider than the window.
    """
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import sync_playwright

    rows, axe = [], Axe()
    with sync_playwright() as engines:
        browser = engines.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for name, address in addresses.items():
            for width in WIDTHS:
                for scheme in SCHEMES:
                    size: Any = {"width": width, "height": HEIGHT}
                    page = browser.new_page(viewport=size, color_scheme=scheme)
                    page.goto(address)
                    page.wait_for_function("[...document.images].every(one => one.complete)")
                    page.wait_for_timeout(500)  # until the live page has its state
                    if shots is not None:
                        page.screenshot(path=shots / f"{name}_{width}_{scheme}.png")
                    page.eval_on_selector_all("details", OPEN)
                    if shots is not None:
                        page.screenshot(path=shots / f"{name}_{width}_{scheme}_all.png", full_page=True)
                    found = axe.run(page).response
                    overflow = page.evaluate("document.documentElement.scrollWidth - innerWidth")
                    seen = [[one["impact"], one["id"], len(one["nodes"])] for one in found["violations"]]
                    row = {"page": name, "width": width, "scheme": scheme, "overflow": max(0, overflow)}
                    rows.append(row | {"passes": len(found["passes"]), "violations": seen})
                    page.close()
        versions = {"axe-core": found["testEngine"]["version"], "chromium": browser.version}
    return {"versions": versions, "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shots", type=Path)
    given = parser.parse_args()
    if given.shots is not None:
        given.shots.mkdir(exist_ok=True)
    with live_page() as live:
        found = check_pages({"report": given.report.resolve().as_uri(), "live": live}, given.shots)
    rows = ",\n  ".join(json.dumps(row) for row in found["rows"])
    versions = json.dumps(found["versions"])
    given.out.write_text(f'{{"versions": {versions},\n "rows": [\n  {rows}]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
