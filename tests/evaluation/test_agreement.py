"""What would make sure answers agree with a truth that rejects them, and when nobody should ask."""

from __future__ import annotations

import json
import math

import pytest
import torch
from command_line import run
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import compare
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.coordinates import Near
from dejavu_torch.evaluation.agreement import Ground, Judged, coarse, contradictions, motion_of, relation_of
from dejavu_torch.evaluation.evaluate import ANYWHERE, Asked, evaluate_file
from dejavu_torch.evaluation.report import verdict
from dejavu_torch.types import Coordinates, Match

Q = torch.arange(300)
TURN = torch.tensor([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]]).double()


def road(s):
    """A drawn road with bends, by place number: metres."""
    s = torch.as_tensor(s).double()
    return torch.stack([3 * s, 60 * torch.sin(s / 60) + 0.0015 * s**2], 1)


def judged(places, truth, queries=Q, tolerance=5, sure=0.95, **more):
    """Answers at places, where a truth says others."""
    probability = torch.full((len(places),), sure)
    match = Match(places, torch.zeros(len(places)), torch.ones(len(places), dtype=torch.bool), probability)
    right = (places - truth).abs() <= tolerance
    return Judged(match, queries, right, torch.ones_like(right), tolerance, "truth.csv", 3000, **more)


def told(*args, **more):
    return [(doubt.kind, str(doubt)) for doubt in contradictions(judged(*args, **more))]


@pytest.mark.parametrize(
    ("places", "kind", "words"),
    [
        (Q + 40, "offset", ("300 of 300", "place = query + 40", "--truth 40")),
        (Q - 17, "offset", ("place = query - 17", "--truth -17")),
        (6 * Q, "rate", ("place = 6 query:", "lines 0,0 and 299,1794")),
        (Q // 4, "rate", ("place = 0.25 query",)),
        ((1.13 * Q).round().long(), "rate", ("place = 1.13 query", "from 0 to 39")),
        ((Q * 30 / 28).round().long(), "rate", ("place = 1.07", "rates differ")),
        (299 - Q, "backwards", ("place = 299 - query", "run backwards", "lines 0,299 and 299,0")),
        (600 - 2 * Q, "backwards", ("place = 600 - 2 query",)),
        (Q + 20 * (Q // 75), "offset", ("goes from 0 to 60", "frames are missing", "by name or time")),
        (Q + 60 * (Q >= 150), "offset", ("goes from 0 to 60 at query 15", "60 frames of the queries")),
        (600 - Q - 60 * (Q >= 150), "offset", ("goes from 600 to 540", "60 frames of the queries")),
        (400 - Q - 15 * (Q // 75), "offset", ("place = - query", "goes from 400 to 355")),
    ],
)
@pytest.mark.parametrize("share", [0.0, 0.06])
def test_a_relation_between_frames_is_told(places, kind, words, share):
    """With some answers anywhere, and jitter of a frame."""
    noise = torch.Generator().manual_seed(1)
    places = places + torch.randint(-1, 2, (300,), generator=noise)
    lost = torch.randperm(300, generator=noise)[: round(share * 300)]
    places[lost] = torch.randint(0, 300, (len(lost),), generator=noise)
    ((found, text),) = told(places.clamp(min=0), Q)
    assert found == kind
    assert text.startswith("the answers contradict the truth (truth.csv)")
    for word in words if not share else ():
        assert word.replace("300 of", f"{300 - len(lost)} of") in text


@pytest.mark.parametrize(("gap", "whose"), [(20, "queries"), (60, "queries"), (-60, "reference")])
def test_an_offset_that_jumps_is_told_with_the_lines_that_mend_it(gap, whose):
    """Answers within the gap of a reference are not sure."""
    sure = Q[(Q < 150) | (150 - min(gap, 0) <= Q)]
    first = int(sure[sure >= 150][0])
    ((kind, text),) = told(sure + gap * (sure >= first), sure, sure)
    assert kind == "offset"
    assert (
        f"goes from 0 to {gap} at query {first}: {abs(gap)} frames of the {whose} are missing there" in text
    )
    before = int(sure[sure < first][-1])
    lines = f"0,0, {before},{before}, {first},{first + gap} and 299,{299 + gap}"
    assert text.endswith(f"--interpolate and --truth FILE.csv with the lines {lines}")


def test_a_truth_that_jumps_halfway_is_told():
    ((kind, text),) = told(Q, Q - 40 * (Q >= 150))
    assert kind == "offset"
    assert "300 of 300 confident answers follow place = query" in text
    assert told(Q + (Q % 3 - 1), Q, tolerance=0) == []  # a small tolerance


@given(st.floats(0.2, 4.0), st.integers(-200, 200), st.integers(0, 2**16))
def test_a_line_is_found_within_its_width(slope, offset, seed):
    noise = torch.Generator().manual_seed(seed)
    places = (slope * Q + offset).round().long() + torch.randint(-2, 3, (300,), generator=noise)
    relation = relation_of(places, Q, 5)
    assert relation is not None
    assert relation.answers >= 0.9 * relation.confident
    assert relation.last is None
    assert relation.slope * 150 + relation.offset == pytest.approx(slope * 150 + offset, abs=6)


@pytest.mark.parametrize(
    ("places", "truth", "more"),
    [
        (Q, Q, {}),  # they agree
        (Q + 5, Q, {}),  # within the tolerance
        (torch.randperm(300, generator=torch.Generator().manual_seed(0)), Q, {}),  # an honest failure
        (torch.where(Q % 10 < 1, (7 * Q) % 300, Q), Q, {}),  # a tenth is wrong
        (torch.where(Q < 150, Q, (7 * Q) % 300), Q, {}),  # half of it anywhere
        (Q + 50 * ((Q >= 100) & (Q < 200)) + 20 * (Q >= 200), Q, {}),  # a third at a place that looks alike
        (torch.full_like(Q, 70), Q, {}),
        (torch.where(Q < 180, Q + 120, Q), Q, {}),  # most at a place that looks alike
        (torch.where(Q < 150, Q, Q + 1000), Q, {}),  # half of it at one far ahead
        (Q + torch.randint(-2, 3, (300,), generator=torch.Generator().manual_seed(0)), Q, {"tolerance": 0}),
        (Q + 40, Q, {"sure": 0.8}),
        (Q + 40, Q, {"alone": torch.randperm(300, generator=torch.Generator().manual_seed(0))}),  # elsewhere
    ],
    ids=[
        "right",
        "near",
        "anywhere",
        "tenth",
        "half",
        "alike",
        "one place",
        "most alike",
        "half alike",
        "strict",
        "unsure",
        "single images deny",
    ],
)
def test_where_nothing_explains_nothing_is_told(places, truth, more):
    assert not told(places, truth, **more)


def test_the_lines_to_give_name_frames_that_are_there():
    """Answers of the part of a drive that the reference shows."""
    queries = Q + 50
    ((_, text),) = told(2 * queries - 100, queries, queries)
    assert "lines 50,0 and 349,598" in text
    one = judged(6 * Q, Q)._replace(places=1000)
    assert "lines 0,0 and 166,996" in str(contradictions(one)[0])


def test_few_answers_tell_nothing():
    assert not told(Q[:19] + 40, Q[:19], Q[:19])
    assert told(Q[:20] + 40, Q[:20], Q[:20])


def grounds(stored, own, places=Q, radius=12.5, names=("a.csv", "b.csv"), second=None):
    """Answers at places by coordinates of both visits, and what a truth by distance says of them."""
    near, found, asked = Near("metres", radius), stored[places], own[Q]
    right = (found - asked).norm(dim=1) <= radius
    one = judged(places, Q)._replace(right=right, truth="within 12.5 m")
    return one, Ground(near, found, asked, stored, own, names, second)


PATH = road(Q)


@pytest.mark.parametrize(
    ("stored", "own", "more", "kind", "words"),
    [
        (PATH, (PATH - PATH[50]) @ TURN.T, {}, "frame", ("turned by -40.1 degrees and moved by (150",)),
        (PATH - PATH[0], (PATH - PATH[0]) @ TURN.T, {}, "frame", ("both begin at 0, 0",)),
        (PATH, PATH.fliplr(), {}, "frame", ("with x and y exchanged",)),
        (PATH, 1.1 * PATH, {}, "frame", ("scaled by 0.909",)),
        (PATH, PATH * torch.tensor([1.0, -1.0]), {}, "frame", ("mirrored",)),
        (PATH, road(Q + 18), {"second": 1.0}, "clock", ("18.0 s later",)),
        (PATH, road(Q - 18), {"second": 0.5}, "clock", ("9.0 s earlier",)),
        (PATH, road(Q + 18), {}, "clock", ("18 frames later",)),
        (PATH, PATH.flip(0), {}, "clock", ("rows run backwards",)),
        (PATH, road(1.05 * Q), {}, "clock", ("0.95", "times as fast")),
        (PATH, PATH + torch.tensor([0.0, 40.0]), {}, "shift", ("moved by (0.0, -40.0) m",)),
        (PATH, PATH + torch.tensor([0.0, 12.0]), {}, "shift", ("lie 12 m from", "moved by (0.0, -12.0) m")),
        (road(Q + 30), PATH, {"places": (Q - 30).clamp(min=0)}, None, ()),  # right, but for the first
        (PATH, road(Q + 30), {"places": (Q - 30).clamp(min=0)}, "exchanged", ("two files exchanged",)),
    ],
)
def test_coordinates_that_agree_another_way(stored, own, more, kind, words):
    if kind in ("exchanged", None):  # query q is at place q + 30 of the reference, if files are as they are
        places = (Q - 30) if kind is None else Q + 30
        keep = (places >= 0) & (places < 300)
        stored, own = (stored, PATH) if kind is None else (road(Q + 30), PATH)
        near = Near("metres", 12.5)
        shown = places.clamp(0, 299)
        found = road(shown + 30)
        if kind is None:
            one, ground = grounds(stored, own, shown)
        else:
            one, ground = grounds(stored, own, shown)
        one = one._replace(judged=keep)
        ground = ground._replace(near=near, found=found)
    else:
        one, ground = grounds(stored, own, **more)
    doubts = contradictions(one, ground)
    assert [doubt.kind for doubt in doubts] == ([] if kind is None else [kind])
    for word in words:
        assert word in str(doubts[0])


@pytest.mark.parametrize("rows", [Q + 20 * (Q // 75), Q + 60 * (Q >= 150), Q + 100 * (Q >= 100)])
@pytest.mark.parametrize("whose", ["a.csv", "b.csv"])
def test_coordinates_in_whose_file_rows_are_missing(rows, whose):
    """Frames have the fixes of the rows of their numbers, by either file."""
    stored, own = (road(torch.arange(500)), road(rows)) if whose == "b.csv" else (road(rows), PATH)
    (doubt,) = contradictions(*grounds(stored, own))
    assert doubt.kind == "clock"
    assert f"if its rows are 0 to {int(rows[-1]) - 299} frames" in doubt.text
    assert "rows are missing, or rates differ; pair by time or name" in doubt.text


@pytest.mark.parametrize(
    "way",
    [
        road,
        lambda s: 100 * torch.stack([torch.cos(s / 30), torch.sin(s / 30)], 1),  # laps
        lambda s: road(torch.where(s < 150, s, 300 - s)),  # there and back
    ],
)
def test_a_clock_that_leaves_many_frames_without_coordinates(way):
    """90 of 300 frames have none, and the places of 90 others are not in the file."""
    q = Q.double()
    own = way(q - 90).masked_fill((Q < 90)[:, None], math.nan)
    one, ground = grounds(way(q), own, second=0.2)
    one = one._replace(judged=Q >= 90)
    (doubt,) = contradictions(one, ground)
    assert doubt.kind == "clock"
    assert "120 of 210" in doubt.text
    assert "if its times are 18.0 s earlier" in doubt.text
    stays = torch.where(Q < 120, Q + 180, Q)  # most look like a later place, and the others are right
    assert not contradictions(*grounds(way(q), way(q), stays))


def test_between_places_and_within_one_no_move_is_told():
    """Queries half way between two places; and answers of another route, all within the radius."""
    path = torch.stack([10.0 * Q, 0.0 * Q], 1).double()
    assert not contradictions(*grounds(path, path + torch.tensor([4.9, 0.0]), radius=6.0))
    draw = torch.Generator().manual_seed(0)
    shuffled = torch.randperm(300, generator=draw)
    assert not contradictions(*grounds(PATH / 9, PATH / 9 + 5000, shuffled, radius=100.0))


def test_where_several_explain_they_are_named_together():
    """A straight road at constant speed: moved, or late."""
    path = torch.stack([3.0 * Q, 0.0 * Q], 1).double()
    one, ground = grounds(path, path + torch.tensor([54.0, 0.0]), second=0.1)
    (doubt,) = contradictions(one, ground)
    assert "moved by (-54.0, 0.0) m, or if its times are 1.8 s later" in doubt.text


@pytest.mark.parametrize("case", ["noise", "anywhere", "half", "one place", "a bend away"])
def test_coordinates_of_honest_answers_tell_nothing(case):
    draw = torch.Generator().manual_seed(0)
    places = {
        "noise": Q,
        "anywhere": torch.randperm(300, generator=draw),
        "half": torch.where(Q % 2 == 0, Q, (7 * Q) % 300),
        "one place": torch.full_like(Q, 9),
        "a bend away": torch.where(Q < 120, Q, 419 - Q),
    }[case]
    own = PATH + 2 * torch.randn(300, 2, generator=draw).double()
    assert not contradictions(*grounds(PATH, own, places))


def test_a_small_place_has_no_motion():
    """Points within a few radii fit any motion."""
    points = 10 * torch.rand(60, 2, generator=torch.Generator().manual_seed(0)).double()
    assert motion_of(points @ TURN.T, points, 12.5) is None
    assert motion_of(10 * points @ TURN.T, 10 * points, 2.5) is not None


def test_coordinates_too_coarse_for_the_radius():
    way = road(Q / 2) + 5_326_000
    coarse_of = {
        "ten": torch.stack([way[:, 0], (way[:, 1] / 10).round() * 10], 1),
        "plain": way,
        "a frame every ten metres": torch.stack([10.0 * Q, 0.0 * Q], 1).double(),
        "a grid": 10.0 * torch.cartesian_prod(torch.arange(15), torch.arange(20)).double(),
    }
    for name, own in coarse_of.items():
        _, ground = grounds(way, own, radius=5.0)
        doubts = coarse(ground)
        assert [doubt.kind for doubt in doubts] == ["digits"] * (name == "ten")
    _, ground = grounds(way, coarse_of["ten"], radius=25.0)
    assert not coarse(ground)
    assert "the y of b.csv are multiples of 10 m" in str(
        coarse(grounds(way, coarse_of["ten"], radius=5.0)[1])[0]
    )


@pytest.mark.parametrize(
    ("above", "radius", "floors"),
    [(4.0, 5.0, True), (4.0, 3.0, False), (0.0, 5.0, False), (None, 25.0, False)],
)
@pytest.mark.parametrize("whose", [0, 1])
def test_floors_within_the_radius(above, radius, floors, whose):
    """Of one visit, which passes both. None: heights of a receiver, which merely vary."""
    draw = torch.Generator().manual_seed(0)
    height = torch.full((300,), above or 0.0) if above is not None else 4 * torch.randn(300, generator=draw)
    one = torch.cat([PATH, torch.zeros(300, 1)], 1)
    both = torch.cat([one, torch.cat([PATH, height[:, None]], 1)])
    _, ground = grounds(*((both, one), (one, both))[whose], radius=radius)
    doubts = coarse(ground)
    assert [doubt.kind for doubt in doubts] == ["heights"] * floors
    assert not floors or ("4 m above" in str(doubts[0]) and "--truth metres:2" in str(doubts[0]))


@pytest.mark.parametrize(("above", "radius"), [(4.0, 5.0), (4.0, 3.0), (40.0, 25.0), (2.0, 25.0)])
def test_heights_of_two_visits_that_differ_by_a_constant_are_moved(above, radius):
    """Not floors, as those of one visit are; a small part of the radius tells nothing."""
    one = torch.cat([PATH, torch.zeros(300, 1)], 1)
    judged, ground = grounds(one, one + torch.tensor([0.0, 0.0, above]), radius=radius)
    doubts = contradictions(judged, ground) + coarse(ground)
    assert [doubt.kind for doubt in doubts] == ["shift"] * (above > radius / 2)
    assert all(f"moved by (0.0, 0.0, {-above}) m" in str(doubt) for doubt in doubts)


@pytest.mark.parametrize(
    "heights", [0.2 * Q, 20 * torch.randn(300, generator=torch.Generator().manual_seed(0))]
)
def test_heights_that_drift_are_told_as_such(heights):
    """No motion of the plane, which agrees as it is."""
    one = torch.cat([PATH, torch.zeros(300, 1)], 1)
    (doubt,) = contradictions(*grounds(one, torch.cat([PATH + 0.3, heights[:, None]], 1)))
    assert doubt.kind == "heights"
    assert str(doubt).endswith(
        "300 of 300 confident answers agree with the coordinates of b.csv without heights"
    )


def visits(stored, own, noise):
    """Two with coordinates, the second with so much noise."""
    rows, other = (torch.randn(300, 16, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    rows = torch.nn.functional.normalize(rows, dim=1)
    reference, query = ArrayTraverse(rows, "a"), ArrayTraverse(rows + noise * other, "b")
    reference.coordinates, query.coordinates = Coordinates(stored), Coordinates(own)
    return reference, query


@pytest.mark.parametrize(
    ("own", "noise", "kind", "words"),
    [
        ((PATH - PATH[50]) @ TURN.T + 5000, 0.15, "frame", "turned by -40.1 degrees and moved by ("),
        (PATH + 5000, 0.15, "shift", "moved by (-5000.0, -5000.0) m"),
        (
            PATH + 5000,
            9.0,
            "nowhere",
            "their middle is 7071 m from that of a; expected coordinates in one sys",
        ),
    ],
)
def test_coordinates_by_which_none_is_right_are_held_against_the_answers(own, noise, kind, words, tmp_path):
    reference, query = visits(PATH, own, noise)
    report = compare(reference, query, "metres:5", tolerance=5).report
    (doubt,) = (doubt for doubt in report.facts["doubts"] if doubt["kind"] != "provenance")
    assert doubt["kind"] == kind
    assert words in doubt["text"]
    assert report.ours.scores.auc == report.facts["with_answer"] == 0
    assert ("which the answers contradict" in verdict(report)) == (noise < 1)
    found = torch.arange(300) if noise < 1 else torch.randperm(300)
    rows = "".join(f"{i},{int(found[i])},0.1\n" for i in range(300))
    (tmp_path / "m.csv").write_text(f"query,place,score\n{rows}")
    report = evaluate_file(tmp_path / "m.csv", "metres:5", asked=Asked(reference, query)).report
    assert [doubt["kind"] for doubt in report.facts["doubts"]] == [kind]


def test_a_report_tells_it_first(tmp_path, capsys):
    """On the terminal, at the top of the page, and in report.json; the verdict is not that of the map."""
    reference, query = visits(PATH, (PATH - PATH[50]) @ TURN.T, 0.15)
    found = compare(reference, query, "metres:25", tolerance=5)
    (doubt,) = found.report.facts["doubts"]
    assert doubt["kind"] == "frame"
    assert "turned by -40.1 degrees" in doubt["text"]
    assert "which the answers contradict" in verdict(found.report)
    assert doubt["text"] in repr(found.report)
    query.coordinates = Coordinates(PATH)
    assert compare(reference, query, "metres:25", tolerance=5).report.facts["doubts"] == []
    answers = "\n".join(f"{i},{6 * i},{0.1}" for i in range(40))
    (tmp_path / "m.csv").write_text(f"query_idx,ref_idx,distance\n{answers}\n")
    assert (
        "place = 6 query"
        in evaluate_file(tmp_path / "m.csv", "0", 3, ANYWHERE).report.facts["doubts"][0]["text"]
    )
    run("evaluate", tmp_path / "m.csv", "--truth", "0", "--out", tmp_path / "scores")
    assert capsys.readouterr().out.startswith("the answers contradict the truth (place = query)")
    page = (tmp_path / "scores" / "index.html").read_text()
    assert page.index("place = 6 query") < page.index("<details>")
    assert json.loads((tmp_path / "scores" / "report.json").read_text())["doubts"][0]["kind"] == "rate"
