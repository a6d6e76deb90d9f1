"""What a receiver writes without a fix is no place; what a camera does is."""

from __future__ import annotations

import numpy as np
import pytest

from dejavu_torch.data.fixes import checked_fixes

TIMES = np.linspace(0, 1, 300)
ROAD = np.stack([690_000 + 600 * TIMES, 5_300_000 + 80 * np.sin(6 * TIMES)], 1)
AWAY = ROAD + np.array([750, 0])
DEGREES = np.stack([np.full(300, -17.0), 179.9 + 0.001 * np.arange(300)], 1)
DEGREES[:, 1] = (DEGREES[:, 1] + 180) % 360 - 180


def changed(rows, values, path=ROAD):
    path = path.copy()
    path[rows] = values
    return path


@pytest.mark.parametrize(
    ("path", "unknown", "words"),
    [
        (changed(slice(0, 100), 0), range(100), "100 fixes at 0, 0 lie far"),
        (changed(slice(260, 300), -1), range(260, 300), "40 fixes at -1, -1"),
        (changed(0, 0), [0], "the fix in line 0 lies"),
        (changed(slice(50, 110), ROAD[50]), range(51, 110), "59 fixes from line 51 on repeat the one before"),
        (
            changed(slice(120, 123), ROAD[120:123] + np.array([750, 0])),
            range(120, 123),
            "3 fixes from line 120 on lie",
        ),
        (
            changed(slice(297, 300), ROAD[297:] + np.array([0, 750])),
            range(297, 300),
            "3 fixes from line 297 on lie",
        ),
        (changed(slice(200, 202), 2 * ROAD[200:202] - AWAY[200:202]), [200, 201], "m off the path"),
        (
            changed(slice(50, 53), ROAD[50:53] + 750 * np.array([[1, 0], [0, 1], [-1, 0]])),
            [50, 51, 52],
            "3 fixes",
        ),
        (changed(range(20, 220, 20), AWAY[20:220:20]), range(20, 220, 20), "10 fixes from line 20 on lie"),
        (changed([0, 1, 90, 91], AWAY[[0, 1, 90, 91]]), [0, 1, 90, 91], "4 fixes from line 0 on lie"),
    ],
)
def test_no_fix_is_no_place(path, unknown, words):
    found, seen = checked_fixes(path)
    assert np.flatnonzero(np.isnan(found).any(1)).tolist() == [*unknown]
    known = ~np.isnan(found).any(1)
    np.testing.assert_array_equal(found[known], path[known])
    assert [words in line for line in seen] == [True]


@pytest.mark.parametrize(
    "path",
    [
        ROAD,
        np.concatenate([np.zeros((5, 2)), ROAD - ROAD[0]]),  # odometry begins at 0, 0, and may stand
        np.concatenate([ROAD[:50], np.repeat(ROAD[50:51], 60, 0), ROAD[50:]]),  # a stop
        np.random.default_rng(0).uniform(0, 1000, (200, 2)),  # frames in no order
        np.stack(np.meshgrid(8.0 * np.arange(40), 8.0 * np.arange(30)), -1).reshape(-1, 2),  # an area
        np.concatenate([ROAD, ROAD[::-1]]),  # there and back
        np.repeat(np.random.default_rng(0).uniform(0, 100, (30, 2)), 12, 0),  # views of places here and there
        ROAD[:3],
        ROAD[:1],
        ROAD[:0],
    ],
)
def test_what_a_camera_does_stays(path):
    found, seen = checked_fixes(path)
    np.testing.assert_array_equal(found, path)
    assert not seen


@pytest.mark.parametrize("each", [2, 10])
def test_between_fixes_that_change_every_so_often_is_interpolated(each):
    path = ROAD[::each]
    found, seen = checked_fixes(np.repeat(path, each, 0))
    assert f"change every {each} lines" in seen[0]
    stop = each * (len(path) - 1)
    np.testing.assert_allclose(found[:stop], ROAD[:stop], atol=1.0)


def test_between_fixes_a_stop_and_a_gap_stay():
    """A fix that stays longer was at a stop; where fixes are missing, no frame hurries to the next one."""
    rows = [*range(150), *[149] * 60, *range(150, 300)]
    found, _ = checked_fixes(ROAD[[row // 10 * 10 for row in rows]])
    np.testing.assert_allclose(found[160:200], ROAD[[140] * 40])
    path = np.repeat(ROAD[::10], 10, 0)
    path[100:150] = np.nan
    found, _ = checked_fixes(path)
    known = [*range(100), *range(150, 290)]
    np.testing.assert_allclose(found[known], ROAD[known], atol=6)


def test_longitudes_go_on_across_180_degrees():
    found, seen = checked_fixes(DEGREES, degrees=True)
    assert not seen
    np.testing.assert_allclose(np.diff(found[:, 1]), 0.001, atol=1e-9)
    found, seen = checked_fixes(changed(slice(0, 20), 0, DEGREES), degrees=True)
    assert np.isnan(found[:20]).all()
    assert "20 fixes at 0, 0" in seen[0]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [0, 1, 30])
def test_degrees_of_which_none_is_known_are_left_as_they_are(rows):
    found, seen = checked_fixes(np.full((rows, 2), np.nan), degrees=True)
    assert (len(found), seen) == (rows, [])


def test_a_jump_that_stays_is_told():
    path = changed(slice(150, 300), ROAD[150:] + np.array([0, 750]))
    found, seen = checked_fixes(path, lines=range(2, 302))
    np.testing.assert_array_equal(found, path)
    assert "the path jumps 7" in seen[0]
    assert "after line 151" in seen[0]
    path = changed(slice(100, 130), AWAY[100:130])
    assert "after line 99, and again after line 129" in checked_fixes(path)[1][0]
