"""Undisturbed second visits of real routes give no line, but for queries between the map's frames."""

from __future__ import annotations

import pytest

from dejavu_torch import compare


@pytest.mark.parametrize(
    ("folder", "tolerance", "kinds"),
    [("robotcar/t1", 2, []), ("corridor_laps", 0, []), ("floors_rejection", 1, ["provenance"])],
)
def test_what_is_told_of_real_visits(folder, tolerance, kinds, data_dir):
    visits = (f"{data_dir}/{folder}/{name}.npy" for name in ("reference", "query"))
    found = compare(*visits, f"{data_dir}/{folder}/truth.csv", tolerance=tolerance)
    assert [doubt["kind"] for doubt in found.report.facts["doubts"]] == kinds
