"""The page that tells what holds of each module is right."""

from __future__ import annotations

import re
import warnings

import matrix
import pytest


@pytest.mark.parametrize("aspect", matrix.ASPECTS)
@pytest.mark.parametrize("name", matrix.MODULES)
def test_a_cell_says_what_holds(name, aspect):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of operations that vmap runs one after another
        why = matrix.fails(name, aspect)
    refused = matrix.WITHOUT.get(name, {}).get(aspect)
    assert re.search(refused, why) if refused else why == "", why


def test_the_page_is_written_anew():
    assert matrix.PAGE.read_text() == matrix.table()
