from __future__ import annotations

import pytest
import torch
from kornia.geometry.transform import resize as kornia_resize

from dejavu_torch.resize import resize_frames


@pytest.mark.parametrize("size", [(32, 40), (20, 90), (80, 90)])
def test_it_is_kornias_antialiased_one(size: tuple[int, int]) -> None:
    frames = torch.rand(2, 3, 50, 70)
    assert torch.equal(resize_frames(frames, size), kornia_resize(frames, size, antialias=True))


def test_frames_of_the_size_are_returned_as_they_are() -> None:
    frames = torch.rand(2, 1, 32, 40)
    assert resize_frames(frames, (32, 40)) is resize_frames(frames, None) is frames


def test_values_stay_between_those_of_the_frames() -> None:
    frames = (torch.rand(4, 1, 64, 64) > 0.5).float()
    for size in ((9, 9), (100, 17)):
        assert 0 <= resize_frames(frames, size).min() <= resize_frames(frames, size).max() <= 1
