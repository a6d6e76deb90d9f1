"""Queries that are not independent of a map, or not made as it was, are told; second visits are not."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import torch
from command_line import fails, run
from helpers import long_from, refused
from torch.utils._python_dispatch import TorchDispatchMode

from dejavu_torch import HOG, DejaVu, Preprocess, SpectralMapper, Whitening, compare, model_file, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import Chain, Part
from dejavu_torch.evaluation.evaluate import Asked, evaluate_file
from dejavu_torch.evaluation.options import Learning
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import append, average, learn_mean, merge, only_route
from dejavu_torch.maps.digest import BYTES, PLACES, Digest, digests_of, signs_of
from dejavu_torch.maps.file import read_map
from dejavu_torch.model_file import state_from_json, state_to_json
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.provenance import Alike, Provenance, Spread, alike
from dejavu_torch.recognition.provenance import relation as related
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.teaching import refine
from dejavu_torch.updating import update

NUMBERS = 24


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed))


def drive(places, seed=0, window=24):
    """Descriptors (N,24) of a dense drive: of length 1, and alike over so many frames."""
    noise = random(places + window - 1, NUMBERS, seed=seed)
    smooth = torch.nn.functional.avg_pool1d(noise.T[None], window, 1)[0].T
    return torch.nn.functional.normalize(smooth)


def again(rows, seed=1, light=0.5, noise=0.05):
    """Another visit: what changes from day to day, and noise."""
    day = torch.nn.functional.normalize(random(1, rows.shape[1], seed=seed))
    return rows + light * day + noise * random(*rows.shape, seed=seed + 1)


def learned(rows, **settings):
    return DejaVu(whitening="none", mapper=SpectralMapper(**settings)).learn(rows)


EMPTY = SpectralMapper().empty(torch.zeros(1, NUMBERS).bfloat16())


def relation(known, asked, place_map=None):
    return related(place_map or EMPTY, known, asked)


class Heard(list):
    """The digests of queries, batch by batch."""

    def __call__(self, rows):
        self.append(digests_of(rows, follow=False))

    @property
    def digests(self):
        return torch.cat([*self])


def told(model, queries):
    """What is said of queries."""
    traverse, heard = ArrayTraverse(queries, "queries"), Heard()
    list(model.matches(traverse, Querying(match="single"), heard=heard))
    doubts = model.provenance.doubts(model.map, heard.digests, traverse)
    assert all(doubt.kind == "provenance" for doubt in doubts)
    return " | ".join(map(str, doubts))


# digests


def test_digests_are_the_same_everywhere():
    """Files keep them: whatever changes them makes older maps silent."""
    assert digests_of(torch.eye(3)).tolist() == [
        [86, 67, 222, 30, 126, 131, 220, 37, 25],
        [146, 199, 171, 19, 35, 35, 95, 61, 34],
        [4, 83, 154, 138, 216, 239, 112, 254, 34],
    ]
    rows = drive(3000)
    whole = digests_of(rows)
    assert whole.shape == (3000, BYTES)
    for part in (slice(0, 1), slice(7, 1500), slice(2999, 3000)):
        assert torch.equal(digests_of(rows[part])[:-1], whole[part][:-1])
        assert torch.equal(digests_of(rows[part])[:, :-1], whole[part][:, :-1])
        assert torch.equal(digests_of(3 * rows[part])[:, :-1], whole[part][:, :-1])
    assert torch.equal(digests_of(rows.double()), whole)
    signs = signs_of(whole)
    changes = (signs[1:] != signs[:-1]).sum(1)
    assert torch.equal(whole[:-1, -1].long(), changes)
    assert not digests_of(torch.zeros(2, 5)).any()
    assert digests_of(torch.zeros(0, 5)).shape == (0, BYTES)


def test_digests_of_places_that_are_not_known():
    digest = Digest(torch.tensor([2, 4, 9]), digests_of(drive(3)))
    assert torch.equal(digest.of(torch.tensor([4, 9])), digest.rows[1:])
    assert torch.equal(digest.of(torch.tensor([3, 4])), torch.stack([0 * digest.rows[0], digest.rows[1]]))
    assert digest.of(torch.tensor([3, 5])).shape == (0, BYTES)
    assert digest.within(4, 10).places.tolist() == [0, 5]


# what is told of queries


def test_frames_of_a_map_are_told_in_any_order_and_part():
    rows = drive(600)
    known = digests_of(rows)[::4]
    shuffled = rows[torch.randperm(600, generator=torch.Generator().manual_seed(0))]
    others = torch.cat([drive(500, seed=7), rows[100:300], drive(500, seed=8)])
    for queries in (rows, rows.flip(0), shuffled, rows[200:400], rows[::3], rows.half(), others):
        assert relation(known, digests_of(queries)) == "frames"
    sparse = random(200, NUMBERS)  # no frame is like another
    assert relation(digests_of(sparse), digests_of(sparse[50:90])) == "frames"


def test_frames_between_those_of_a_map_are_told_where_these_are_dense():
    rows, sparse = drive(800), random(400, NUMBERS)
    for known, queries in (
        (rows[::2], rows[1::2]),
        (rows[::2], rows[1::6]),
        (rows[::2], rows[1::2].flip(0)),
        (rows[::4], rows[2::4]),
        (rows[::2], again(rows, light=0, noise=0.002)),
    ):
        assert relation(digests_of(known), digests_of(queries)) in ("between", "frames")
    assert relation(digests_of(sparse[::2]), digests_of(sparse[1::2])) == ""


def test_frames_between_others_are_not_told_over_an_area_nor_of_few_ready_numbers():
    rows = drive(800)
    halves = digests_of(rows[::2]), digests_of(rows[1::2])
    narrow = SpectralMapper().empty(torch.zeros(1, 9).bfloat16())
    area = SpectralMapper().empty(torch.zeros(1, NUMBERS).bfloat16()).laid_out(Layout(20, 20))
    assert relation(*halves) == "between"
    assert relation(*halves, area) == ""
    assert relation(halves[0], halves[0], area) == "frames"
    for images, told in ((True, "frames"), (False, "")):  # frames of a short route have few dimensions, too
        assert related(narrow, halves[0], halves[0], images) == told


def test_second_visits_are_not_told():
    rows, sparse = drive(800), torch.nn.functional.normalize(random(300, NUMBERS))
    for known, queries in (
        (rows, again(rows)),
        (rows, again(rows, noise=0)),
        (rows, again(rows)[::5]),
        (rows, again(rows).repeat_interleave(3, 0)),
        (rows, again(rows)[200:400].flip(0)),
        (rows[::4], again(rows)),
        (rows, drive(500, seed=5)),
        (sparse, again(sparse)),
        (rows, again(rows)[:5]),
        (rows, torch.zeros(50, NUMBERS)),
    ):
        assert relation(digests_of(known), digests_of(queries)) == ""


@pytest.mark.parametrize("seed", range(3))
def test_second_visits_of_few_ready_numbers_are_not_told_and_calibrate(seed, caplog):
    """Of 5 numbers, 64 signs are mostly the same few, and many equal by chance."""
    rows = torch.nn.functional.avg_pool1d(random(5, 408, seed=seed), 9, 1).T
    visit = rows + 0.1 * rows.std() * random(400, 5, seed=seed + 10)
    model = learned(rows)
    digests = digests_of(model.descriptor.all_of(ArrayTraverse(visit)), follow=False)
    assert model.provenance.doubts(model.map, digests, ArrayTraverse(visit)) == []
    model.calibrate(None, LabelledFrames(ArrayTraverse(visit, "visit"), torch.arange(400)))
    assert model.calibration is not None
    assert "probabilities may be too high" not in caplog.text


def test_places_are_compared_with_many_queries_in_little_memory():
    class Largest(TorchDispatchMode):
        numbers = 0

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            out = function(*args, **(kwargs or {}))
            self.numbers = max(self.numbers, out.numel() if isinstance(out, torch.Tensor) else 0)
            return out

    known, asked = digests_of(drive(256)), digests_of(drive(20_000, seed=1))
    with Largest() as largest:
        alike(known, asked)
    assert largest.numbers <= 64 * 20_000  # the signs themselves


def test_too_few_tell_nothing():
    rows = drive(100)
    assert alike(digests_of(rows), digests_of(rows[:7])) == Alike()
    assert alike(torch.zeros(0, BYTES, dtype=torch.uint8), digests_of(rows)) == Alike()
    standing = rows[:1].repeat(200, 1)  # all are equal, so that equal ones tell nothing
    assert alike(digests_of(standing), digests_of(standing)).same == 0


def test_a_standing_camera_and_a_second_visit_to_it():
    rows = drive(400)
    stopped = torch.cat([rows[:200], rows[200:201].repeat(150, 1), rows[200:]])
    assert relation(digests_of(stopped)[::2], digests_of(stopped)) == "frames"
    assert relation(digests_of(stopped)[::2], digests_of(again(stopped))) == ""


# what a map keeps


def test_a_map_keeps_digests_of_some_places_however_it_was_made(tmp_path, monkeypatch):
    rows = drive(900)
    whole = learned(rows, chunk=100).map
    assert whole.digested.tolist() == [*range(0, 900, 4)]
    assert torch.equal(whole.digest, digests_of(rows)[::4])
    grown = learned(rows[:200], chunk=100)
    assert len(grown.map.digest) == 200
    for part in rows[200:].split(300):
        append(grown, part)
    assert torch.equal(grown.map.digest, whole.digest)
    routes = [learned(rows[:500], chunk=100), learned(drive(300, seed=3), chunk=100)]
    merged = merge(routes, ["a", "b"])
    assert merged.map.digested.tolist() == [*range(0, 500, 4), *range(500, 800, 4)]
    assert torch.equal(merged.map.digest[:125], digests_of(rows)[:500:4])
    assert told(merged, rows[:300])
    assert told(only_route(merged, "b"), drive(300, seed=3))
    grown.save(tmp_path / "m.safetensors")
    assert torch.equal(DejaVu.load(tmp_path / "m.safetensors").map.digest, whole.digest)
    size = grown.summary()
    assert size.fixed["digest"] == whole.digest.numel() <= PLACES * BYTES
    assert size.map_bytes == (tmp_path / "m.safetensors").stat().st_size
    without = DejaVu.load(tmp_path / "m.safetensors")
    without.map.digest = without.map.digest[:0]
    assert without.summary().route == size.route
    long_from(monkeypatch, 250)
    assert torch.equal(learned(rows, chunk=100).map.digest, whole.digest)


def test_a_map_file_without_digests_says_nothing(tmp_path):
    rows, model = drive(300), learned(drive(300))
    model.map.digest, model.map.digested = model.map.digest[:0], model.map.digested[:0]
    model.provenance = Provenance()
    model.save(tmp_path / "old.safetensors")
    tensors, header = read_map(tmp_path / "old.safetensors")
    assert "map.digest" not in tensors
    assert "provenance" not in header
    old = DejaVu.load(tmp_path / "old.safetensors")
    assert told(old, rows) == ""
    assert told(append(old, drive(300, seed=2)), drive(300, seed=2))  # of its new places it tells
    with refused("a digest (299, 9)", "(150, 9)"):
        learned(rows).map.load_state_dict(learned(rows).map.state_dict() | {"digest": digests_of(rows)[1:]})


def test_templates_keep_none():
    from helpers import template_model

    rows = drive(120)
    assert told(template_model(whitening="none").learn(rows), rows) == ""


def test_visits_to_average_leave_the_digest_that_of_the_reference(monkeypatch):
    rows, visits = drive(300), LabelledFrames(ArrayTraverse(again(drive(300)), "mean"), torch.arange(300))
    expected = digests_of(rows)[::2]
    for long in (False, True):
        if long:
            long_from(monkeypatch, 100)
        model = learn_mean(DejaVu(whitening="none", mapper=SpectralMapper(chunk=60)), rows, visits)
        changes = model.map.digest[:, :-1] != expected[:, :-1]
        assert not changes.any()
        assert "taught this map (mean)" in told(model, again(rows))
    model = learned(rows, chunk=60)
    average(model, visits)
    assert not (model.map.digest[:, :-1] != expected[:, :-1]).any()
    assert "taught this map (mean)" in told(model, again(rows))
    assert "frames of the map itself" in told(model, rows)


def test_drives_that_taught_a_map_are_told(tmp_path):
    rows = drive(400)
    second, third = (again(rows, seed=seed, light=0.3) for seed in (3, 5))
    model = learned(rows)
    assert (told(model, second), told(model, third)) == ("", "")
    model.calibrate(None, LabelledFrames(ArrayTraverse(second, "day two"), torch.arange(400)))
    assert "the queries taught this map (day two): another visit" in told(model, second)
    assert told(model, third) == ""
    model.save(tmp_path / "m.safetensors")
    model = DejaVu.load(tmp_path / "m.safetensors")
    assert "(day two)" in told(model, second[100:300])
    assert state_from_json(state_to_json(model.state)).provenance == model.provenance
    other = merge([model, learned(drive(200, seed=9))], ["a", "b"])
    assert "(day two)" in told(other, second)
    unplaced = LabelledFrames(ArrayTraverse(third, "nowhere"), torch.full((400,), -1))
    assert model.taught_by(*unplaced[:2]).provenance == DejaVu.load(tmp_path / "m.safetensors").provenance


@pytest.mark.parametrize("teach", [refine, update])
def test_a_drive_that_refined_a_map_is_told(teach):
    rows = drive(400)
    noise = rows.std() * random(400, NUMBERS, seed=4)
    changed = torch.cat([rows[:, :12] + 2 * noise[:, :12], rows[:, 12:] + 0.1 * noise[:, 12:]], 1)
    model = learned(rows)
    assert told(model, changed) == ""
    assert teach(model, ArrayTraverse(changed, "monday")).changed
    assert "(monday)" in told(model, changed)
    assert [name for name, _ in model.provenance.taught] == ["monday"]


def test_images_that_taught_the_whitening_are_told():
    road, second, third = (open_source(f"sim:aerial?frames=150&size=32&traverse={i}") for i in (0, 1, 2))
    model = DejaVu(HOG(), Whitening(views=1))
    model.learn(road, second=LabelledFrames(second, torch.arange(150)))
    lines = []
    for queries in (road, second, third, Part(road, range(1, 150, 2))):
        heard = Heard()
        list(model.matches(queries, heard=heard))
        lines.append(" ".join(map(str, model.provenance.doubts(model.map, heard.digests, queries))))
    assert "frames of the map itself" in lines[0]
    assert f"taught this map ({second.name})" in lines[1]
    assert lines[2] == ""
    assert "frames of the map itself" in lines[3]


# what is refused


def test_a_map_is_not_calibrated_by_its_own_drive(caplog):
    rows, at = drive(400), torch.arange(400)
    model = learned(rows)
    with refused("calibrating by own: it has frames of the map", "another visit"):
        model.calibrate(None, LabelledFrames(ArrayTraverse(rows, "own"), at))
    assert model.calibration is None
    mixed = ArrayTraverse(torch.cat([rows[:100], again(rows)[100:]]), "mixed")
    with caplog.at_level(logging.WARNING):
        model.calibrate(None, LabelledFrames(mixed, at))
    assert "calibrating by mixed: it has frames of the map itself" in caplog.text
    model = learned(rows[::2])
    with caplog.at_level(logging.WARNING):
        model.calibrate(None, LabelledFrames(ArrayTraverse(rows[1::2], "odd"), at[:200]))
    assert "odd" in caplog.text
    assert "frames between those of the map" in caplog.text  # as noise would look
    frames = torch.nn.functional.interpolate(
        torch.rand(60, 1, 8, 8, generator=torch.Generator().manual_seed(0)).repeat_interleave(3, 0), (32, 32)
    )
    frames = torch.nn.functional.avg_pool1d(frames.flatten(1).T[None], 9, 1)[0].T.view(-1, 1, 32, 32)
    images = DejaVu(HOG(resize=(32, 32)), "none", SpectralMapper(40.0), preprocess=Preprocess(blank=0))
    images.learn(frames[::2])
    images.calibrate(frames[::2])  # by altered copies
    assert images.calibration is not None
    count = len(frames[1::2])
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        images.calibrate(None, LabelledFrames(ArrayTraverse(frames[1::2], "odd"), torch.arange(count)))
    assert "calibrating by odd: it has frames between those of the map" in caplog.text


def test_a_maker_is_named_by_a_file_beside_the_descriptors(tmp_path, capsys):
    rows = drive(200)
    for name, maker in (("a", "net 1"), ("b", "net 2"), ("c", None), ("d", "net 1")):
        np.save(tmp_path / f"{name}.npy", (rows if name == "a" else again(rows)).numpy())
        if maker:
            (tmp_path / f"{name}.json").write_text(json.dumps({"maker": maker, "date": 3}))
    a, b, c, d = (tmp_path / f"{name}.npy" for name in "abcd")
    assert [open_source(one).maker for one in (a, b, c)] == ["net 1", "net 2", ""]
    assert open_source(f"{a}?start=3").maker == "net 1"
    assert Chain([open_source(a), open_source(d)]).maker == "net 1"
    assert Chain([open_source(a), open_source(c)]).maker == ""
    with refused("b.npy has descriptors of 'net 2'", "'net 1'"):
        Chain([open_source(a), open_source(b)])
    path = tmp_path / "m.safetensors"
    run("learn", a, "--map", path)
    assert DejaVu.load(path).provenance.maker == "net 1"
    capsys.readouterr()
    run("info", path)
    assert "made by: net 1" in capsys.readouterr().out
    seen = "b.npy has descriptors of 'net 2', {} has those of 'net 1'; expected the same"
    for words, owner in (
        (("localize", path, b, "--out", tmp_path / "m.csv"), "the map"),
        (("learn", b, "--append", path, "--map", tmp_path / "n.safetensors"), "the map"),
        (("refine", path, b), "the map"),
        (("compare", a, b, "--truth", "0", "--out", tmp_path / "r"), str(a)),
    ):
        assert seen.format(owner) in fails(capsys, *words)
    run("localize", path, c, "--out", tmp_path / "m.csv")
    run("localize", path, d, "--out", tmp_path / "m.csv")
    models = [DejaVu(whitening="none").learn(one) for one in (a, b)]
    with refused("'net 1'", "'net 2'", "the same"):
        merge(models, ["a", "b"])
    run("learn", c, "--map", path)
    capsys.readouterr()
    run("info", path)
    assert capsys.readouterr().out.count("made by: unknown") == 1
    assert "is an input" in fails(capsys, "localize", path, a, "--out", tmp_path / "a.json")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", ("a.json", "JSON")),
        ('{"maker": 3}', ("a.json", "maker is 3")),
        ("[1, 2]", None),
        ('{"other": 3}', None),
    ],
)
def test_files_that_name_no_maker(tmp_path, text, words):
    np.save(tmp_path / "a.npy", drive(30).numpy())
    (tmp_path / "a.json").write_text(text)
    if words is None:
        assert open_source(tmp_path / "a.npy").maker == ""
        return
    with refused(*words):
        open_source(tmp_path / "a.npy")


def network(rows, seed, numbers=64):
    """Descriptors of places by one of several networks: none is negative, and each has a mean of its own."""
    drawn = random(rows.shape[1], numbers, seed=seed)
    return torch.nn.functional.normalize((rows @ drawn + random(1, numbers, seed=seed + 50)).relu())


def test_descriptors_of_another_network_are_told_and_not_appended(tmp_path, capsys):
    rows, new = drive(400), drive(300, seed=6)
    own, visit = network(rows, 1), network(again(rows, light=0.2), 1)
    model = learned(own)
    assert told(model, visit) == ""
    append(model, network(new, 1))
    append(model, network(new[:1], 1).repeat(80, 1))  # as of a camera that stands
    for foreign in (network(rows, 2), network(new, 3), 10 * visit, visit[:, torch.arange(64).flip(0)]):
        assert "the descriptors of queries differ from the map's" in told(model, foreign)
        with refused("queries differ from the map's as those of another network do", ".json"):
            append(model, ArrayTraverse(foreign, "queries"))
    assert told(model, network(rows, 2)[:40]) == ""  # too few
    for name, values in (("own", own), ("foreign", network(rows, 2))):
        np.save(tmp_path / f"{name}.npy", values.numpy())
    path, foreign = tmp_path / "m.safetensors", tmp_path / "foreign.npy"
    run("learn", tmp_path / "own.npy", "--map", path)
    capsys.readouterr()
    run("localize", path, foreign, "--out", tmp_path / "m.csv")
    assert capsys.readouterr().out.count("differ from the map's") == 1
    assert "another network" in fails(capsys, "learn", foreign, "--append", path)
    (tmp_path / "foreign.json").write_text('{"maker": "net"}')  # the map's is still not known
    assert "another network" in fails(capsys, "learn", foreign, "--append", path)


def test_means_tell_nothing_where_they_are_those_of_places():
    parts = (random(1, 64, seed=seed) + 0.1 * random(100, 64, seed=seed + 9) for seed in range(1, 5))
    route = torch.cat([*parts])
    spread = Spread.of(ArrayTraverse(route, "route"))
    assert spread is not None
    assert spread.steady < 0.3
    other = Spread.of(ArrayTraverse(random(1, 64, seed=3) + 0.1 * random(200, 64), "other"))
    assert other is not None
    assert not spread.unlike(other)
    for rows in (random(300, 8), random(40, 64), torch.zeros(300, 64), torch.rand(60, 3, 8, 8)):
        assert Spread.of(ArrayTraverse(rows, "rows")) is None


# what commands say

SAYS = "the queries are frames of the map itself"


def test_commands_say_it_once(tmp_path, capsys):
    rows = drive(400)
    for name, values in (
        ("a", rows),
        ("own", rows),
        ("b", again(rows)),
        ("odd", rows[1::2]),
        ("even", rows[::2]),
    ):
        np.save(tmp_path / f"{name}.npy", values.numpy())
    a, own, b, odd, even = (tmp_path / f"{name}.npy" for name in ("a", "own", "b", "odd", "even"))
    path, csv, out = tmp_path / "m.safetensors", tmp_path / "m.csv", tmp_path / "out"
    run("learn", a, "--map", path)
    run("learn", even, "--map", tmp_path / "even.safetensors")
    capsys.readouterr()
    for map, source, words, line in (
        (path, own, (), SAYS),
        (path, own, ("--match", "single"), SAYS),
        (path, own, ("--match", "filter"), SAYS),
        (path, f"{own}?start=200", ("--top", "3"), SAYS),
        (tmp_path / "even.safetensors", odd, ("--ordered",), ""),  # nor of little noise told from a visit
        (path, b, ("--ordered",), ""),
        (path, a, ("--loops", "30"), ""),
    ):
        run("localize", map, source, "--out", csv, *words)
        said = capsys.readouterr().out
        assert said.count("the queries are frames") == bool(line)
        assert line in said
        if not words or words[0] == "--ordered":
            run("evaluate", csv, "--truth", "0", "--map", map, "--query", source, "--out", out)
            said = capsys.readouterr().out
            assert said.count("the queries are frames") == bool(line)
            assert line in said
            doubts = json.loads((out / "report.json").read_text())["doubts"]
            assert [doubt["kind"] for doubt in doubts] == ["provenance"] * bool(line)
    for words, line in (((own, "--truth", "0"), SAYS), ((b, "--truth", "0"), ""), (("--loops", "30"), "")):
        run("compare", a, *words, "--out", out)
        assert capsys.readouterr().out.count(SAYS) == bool(line)
        assert len(json.loads((out / "report.json").read_text())["doubts"]) == bool(line)
    run("info", path)
    assert "taught by" not in capsys.readouterr().out


def test_a_map_is_read_once_to_say_it(tmp_path, monkeypatch):
    model, rows, path = learned(drive(100)), drive(100), tmp_path / "m.safetensors"
    model.save(path)
    reads = []
    monkeypatch.setattr(model_file, "read_map", lambda path: reads.append(path) or read_map(path))
    (tmp_path / "m.csv").write_text("query,place,score\n" + "".join(f"{i},{i},0\n" for i in range(100)))
    for query, said in ((ArrayTraverse(rows, "own"), 1), (None, 0)):
        reads.clear()
        found = evaluate_file(tmp_path / "m.csv", "0", asked=Asked(map=path, query=query))
        assert [doubt["text"].startswith(SAYS) for doubt in found.report.facts["doubts"]] == [True] * said
        assert reads == [path]


def test_copies_that_are_moved_are_not_compared():
    road = open_source("sim:aerial?frames=150&size=32")
    found = compare(road, Part(road, range(150)), "0", querying=Querying(shifts=[-0.1, 0.1], ordered=True))
    assert any(SAYS in doubt["text"] for doubt in found.report.facts["doubts"])
    second = open_source("sim:aerial?frames=150&size=32&traverse=1")
    found = compare(road, second, learning=Learning(calibration="none"))
    assert found.report.facts["doubts"] == []


# real footage

ROUTES = {
    "floors": ("floors_rejection/reference.npy", "floors_rejection/query.npy", "between"),
    "laps": ("donkey_lap/reference.npy", "donkey_lap/query.npy", ""),
    "city": ("robotcar/t1/reference.npy", "robotcar/t1/query.npy", ""),
    "corridor laps": ("corridor_laps/reference.npy", "corridor_laps/query.npy", ""),
    "walks": ("wifi_mall/reference.npy", "wifi_mall/query.npy", ""),
    "magnetometer": ("magnetic_laps/reference.npy", "magnetic_laps/query.npy", ""),
    "lidar": ("lidar_fhw/reference.npy", "lidar_fhw/query.npy", ""),
    "gardens": ("gardens_night_hdc/reference.npy", "gardens_night_hdc/query.npy", ""),
}
DENSE = ("laps", "floors", "walks", "magnetometer")  # of which frames between others are told


@pytest.mark.figures
@pytest.mark.parametrize("name", ROUTES)
def test_second_visits_of_real_routes(name, data_dir):
    reference, query, expected = ROUTES[name]
    reference, query = (open_source(f"{data_dir}/{one}") for one in (reference, query))
    model = DejaVu().learn(reference)
    heard = Heard()
    list(model.matches(query, Querying(match="single"), heard=heard))
    lines = [str(doubt) for doubt in model.provenance.doubts(model.map, heard.digests, query)]
    assert related(model.map, model.map.digest, heard.digests) == expected
    assert len(lines) == bool(expected)
    halves = [Part(reference, range(i, len(reference), 2)) for i in (0, 1)]
    model, heard = DejaVu().learn(halves[0]), Heard()
    list(model.matches(halves[1], Querying(match="single"), heard=heard))
    assert related(model.map, model.map.digest, heard.digests) == ("between" if name in DENSE else "")
