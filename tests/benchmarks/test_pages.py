"""The pages in a browser, where one is installed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from benchmarks.pages import SCHEMES, WIDTHS, check_pages, live_page
from dejavu_torch import compare, open_source
from dejavu_torch.evaluation.report import report_folder, write_report

KEPT = Path(__file__).parents[2] / "benchmarks" / "results" / "axe.json"


def test_the_kept_result_has_no_finding_at_any_width():
    kept = json.loads(KEPT.read_text())
    rows = kept["rows"]
    assert {(row["page"], row["width"], row["scheme"]) for row in rows} == {
        (page, width, scheme) for page in ("report", "live") for width in WIDTHS for scheme in SCHEMES
    }
    assert {*kept["versions"]} == {"axe-core", "chromium"}
    assert [row for row in rows if row["violations"] or row["overflow"]] == []


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_browser_finds_nothing_serious_and_nothing_too_wide(tmp_path):
    pytest.importorskip("axe_playwright_python")
    one, two = (open_source(f"sim:aerial?frames=200&traverse={i}") for i in (0, 1))
    result = compare(one, two)
    with report_folder(tmp_path / "report") as folder:
        write_report(
            folder, result.report, result.pictures, "a title", "a command", str(result.run.model.summary())
        )
    with live_page() as live:
        addresses = {"report": (tmp_path / "report" / "index.html").as_uri(), "live": live}
        rows = check_pages(addresses)["rows"]
    assert len(rows) == 2 * len(WIDTHS) * len(SCHEMES)
    bad = [one for row in rows for one in row["violations"] if one[0] in ("serious", "critical")]
    assert bad == []
    assert {row["overflow"] for row in rows} == {0}
