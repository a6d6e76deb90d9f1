"""A product quantiser restores what others restore."""

from __future__ import annotations

import pytest
import torch

from dejavu_torch.evaluation.quantiser import k_means, product_quantised


def test_few_descriptors_are_restored_whole():
    rows = torch.randn(200, 10, generator=torch.Generator().manual_seed(0))
    restored, size = product_quantised(rows, 3)
    torch.testing.assert_close(restored, rows)
    assert size == 4 * 200 * 10


def test_centroids_are_the_means_of_the_points_next_to_them():
    points = torch.randn(300, 2, generator=torch.Generator().manual_seed(0))
    found = k_means(points, 5, torch.Generator().manual_seed(0))
    nearest = torch.cdist(points, found).argmin(1)
    expected = torch.stack([points[nearest == i].mean(0) for i in range(5)])
    torch.testing.assert_close(found, expected, rtol=0, atol=0.02)


def test_equal_points_leave_no_centroid_without_a_value():
    found = k_means(torch.ones(40, 3), 8, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found, torch.ones(8, 3))


@pytest.mark.parametrize("parts", [1, 4, 8])
def test_its_error_is_that_of_faiss(parts):
    faiss = pytest.importorskip("faiss")
    draw = torch.Generator().manual_seed(0)
    rows = torch.nn.functional.normalize(torch.randn(3000, 32, generator=draw).cumsum(0))
    quantiser = faiss.ProductQuantizer(32, parts, 8)
    quantiser.cp.min_points_per_centroid = 1
    quantiser.train(rows.numpy())
    other = torch.from_numpy(quantiser.decode(quantiser.compute_codes(rows.numpy())))
    own = product_quantised(rows, parts)[0]
    errors = [float((one - rows).square().sum(1).mean()) for one in (own, other)]
    assert errors[0] <= 1.1 * errors[1]
