"""The front door: few names, all documented, and cheap to import."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
from processes import python

import dejavu_torch

PACKAGE = Path(dejavu_torch.__file__).parent
HEAVY = ["pytorch_lightning", "lightning", "torchmetrics", "matplotlib", "av", "numba", "cv2", "ray"]


def test_every_name_is_documented_and_on_the_map_of_the_paper():
    not_of_the_paper = {"ArrayTraverse", "ImageFolder", "InputError", "Match"}
    not_of_the_paper |= {"PRCurve", "Traverse", "open_source"}
    for name in dejavu_torch.__all__:
        value = getattr(dejavu_torch, name)
        assert inspect.isclass(value) or inspect.isfunction(value)
        assert value.__module__.startswith("dejavu_torch.")
        # a NamedTuple without a docstring gets "Name(field, ...)"
        assert not (inspect.getdoc(value) or f"{name}(").startswith(f"{name}("), name
        assert name in not_of_the_paper or name in (dejavu_torch.__doc__ or "")


def test_what_the_docstring_names_is_there():
    """The last column of the map names modules of the package."""
    lines = [line for line in (dejavu_torch.__doc__ or "").splitlines() if line.startswith("    ")]
    assert len(lines) > 8
    for line in lines:
        for module in re.findall(r"\b[a-z]+\.[a-z.]*[a-z]\b", line):
            assert (PACKAGE / module.replace(".", "/")).with_suffix(".py").exists(), module


@pytest.mark.slow
def test_importing_loads_nothing_heavy_until_it_is_asked_for_and_changes_no_global_setting():
    code = (
        "import sys, torch, random; before = (torch.get_num_threads(), torch.get_default_dtype(), "
        "torch.is_grad_enabled(), torch.initial_seed(), random.getstate()); import dejavu_torch; "
        "assert before == (torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled(), "
        "torch.initial_seed(), random.getstate()); "
        f"print([name for name in {HEAVY} if name in sys.modules], len(sys.stderr.getvalue())); "
        "assert set(dejavu_torch.__all__) <= set(dir(dejavu_torch)); sys.stderr = sys.__stderr__; "
        "print(dejavu_torch.DescriptorTask.__name__, 'pytorch_lightning' in sys.modules)"
    )
    code = f"import io, sys; sys.stderr = io.StringIO(); {code}"
    assert python(code).stdout.split("\n")[:2] == ["[] 0", "DescriptorTask True"]
    with pytest.raises(AttributeError, match="no attribute 'Certificate'"):
        dejavu_torch.Certificate  # noqa: B018
