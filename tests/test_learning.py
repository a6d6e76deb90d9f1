"""A long route, learned chunk by chunk: the same bytes however it is read, interrupted or divided."""

from __future__ import annotations

import errno
import importlib
import math
from contextlib import contextmanager

import pytest
import safetensors.torch
import torch
from command_line import frames, write_images
from helpers import long_from, refused

from dejavu_torch import growth, learning
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Chain, Part
from dejavu_torch.features import descriptor
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.learning import Checkpoint, ChunkEncoder, Sample
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import run_key
from dejavu_torch.places.layout import Layout

CHUNK, PLACES = 50, 1030


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    long_from(monkeypatch, 400)
    monkeypatch.setattr(learning, "SAVE_INTERVAL", -1)  # after each chunk


def route(places=PLACES, numbers=12):
    noise = torch.randn(places + 9, 1, numbers, generator=torch.Generator().manual_seed(1))
    return 4 * torch.nn.functional.avg_pool1d(noise.permute(2, 1, 0), 10, 1)[:, 0].T.contiguous()


def learned(traverse, bytes_=3.0, **settings):
    return DejaVu(mapper=SpectralMapper(bytes_, chunk=CHUNK)).learn(traverse, **settings)  # type: ignore[arg-type]


def file_of(model, folder):
    model.save(folder / "map.safetensors")
    return (folder / "map.safetensors").read_bytes()


def found_share(model, queries):
    """Of every seventh query, that shows the place of its number."""
    return float((model.localize(queries[::7]).index == torch.arange(0, PLACES, 7)).float().mean())


@pytest.fixture
def made(monkeypatch):
    """The places of each chunk that is coded."""
    seen = []

    def counted(descriptors, *rest):
        seen.append(len(descriptors))
        return encode_chunk(descriptors, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(learning, "encode_chunk", counted)
    return seen


def test_chunks_are_those_of_their_own_descriptors():
    model = learned(route())
    whitening, mapper = model.whitening, model.mapper
    assert whitening is not None
    coded = model.map.coded()
    for part, own in zip(route().split(CHUNK), coded, strict=True):
        descriptors = torch.cat([whitening(batch) for batch in part.split(model.batch_size)])
        expected = encode_chunk(
            descriptors, model.map.means[0], own.step, mapper.transform, mapper.resolution
        )
        assert torch.equal(own.stream.bytes, expected.stream.bytes)
        assert own.places == len(part)
    assert found_share(model, route()) > 0.95


@contextmanager
def two_threads():
    """In the block torch computes in two threads; they must still be two at its end."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        yield
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def settings_of(known):
    return known.means[-1], known.step, known.transform, known.resolution


def test_no_call_changes_the_number_of_threads():
    """Nor one that fails."""
    model = learned(route())
    encode = ChunkEncoder(ArrayTraverse(route()), model.descriptor, *settings_of(model.map))
    with two_threads():
        encode(range(CHUNK))
    bad = route()
    bad[::50] = math.nan
    for call in (learned, lambda one: growth.append(model, one)):
        with two_threads(), refused("NaN"):
            call(bad)


def test_bytes_do_not_hang_on_how_a_route_is_read(tmp_path):
    whole = file_of(learned(route()), tmp_path)
    parts = route().split([333, 1, 696])
    assert file_of(learned(Chain([ArrayTraverse(part) for part in parts])), tmp_path) == whole
    shuffled = torch.randperm(PLACES)
    some = Part(ArrayTraverse(route()[shuffled]), shuffled.argsort())
    assert file_of(learned(some), tmp_path) == whole
    with two_threads():
        assert file_of(learned(route()), tmp_path) == whole


def test_convention_the_sample_is_evenly_spaced_and_of_whole_chunks():
    found = Sample.of_route(Layout(PLACES), CHUNK)
    starts = found.frame[:: found.segment]
    assert (found.segment, len(found.frame)) == (CHUNK, 400)
    assert set((starts % CHUNK).tolist()) == {0}
    assert (starts[0], starts[-1]) == (0, PLACES // CHUNK * CHUNK - CHUNK)
    assert int(starts.diff().max() - starts.diff().min()) <= CHUNK
    # long chunks leave room for several stretches
    found = Sample.of_route(Layout(PLACES), 500)
    assert (found.segment, len(found.frame)) == (100, 400)
    assert int(found.frame.max()) < PLACES


def test_the_sample_of_a_long_route_meets_its_budget():
    assert abs(learned(route(), 4.0).summary().route_bytes / PLACES / 4 - 1) < 0.05


def test_a_second_traverse_tells_of_what_is_in_the_sample():
    torch.manual_seed(0)
    noisy = route() + 0.2 * torch.randn(PLACES, 12)
    views = LabelledFrames(ArrayTraverse(noisy), torch.arange(PLACES))
    sample = Sample.of_route(Layout(PLACES), CHUNK)
    assert len(sample.views(views).places) == 400
    shown = Sample.of_route(Layout(PLACES), CHUNK).views(
        LabelledFrames(views.traverse, torch.arange(PLACES) - 30)
    )
    assert torch.equal(sample.frame[shown.places] + 30, shown.traverse.frame)  # type: ignore[attr-defined]
    unseen = torch.tensor([one for one in range(PLACES) if one not in sample.frame][:40])
    with refused("none of the 400 frames", "segments of 50"):
        learned(route(), second=LabelledFrames(ArrayTraverse(noisy[unseen]), unseen))
    model = DejaVu(whitening=Whitening(numbers=8), mapper=SpectralMapper(8.0, chunk=CHUNK))
    model.learn(route(), second=views)
    assert found_share(model, noisy) > 0.9


def resumed(folder):
    """The file of a run with a checkpoint."""
    return file_of(learned(route(), checkpoint=Checkpoint(folder / "m")), folder)


def stopped(after):
    """As `map`, interrupted after so many chunks."""

    def some(encode, tasks):
        yield from map(encode, tasks[:after])
        raise KeyboardInterrupt

    return some


def test_finished_chunks_are_not_made_again(tmp_path, made):
    whole = file_of(learned(route()), tmp_path)
    assert sum(made) == PLACES
    with pytest.raises(KeyboardInterrupt):
        learned(route(), checkpoint=Checkpoint(tmp_path / "m"), map_tasks=stopped(8))
    for rest in (PLACES - 8 * CHUNK, 0):
        made.clear()
        assert resumed(tmp_path) == whole
        assert sum(made) == rest


def test_an_interruption_while_the_map_grows_adds_no_chunk_twice(tmp_path, monkeypatch):
    whole = file_of(learned(route()), tmp_path)
    extend, calls = SpectralMap.extend, iter([False, True])

    def interrupted(self, chunks, *rest):
        extend(self, chunks, *rest)
        if next(calls, False):
            raise KeyboardInterrupt

    monkeypatch.setattr(learning, "SAVE_INTERVAL", 0)
    monkeypatch.setattr(SpectralMap, "extend", interrupted)
    with pytest.raises(KeyboardInterrupt):
        resumed(tmp_path)
    assert resumed(tmp_path) == whole


def test_the_partial_map_is_written_each_minute(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "SAVE_INTERVAL", 60)
    now = iter(range(0, 10**6, 25))
    monkeypatch.setattr(learning, "monotonic", lambda: next(now))
    written = []
    save = Checkpoint.save

    def noted(self, route, *rest):
        written.append(len(route.chunks))
        save(self, route, *rest)

    monkeypatch.setattr(Checkpoint, "save", noted)
    learned(route(), checkpoint=Checkpoint(tmp_path / "m"))
    assert written == [3, 6, 9, 12, 15, 18, 21]


def test_a_long_route_holds_the_share_that_its_sample_holds():
    model = DejaVu(whitening="none", mapper=SpectralMapper(hold=0.8, chunk=CHUNK))
    noise = torch.randn(PLACES, 40, generator=torch.Generator().manual_seed(0))
    route = model.learn(noise).map
    assert isinstance(route, SpectralMap)
    missing = torch.cat([route.decode(g) for g in range(len(route.chunks))]) - noise
    assert 1 - float(missing.square().mean() / noise.var()) == pytest.approx(0.8, abs=0.02)


def test_the_partial_map_of_another_run_is_refused(tmp_path):
    part = tmp_path / "map.safetensors.part"

    def learn(*args, **settings):
        return learned(*args, **settings, checkpoint=Checkpoint(tmp_path / "map.safetensors"))  # type: ignore[arg-type]

    learn(route())
    kept = part.read_bytes()
    with refused(str(part), "settings"):
        learn(route(), bytes_=3.5)
    with refused(str(part), "source"):
        learn(route(PLACES + 1))
    with refused(str(part), "second differs"):
        learn(route(), second=LabelledFrames(ArrayTraverse(route() + 0.1), torch.arange(PLACES)))
    with refused(str(part), "another run", "file removed"):  # which keeps no chunks, but writes the map
        learn(route(400))
    Checkpoint(tmp_path / "map.safetensors").remove()  # that opened nothing
    assert part.read_bytes() == kept
    part.write_bytes(kept[:-9])
    with refused("map.safetensors.part", "not a partial map"):
        learn(route())
    assert part.read_bytes() == kept[:-9]


def test_other_code_is_another_run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "own_features.py"

    def key(factor):
        file.write_text(
            "import torch\nclass Own(torch.nn.Module):\n    def forward(self, x):\n"
            f"        return {factor} * x.flatten(1)\n"
        )
        own = importlib.import_module("own_features").Own()
        return run_key(DejaVu(own), ArrayTraverse(route()))

    first = key(2)
    assert key(2) == first
    assert key(30) != first
    monkeypatch.setattr("dejavu_torch.model_file.__version__", "0.0.7")
    assert key(2) != first


def test_a_full_disk_keeps_what_is_finished(tmp_path, made, monkeypatch):
    whole = file_of(learned(route()), tmp_path)
    save, room = safetensors.torch.save_file, iter(range(6))  # chunks

    def full(*file):
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")
        save(*file)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(safetensors.torch, "save_file", full)
        with refused("No space left", "300 of 1030", "m.part"):
            resumed(tmp_path)
    made.clear()
    assert resumed(tmp_path) == whole
    assert sum(made) == PLACES - 300


def test_an_image_that_cannot_be_read_is_named_and_the_rest_kept(tmp_path, made):
    folder = write_images(tmp_path / "route", frames(520, size=16))
    good = (folder / "434.png").read_bytes()

    def learn(name):
        model = DejaVu(HOG(cell=8), "none", SpectralMapper(8.0, chunk=CHUNK))
        return file_of(model.learn(open_source(folder), checkpoint=Checkpoint(tmp_path / name)), tmp_path)

    assert 434 not in Sample.of_route(Layout(520), CHUNK).frame
    whole = learn("undisturbed")
    (folder / "434.png").write_bytes(b"no image")
    with refused("434.png", "400 of 520", "m.part"):
        learn("m")
    (folder / "434.png").write_bytes(good)
    made.clear()
    assert learn("m") == whole
    assert sum(made) == 120


def test_descriptors_of_a_long_route_in_one_chunk_lie_in_a_file(monkeypatch):
    values = route(PLACES, 40)
    monkeypatch.setattr(descriptor, "IN_MEMORY", PLACES * 160 - 1)
    monkeypatch.setattr(descriptor, "DESCRIPTOR_MEMORY", PLACES * 100)
    model = DejaVu(whitening=Whitening(numbers=32))
    found = model.descriptor.learn(ArrayTraverse(values))
    assert found.dtype == torch.float16
    assert found.shape == (PLACES, 33)
    assert model.whitening is not None
    other = DejaVu(whitening=Whitening(numbers=32))
    other.descriptor.learn(ArrayTraverse(values[Sample.of_route(Layout(PLACES), learning.SAMPLE).frame]))
    for name, value in other.whitening.state_dict().items():  # type: ignore[union-attr]
        assert torch.equal(value, model.whitening.state_dict()[name])
    assert torch.allclose(found.float(), model.whitening(values), rtol=1e-3, atol=1e-3)
    assert found_share(DejaVu(whitening=Whitening(numbers=32)).learn(values), values) > 0.95


@pytest.mark.parametrize("name", [None, "first"])
def test_places_appended_to_a_map_are_kept_as_well(tmp_path, made, name):
    first, rest = route()[:500], route()[500:]
    visits = LabelledFrames(ArrayTraverse(rest + 0.1), torch.arange(len(rest)))
    model = learned(first)
    if name:
        model = growth.merge([model, model], [name, "second"])
    model.save(tmp_path / "before")

    def grown(**work):
        model = DejaVu.load(tmp_path / "before")
        made.clear()
        return growth.append(model, rest, visits=visits, route=name, **work)  # type: ignore[arg-type]

    whole = grown()
    assert made == [CHUNK] * 10 + [30]
    assert whole.map.visits.tolist() == [[1000 if name else 500, 1], [PLACES - 500, 2]]
    with pytest.raises(KeyboardInterrupt):
        grown(checkpoint=Checkpoint(tmp_path / "m"), map_tasks=stopped(4))
    again = grown(checkpoint=Checkpoint(tmp_path / "m"))
    assert sum(made) == PLACES - 500 - 4 * CHUNK
    assert file_of(again, tmp_path) == file_of(whole, tmp_path)
    with refused("m.part", "map"):  # it has more places by now
        growth.append(again, rest, visits=visits, route=name, checkpoint=Checkpoint(tmp_path / "m"))


def visits_of(places):
    """Frames that show these places; -1 is none."""
    noise = 0.5 * torch.randn(len(places), 12, generator=torch.Generator().manual_seed(2))
    return LabelledFrames(ArrayTraverse(route()[places] + noise), places)


def test_visits_are_averaged_in_chunk_by_chunk(tmp_path, made):
    # all places but some, one of them twice, some frames that show none, and against the direction
    places = torch.cat([torch.arange(0, 400), torch.tensor([7, -1, -1]), torch.arange(480, PLACES).flip(0)])

    def model():
        return DejaVu(whitening="none", mapper=SpectralMapper(3.0, chunk=CHUNK))

    whole = growth.learn_mean(model(), route(), visits_of(places))
    assert made == [CHUNK] * 20 + [30]
    sums, counts = route(), torch.ones(PLACES)
    shown = places >= 0
    sums.index_add_(0, places[shown], visits_of(places).traverse.values[shown])  # type: ignore[attr-defined]
    counts.index_add_(0, places[shown], torch.ones(int(shown.sum())))
    assert torch.equal(whole.map.visit_counts, counts.long())
    for own, mean in zip(whole.map.coded(), (sums / counts[:, None]).split(CHUNK), strict=True):
        settings = whole.map.means[0], own.step, whole.map.transform, whole.map.resolution
        assert torch.equal(own.stream.bytes, encode_chunk(mean, *settings).stream.bytes)
    bytes_ = file_of(whole, tmp_path)
    work = {"checkpoint": Checkpoint(tmp_path / "m")}
    with pytest.raises(KeyboardInterrupt):
        growth.learn_mean(model(), route(), visits_of(places), **work, map_tasks=stopped(8))
    with refused("m.part", "visits differs"):
        growth.learn_mean(model(), route(), visits_of(places.clamp(min=0)), **work)
    made.clear()
    assert file_of(growth.learn_mean(model(), route(), visits_of(places), **work), tmp_path) == bytes_
    assert sum(made) == PLACES - 8 * CHUNK
    with refused("953 frames", "1030 places"):
        growth.learn_mean(model(), route(), visits_of(places)._replace(places=torch.arange(PLACES)))
