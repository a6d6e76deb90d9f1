"""What holds of each public module in a learning pipeline; `python -m tests.matrix` writes it to the docs."""

from __future__ import annotations

import copy
from collections.abc import Callable
from fractions import Fraction
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor, nn

from dejavu_torch import (
    HOG,
    DejaVu,
    Embedding,
    FrequencyLayer,
    ImposedPeriods,
    PhaseTemplates,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    SpectrogramAnalysis,
    TemplateMapper,
    Whitening,
    phase_distances,
)
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.maps.template_map import log_posterior

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "modules.md"
HEAD = """# What holds of each module

Every cell is tested. The page is written by `python -m tests.matrix`.

- **gradient**: `gradcheck` in double precision, with respect to the input;
- **torch.func**: `grad` and `vmap` give what autograd and a loop do;
- **float64**, **bfloat16**: the module and its input converted; in bfloat16 within 5 % of the largest value;
- **autocast**: the same under bfloat16 autocast, networks within 2 % of the largest value;
- **empty**: a batch of 0 gives 0 rows;
- **compile**: `torch.compile(fullgraph=True)`, without the compilation to machine code;
- **export**: `torch.export` for any number of rows.

Where it says no: an augmentation is float32, draws random numbers and passes no gradient; periods and
templates are of one route, not of a batch, and the periods of a plan are exact fractions; a sequence is
exported [step by step, with its state](../howto/export.md).

"""
ROUTE = 24


class Calls(nn.Module):
    """A function as a module."""

    def __init__(self, function: Callable[..., Tensor], **parts: nn.Module) -> None:
        super().__init__()
        self.function, self.parts = function, nn.ModuleDict(parts)

    def forward(self, *values):
        return self.function(*self.parts.values(), *values)


@cache
def frames():
    return torch.rand(ROUTE, 3, 16, 16, generator=torch.Generator().manual_seed(1))


@cache
def rows(columns):
    return torch.rand(ROUTE, columns, generator=torch.Generator().manual_seed(2))


def model(spectral):
    settings = {"mapper": TemplateMapper(ImposedPeriods([3, 4], bin=2))}
    if spectral:
        settings = {"whitening": Whitening(views=1, bits=16), "mapper": SpectralMapper(None, step=1e-3)}
    return DejaVu(HOG(cell=4), **settings).learn(frames())


def distances(values, templates):
    return phase_distances(values, templates.to(values))


def augmented(module, values):
    module.training = True
    made = module(values)
    return made


def seeded(module, values):
    """The output with the same random numbers each time."""
    torch.manual_seed(0)
    made = module(values)
    return made


PLAN = (FrequencyLayer(Fraction(4), 4, 0, 5, (0, 1)), FrequencyLayer(Fraction(5, 2), 3, 1, 4, (2,)))
# each with the input of a batch of 5
MODULES = {
    "HOG": (lambda: HOG(cell=4), lambda: frames()[:5]),
    "PatchPixels": (lambda: PatchPixels((8, 8)), lambda: frames()[:5]),
    "Distilled": (lambda: Distilled(2), lambda: frames()[:5]),
    "SmallCNN": (lambda: SmallCNN(8, 3, (16, 16), (4, 8)), lambda: frames()[:5]),
    "Embedding": (lambda: Embedding(nn.Conv2d(3, 4, 3), 8, resize=(12, 12)), lambda: frames()[:5]),
    "Joined": (lambda: Joined([HOG(cell=4), PatchPixels((8, 8))]), lambda: frames()[:5]),
    "Preprocess, patch": (lambda: Preprocess("grey", "patch"), lambda: frames()[:5]),
    "Augmentation": (lambda: Calls(augmented, module=Augmentation()), lambda: frames()[:5]),
    "Whitening": (
        lambda: model(True).whitening or nn.Identity(),
        lambda: model(True).descriptor.describe(frames()[:5]),
    ),
    "SpectrogramAnalysis": (
        lambda: Calls(lambda module, values: module(values)[0].power.T, module=SpectrogramAnalysis(16)),
        lambda: rows(5),
    ),
    "PhaseTemplates": (
        lambda: Calls(
            lambda module, values: torch.cat([one.flatten() for one in module(values, PLAN)]),
            module=PhaseTemplates(),
        ),
        lambda: 100 + rows(3)[:5],  # means whose difference is small
    ),
    "phase_distances": (
        lambda: Calls(partial(distances, templates=rows(6)[7:11])),
        lambda: rows(6)[:5],
    ),
    "TemplateMap": (lambda: model(False).map, lambda: model(False).descriptor.describe(frames()[:5])),
    "SpectralMap": (
        lambda: DejaVu(whitening="none", mapper=SpectralMapper(None, step=1e-3)).learn(rows(6)).map,
        lambda: rows(6)[:5],
    ),
    "log_posterior": (lambda: Calls(lambda values: log_posterior(values, 0.5)), lambda: rows(6)[:5]),
    "SequenceMatcher": (lambda: SequenceMatcher(3), lambda: rows(6)[:5]),
    "PlaceFilter": (PlaceFilter, lambda: rows(6)[:5]),
    "DejaVu, templates": (lambda: model(False), lambda: frames()[:5]),
    "DejaVu, spectral": (lambda: model(True), lambda: frames()[:5]),
}


def close(found, expected, share):
    """Within a share of the largest value."""
    assert found.shape == expected.shape
    assert found.isfinite().equal(expected.isfinite())
    largest = float(expected.detach()[expected.isfinite()].abs().max())
    torch.testing.assert_close(found.to(expected), expected, rtol=0, atol=share * largest)


def gradient(module, values):
    exact = values.double().requires_grad_()
    module = module.double()

    def finite(one):
        made = module(one)
        return made.where(made.isfinite(), 0)

    assert torch.autograd.gradcheck(finite, (exact,), fast_mode=True)


def functions(module, values):
    other = values.flip(0)
    expected = torch.stack([module(values), module(other)])
    close(torch.func.vmap(module, randomness="same")(torch.stack([values, other])), expected, 1e-5)
    given = values.clone().requires_grad_()
    (slope,) = torch.autograd.grad(module(given).square().sum(), given)
    close(torch.func.grad(lambda one: module(one).square().sum())(values), slope, 1e-4)


def float64(module, values):
    expected = module(values)
    found = module.double()(values.double())
    assert found.dtype == torch.float64
    close(found, expected, 1e-3)


def bfloat16(module, values):
    rounded = values.bfloat16()
    expected = module(rounded.float())
    close(module.bfloat16()(rounded).float(), expected, 0.05)


def autocast(module, values):
    """Networks are rounded, everything else is exact."""
    learned = any(isinstance(one, nn.Conv2d | Distilled) for one in module.modules())
    expected = seeded(module, values)
    with torch.autocast("cpu", torch.bfloat16):
        close(seeded(module, values), expected, 0.02 if learned else 1e-5)


def empty(module, values):
    assert module(values[:0]).shape == (0, *module(values).shape[1:])


def compiled(module, values):
    torch.compiler.reset()
    run = torch.compile(module, fullgraph=True, backend="eager")
    for some in (values, values[1:]):
        close(seeded(run, some), seeded(module, some), 1e-5)


def exported(module, values):
    shapes = ({0: torch.export.Dim("rows")},)
    if isinstance(module, Calls):
        shapes = (shapes,)
    program = torch.export.export(module, (values,), dynamic_shapes=shapes).module()
    for some in (values, values[2:]):
        close(program(some), module(some), 1e-5)


ASPECTS = {
    "gradient": gradient,
    "torch.func": functions,
    "float64": float64,
    "bfloat16": bfloat16,
    "autocast": autocast,
    "empty": empty,
    "compile": compiled,
    "export": exported,
}
# what does not hold, and the error that says so
WITHOUT = {
    "Augmentation": {
        **dict.fromkeys(("gradient", "float64", "bfloat16"), "expected float32"),
        "torch.func": "not close",
        "export": "specialized|Constraints|guard|rows|Not equal|close",
    },
    "SpectrogramAnalysis": {"empty": "at least 8", "export": "rows"},
    "PhaseTemplates": {"empty": "inside 0 places", "compile": "super", "export": "rows"},
    "SequenceMatcher": {"export": "rows"},
    "PlaceFilter": {"export": "rows"},
}


def fails(name, aspect):
    """Why an aspect does not hold of a module; "" if it does."""
    make, given = MODULES[name]
    torch.manual_seed(0)
    try:
        ASPECTS[aspect](copy.deepcopy(make()).eval(), given())
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def table():
    """The page: a row for each module."""
    lines = [f"| module | {' | '.join(ASPECTS)} |", f"|---|{'---|' * len(ASPECTS)}"]
    for name in MODULES:
        without = WITHOUT.get(name, {})
        lines.append(f"| {name} | {' | '.join('no' if one in without else 'yes' for one in ASPECTS)} |")
    return HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(table())
