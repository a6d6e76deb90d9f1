"""Reports: tables, sentences, report.json, and the page."""

from __future__ import annotations

import re

import pytest
import torch

from dejavu_torch.evaluation.contenders import Contender, contend
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.evaluation.plots import Picture, canvas
from dejavu_torch.evaluation.report import (
    PICTURES,
    Report,
    compared_lines,
    found_lines,
    report_folder,
    score_table,
    sequence_table,
    steps,
    summary,
    verdict,
    write_index,
    write_report,
)
from dejavu_torch.types import Match

SCORES = Scores(0.5, 0.6, 0.1, 0.2, 0.7, 0.75, 0.8, 0.3)
FACTS = {"queries": 20, "tolerance": 3, "recall_definition": "TP / all", "version": "1", "torch": "2"}


def report(facts=None, **contenders):
    return Report(Contender("this map", SCORES, 4000), contenders, FACTS | (facts or {}))


def picture(heading="a heading"):
    return Picture(canvas(1), heading, "A caption.")


def written(folder, one, **pictures):
    with report_folder(folder) as temporary:
        write_report(temporary, one, pictures, "a title", "dejavu demo", "the plan")
    return (folder / "index.html").read_text(encoding="utf-8")


def match(scores):
    return Match(torch.arange(len(scores)), torch.tensor(scores), torch.ones(len(scores), dtype=torch.bool))


@pytest.mark.parametrize(("equal", "late"), [(1, False), (2, True)])
def test_a_curve_that_starts_late_has_a_star_and_the_star_is_explained(equal, late):
    # all are right: the curve starts at the share of those that have the best score
    scores = [0.1] * equal + [0.2] * (10 - equal)
    ours = contend("this map", match(scores), torch.arange(10)[:, None], 0)
    one = report()._replace(ours=ours)
    assert ours.starts == equal / 10
    assert score_table(one)[1][1].endswith("*") == late
    assert ("this curve starts at a recall above 0.1" in summary(one)) == late
    assert one.as_json()["curve_starts_at_recall"] == ours.starts


def test_the_table_has_bytes_where_the_places_are_known():
    one = report({"frames": 32}, null=Contender("null", SCORES))
    main, more = ["AUC", "recall@1", "R@99P"], ["R@100P", "P@100R", "AUC rep.", "R@100P rep."]
    few, many = ["0.500", "0.750", "0.300"], ["0.100", "0.700", "0.600", "0.200"]
    sizes = ["bytes", "bytes per place", "route bytes per place"]
    assert score_table(one, every=True) == [
        ["", *main, *more, *sizes],
        ["this map", *few, *many, "4000", "125.0", "125.0"],
        ["null", *few, *many, "", "", ""],
    ]
    assert score_table(one)[:2] == [["", *main, *sizes[1:]], ["this map", *few, "125.0", "125.0"]]
    assert score_table(report(), every=True) == [["", *main, *more], ["this map", *few, *many]]


STORED = {  # of a storage curve, as in report.json
    "frames": 40,
    "storage": {
        "map": [
            {"route_bytes_per_place": size, "auc": area, "recall_at_1": 0.5}
            for size, area in ((0.981, 0.25), (2.5, 0.375), (4.91, 0.625), (9.9, 0.75))
        ]
    },
}


def drive_report(control=0.5, **facts):
    """A report on a drive, with a map in one byte and a control."""
    whole = {"smoother": SCORES._replace(recall_at_1=1.0)}
    ours = Contender("this map", SCORES, 440, fixed=40, sequences=whole)
    null = Contender("control", SCORES, sequences={"smoother": SCORES._replace(recall_at_1=control)})
    small = Contender("this map in 1 byte", SCORES, 120, fixed=40, sequences=whole)
    facts = {"queries": 4, "seconds_learn": 0.8, "seconds_localize": 0.4} | facts
    facts = {
        "with_answer": 4,
        "accepted": 3,
        "accepted_right": 2,
        "unit": "frames",
        "answers": "drive",
        **facts,
    }
    return report(STORED | facts, one_byte=small, null=null)._replace(ours=ours)


def test_what_was_found_in_a_few_lines():
    assert found_lines(drive_report(tolerance=1, frames=80)) == [
        "learned 80 frames in 0.8 s (10.0 ms each), searched 4 frames in 0.4 s (100.0 ms each)",
        "FOUND 4 of 4 within 1 frame by the whole drive, 3 by one image",
        "accepted and right 2, accepted and wrong 1, not accepted 1",
        "map file: 0 kB + 5.0 bytes per frame",
    ]
    given = drive_report(tolerance=1, frames=80, seconds_learn=0)
    assert found_lines(given)[0] == "searched 4 frames in 0.4 s (100.0 ms each)"
    assert found_lines(given._replace(ours=Contender("this map", None))) == []


def test_what_other_ways_find_in_a_short_table():
    lines = compared_lines(drive_report(tolerance=1, frames=80))
    rows = [line.split("  ")[0] for line in lines]
    assert rows == ["", "found by", "this map", "this map in 1 byte", "control"]
    assert lines[2].split()[2:] == ["75.0%", "30.0%", "100.0%", "5.0"]
    assert "control is found" in compared_lines(drive_report(control=1.0))[-1]


def test_one_image_alone_has_no_column_of_drives():
    one = drive_report()
    one = one._replace(ours=one.ours._replace(sequences={}), contenders={})
    lines = found_lines(one)
    assert lines[1].endswith("frames")
    assert "whole drive" not in "".join([*lines, *compared_lines(one)])


def test_areas_of_sequences_in_a_table_below_the_scores(tmp_path):
    areas = {1: SCORES, 5: SCORES._replace(auc=0.875)}
    null = Contender("null", SCORES, sequences=areas)
    aside = Contender("without", SCORES)
    ours = Contender("this map", SCORES, sequences=areas | {11: SCORES._replace(auc=1.0)})
    one = report(leave_out=aside, null=null)._replace(ours=ours)
    assert sequence_table(one) == [
        ["AUC", "T = 1", "T = 5", "T = 11"],
        ["this map", "0.500", "0.875", "1.000"],
        ["null", "0.500", "0.875", ""],
    ]
    assert null.as_json()["sequences"]["5"] == {"auc": 0.875, "recall_at_1": 0.75}
    assert "0.875" in written(tmp_path, one)
    assert sequence_table(report(null=aside)) == []
    assert "sequences" not in aside.as_json()
    assert "T = " not in written(tmp_path, report(null=aside))


def test_the_summary_tells_what_was_scored():
    facts = {
        "truth": "place = query",
        "unit": "places",
        "unknown": 5,
        "ignored": 2,
        "judged": 13,
        "accepted": 9,
        "accepted_right": 8,
        "threshold_of_full_precision": 0.25,
        "resampling": {"step": 2.5, "reference_frames": 40, "query_frames": 30},
        "seconds_learn": 1.25,
        "seconds_localize": 2.0,
    }
    assert summary(report(facts)) == (
        "20 queries; right within 3 places of the truth (place = query). 40 frames of the reference and 30 "
        "of the query were resampled to even steps of 2.5 pixels of ground. 15 of the queries are in the "
        "truth. 2 queries report an ignored place, which is neither right nor wrong. 9 of 13 scored answers "
        "are accepted; 8 of these are right. `--threshold 0.25` would have accepted no wrong answer here. "
        "Learning took 1.2 s, localizing 2.0 s (100.0 ms per frame)."
    )
    assert summary(report()) == "20 queries; right within 3 frames."


def test_the_summary_weighs_the_bytes_of_the_map():
    baseline = Contender("all frames", SCORES._replace(recall_at_1=0.9), 64000, 1)
    words = "The map takes 125 bytes per place. All uncompressed features would take 2000 and find 90.0 %."
    assert words in summary(report({"frames": 32}, uncompressed=baseline)).replace("\xa0", " ")
    ours = Contender("this map", SCORES, 4000, fixed=3900)
    spectral = report({"frames": 32, "kind": "spectral"})._replace(ours=ours)
    assert "125 bytes per place, of which 3.12 grow with the route." in summary(spectral)
    unscored = summary(report()._replace(ours=Contender("this map", None)))
    assert "no scores without a ground truth" in unscored
    assert "None" not in unscored


STEPS = [  # facts, recall@1, verdict, steps
    ({"kind": "spectral"}, 0.95, "Yes: 19 of 20 queries", ["localize"]),
    ({"with_answer": 10}, 0.6, "Partly: 6 of 10 queries that have a right place", []),
    ({"kind": "templates"}, 0.2, "No: 4 of 20", ["--ordered", "--second", "localize"]),
    ({"kind": "spectral", "filter": True, "trained": {"steps": 1}}, 0.2, "No: ", ["localize"]),
    ({"with_answer": 0}, 0.0, "No query has a right place by this ground truth.", ["no query has a right"]),
    (
        {
            "with_answer": 0,
            "kind": "spectral",
            "rejection": {"off_map": {}},
            "accepted": 9,
            "accepted_right": 0,
        },
        *(0.0, "No query has a right place by this ground truth.", ["no query has a right", "localize"]),
    ),
    (
        {"rejection": {"off_map": {}}, "accepted": 9, "accepted_right": 8},
        *(1.0, "Accepted and right: 8; accepted and wrong: 1; not accepted: 11.", ["--calibration"]),
    ),
    (
        {"line": {"offset": 7, "answers": 9, "confident": 9}, "truth": "place = query"},
        *(0.0, "Not according to this ground truth", ["--truth 7"]),
    ),
    (
        {"least_probability": 0.5, "accepted": 20, "accepted_right": 4, "kind": "spectral", "filter": True},
        *(
            0.2,
            "Accepted and right: 4; accepted and wrong: 16;",
            ["order of the frames", "--second", "localize"],
        ),
    ),
    (
        {"least_probability": 0.5, "accepted": 20, "accepted_right": 5, "filter": True},
        *(0.2, "Accepted and right: 5; accepted and wrong: 15; not accepted: 0.", []),
    ),
    (
        {"probably_right": {"0.9": 18, "0.5": 19}},
        None,
        "18 of 20 answers have a probability of at least 0.9, 19 of",
        ["--ordered", "--precision", "--truth"],
    ),
    (
        {"probably_right": {"0.9": 0, "0.5": 1}},
        None,
        "No ground truth. 0 of 20 answers",
        ["--ordered", "--precision", "--truth"],
    ),
    ({}, None, "neither a ground truth", ["--truth 12"]),
]


@pytest.mark.parametrize(("facts", "recall", "told", "after"), STEPS)
def test_whether_it_worked_and_what_to_do_next(facts, recall, told, after):
    scores = None if recall is None else SCORES._replace(recall_at_1=recall)
    one = report(facts)._replace(ours=Contender("this map", scores, 4000))
    assert told in verdict(one)
    found = steps(one)
    assert len(found) == len(after), found
    assert [word for word, step in zip(after, found, strict=True) if word not in step] == []


def test_names_are_escaped(tmp_path):
    evil = "<script>alert('1 & 2')</script>"
    one = report({"truth": evil, "version": evil, "frames": 2}, hog=Contender(evil, SCORES))
    write_report(tmp_path, one, {"pr": Picture(canvas(1), evil, evil)}, evil, evil, evil)
    page = (tmp_path / "index.html").read_text()
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 8
    write_index(tmp_path, [[evil], [evil]], [evil], {evil: evil}, evil, evil)
    assert "<script" not in (tmp_path / "index.html").read_text()


def test_pictures_of_an_earlier_report_are_removed_and_other_files_stay(tmp_path):
    (tmp_path / "own.png").write_bytes(b"")
    written(tmp_path, report(), **{name: picture() for name in PICTURES})
    assert {file.stem for file in tmp_path.glob("*.png")} == {*PICTURES, "own"}
    written(tmp_path, report(), pr=picture())
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"own.png", "pr.png", "index.html", "report.json"}
    assert (tmp_path / "pr.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_fits_a_phone_and_needs_no_other_file(tmp_path):
    page = written(tmp_path, report({"frames": 32}), coverage=picture("places"), pr=picture("curves"))
    assert '<meta name="viewport" content="width=device-width,initial-scale=1">' in page
    assert page.count("data:image/png;base64,") == 2
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert page.index("places</h2>") < page.index("<dl>") < page.index("<table") < page.index("curves</h2>")
    # on a narrow screen a cell of the wide table carries its own heading
    assert '<table class="cards">' in page
    assert 'data-label="AUC rep."' in page
    for text in ("the plan</pre>", "dejavu demo\n", "torch 2"):
        assert text in page
    write_report(tmp_path, report(), {}, "a title", "a command")
    bare = (tmp_path / "index.html").read_text()
    assert not [text for text in ("the map</h2>", "<img", "<ul>", "None", "bytes", "null") if text in bare]
