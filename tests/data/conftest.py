"""Small sources of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from videos import H264, clip, pictures


@pytest.fixture(scope="session")
def sources(tmp_path_factory):
    """One of every kind, of 12 frames."""
    folder = tmp_path_factory.mktemp("sources")
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 16, 3), np.uint8)
    (folder / "images").mkdir()
    for i, frame in enumerate(pixels):
        Image.fromarray(frame).save(folder / "images" / f"{i:02}.png")
    np.save(folder / "frames.npy", pixels)
    np.save(folder / "features.npy", pixels.reshape(12, -1).astype(np.float32))
    Image.fromarray(pixels[:2].reshape(-1, 16, 3).swapaxes(0, 1)[:, :27]).save(folder / "long.png")
    clip(folder / "clip.mkv", pictures(12))
    clip(folder / "clip.mp4", pictures(12), **H264)  # type: ignore[arg-type]
    names = ("images", "frames.npy", "features.npy", "clip.mkv", "clip.mp4")
    found = {name: str(folder / name) for name in names}
    strip = f"strip:{folder / 'long.png'}?width=16"
    return found | {"strip": strip, "aerial": "sim:aerial?frames=12", "outdoor": "sim:outdoor?frames=12"}
