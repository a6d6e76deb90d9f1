"""What all modules between frames and features have in common."""

from __future__ import annotations

import pytest
import torch
from helpers import refused

from dejavu_torch import (
    HOG,
    GroundOdometry,
    ImposedPeriods,
    Preprocess,
    SpectrogramAnalysis,
    Whitening,
)
from dejavu_torch.features import preprocess
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.model_file import build, recipe_of

MODULES = {
    "hog": HOG(),
    "hog with linear bins": HOG(orientations=6, cell=4, block=3, resize=(24, 28), bins="linear"),
    "pixels": PatchPixels((16, 24), patch=4),
    "grey pixels": PatchPixels((16, 24), 4, "grey"),
    "joined": Joined([HOG(), PatchPixels((16, 24), channel="grey")]),
    "distilled": Distilled(grid=2),
    "network": SmallCNN(dimension=6, resize=(16, 24), widths=[4, 6]).eval(),
    "grey": Preprocess("grey"),
    "patches": Preprocess(contrast="patch"),
    "difference in patches": Preprocess("R-B", "patch", patch=5),
    "clahe": Preprocess("G", "clahe", clip_limit=3, grid=[3, 3]),
}
OTHERS = {
    "grouped whitening": Whitening(groups=[30, 20]),
    "whitening": Whitening(20, views=3, strengths={"noise": 0.2}),
    "spectrogram": SpectrogramAnalysis(256, hop=100, peaks="bins", false_alarm=None),
    "imposed": ImposedPeriods([4, 9], 3, True),
    "odometry": GroundOdometry(size=(64, 48), step=3.0, still=0.2),
}


@pytest.mark.parametrize("name", MODULES)
def test_a_batch_is_its_frames_one_by_one(name, monkeypatch):
    module, frames = MODULES[name], torch.rand(5, 3, 24, 31)
    together = module(frames)
    apart = torch.cat([module(frame[None]) for frame in frames])
    torch.testing.assert_close(together, apart, rtol=0, atol=1e-5)
    monkeypatch.setattr(preprocess, "VALUES_AT_ONCE", 2 * frames[0].numel())  # worked off in parts
    torch.testing.assert_close(module(frames), together, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", [*MODULES, *OTHERS])
def test_a_recipe_builds_the_same_module(name):
    module = {**MODULES, **OTHERS}[name]
    recipe = recipe_of(module)
    again = build(recipe)
    assert repr(again) == repr(module)
    assert recipe_of(again) == recipe


@pytest.mark.parametrize("name", [name for name in MODULES if name != "network"])
def test_what_is_no_batch_of_float_frames_is_refused(name):
    for frames in (torch.rand(3, 24, 31), torch.zeros(1, 3, 24, 31, dtype=torch.uint8)):
        with refused(str(tuple(frames.shape)), str(frames.dtype), "float frames (B,C,H,W)"):
            MODULES[name](frames)
