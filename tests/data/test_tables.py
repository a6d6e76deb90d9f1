"""Tables in files: names and units of columns, whatever is between them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import refused

from dejavu_torch.data.tables import column_of, read_table


def table_of(text, tmp_path):
    (tmp_path / "table.csv").write_text(text)
    return read_table(tmp_path / "table.csv", "a table")


@pytest.mark.parametrize(
    ("title", "role", "unit"),
    [
        ("x", "x", None),
        ("timestamp_ns", "time", 1e-9),
        ("time (ms)", "time", 1e-3),
        ("x [mm]", "x", 1e-3),
        ("p_rs_r_y [m]", "y", 1.0),
        ("latitude", "lat", None),
        ("field.header.stamp", "time", None),
        ("pose.position.z", "z", None),
        ("filename", "name", None),
        ("sats", "sats", None),
        ("x [furlong]", "x [furlong]", None),
    ],
)
def test_what_a_column_holds(title, role, unit):
    column = column_of(title)
    assert (column.title, column.role) == (title, role)
    assert column.unit == unit


@pytest.mark.parametrize("sign", [",", ";", "\t", " ", "   "])
def test_any_separator_and_comments(sign, tmp_path):
    lines = ["# of the, third; drive", sign.join(("t", "x", "y")), sign.join("123"), "", sign.join("456")]
    table = table_of("\n".join(lines), tmp_path)
    assert [column.role for column in table.header] == ["time", "x", "y"]
    assert table.numbers("time").tolist() == [1, 4]
    assert table.numbers("y").tolist() == [3, 6]
    assert table.unused() == ["x"]
    assert table.where(1).endswith("line 5")


def test_a_comment_is_the_header_if_it_names_each_column(tmp_path):
    table = table_of("# timestamp tx ty tz qx qy qz qw\n1 2 3 4 0 0 0 1\n", tmp_path)
    assert table.numbers("x").tolist() == [2]
    assert not table.unused()  # a standard form
    assert not table_of("# two words\n1 2 3\n", tmp_path).header


def test_units_are_removed(tmp_path):
    table = table_of("time_us,x [cm]\n2000000,150\n-,-\n", tmp_path)
    np.testing.assert_allclose(table.numbers("time"), [2, np.nan])
    np.testing.assert_allclose(table.numbers("x"), [1.5, np.nan])


def test_decimal_commas_between_semicolons(tmp_path):
    assert table_of("x;y\n1,5;-2\n", tmp_path).numbers("x").tolist() == [1.5]


def test_the_plain_name_goes_before_another_that_means_the_same(tmp_path):
    table = table_of("t,time,pos_x,x\n1,2,3,4\n", tmp_path)
    assert table.numbers("time").tolist() == [2]
    assert table.numbers("x").tolist() == [4]
    assert table.unused() == ["t", "pos_x"]


def test_rows_of_another_length_are_refused(tmp_path):
    table = table_of("x,y\n1,2\n3\n", tmp_path)
    with refused("line 3", "1 columns", "2 or more"):
        table.check_width("x", "y")
    with refused("line 3", "1 cells", "2 as in the header"):
        list(table.cells("a dot"))
    with refused("line 2", "3 cells", "a dot"):
        list(table_of("x,y\n1,2,3\n", tmp_path).cells("a dot"))
