"""A fixed part of `python -m tests.pairs`, and that its table is whole."""

from __future__ import annotations

import pairs
import pytest


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    with pairs.quick():
        yield pairs.Table(tmp_path_factory.mktemp("pairs"))


@pytest.mark.slow
@pytest.mark.parametrize("cell", pairs.FIXED, ids=pairs.named)
def test_a_pair_of_capabilities_is_as_the_table_says(cell, table):
    outcome = table.cell(*cell)
    assert pairs.differs(outcome, pairs.wanted()[pairs.named(cell)]) == "", outcome


def test_the_table_has_all_cells_and_no_other():
    assert {*pairs.wanted()} == {pairs.named(cell) for cell in pairs.cells()}
    kinds = {"works": 2, "refused": 1, "fails": 1}
    assert all(kinds[kind] == len(told) for kind, *told in pairs.wanted().values())


def test_a_cell_that_starts_to_work_or_ceases_is_told():
    works = pairs.Outcome("works", "", found=0.95, accepted=0.9)
    assert pairs.differs(works, ["works", 0.9, 0.8]) == ""
    assert "expected to find 0.96" in pairs.differs(works, ["works", 0.96, 0.8])
    assert "to accept 0.95" in pairs.differs(works, ["works", 0.9, 0.95])
    assert "works now" in pairs.differs(works, ["fails", "why"])
    assert pairs.differs(works._replace(accepted=0.0), ["fails", "why"]) == ""
    line = pairs.Outcome("refused", "this line", 0.1)
    assert pairs.differs(line, ["refused", "this line"]) == ""
    assert "expected to be refused" in pairs.differs(line, ["refused", "another line"])
    assert "within 5 s" in pairs.differs(line._replace(seconds=9.0), ["refused", "this line"])
    assert "works now" in pairs.differs(line, ["fails", "why"])
    assert "not in the table" in pairs.differs(line, None)
