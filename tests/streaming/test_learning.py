"""A long route, learned chunk by chunk: the same bytes however it is read, interrupted or divided."""

from __future__ import annotations

import errno
import importlib
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import safetensors.torch
import torch
from command_line import frames, write_images
from dejavu_torch.streaming.coder import ChunkCoder, code_here, joined
from dejavu_torch.streaming.sample import sample_of
from dejavu_torch.streaming.work import WorkFolder, all_chunks, work_folder_of
from helpers import Stream, refused
from torch import Tensor

from dejavu_torch import growth
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.chain import Chain
from dejavu_torch.data.output import PREFIX
from dejavu_torch.data.source import open_source
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.spectral import SpectralMap, SpectralMapper, code_chunk
from dejavu_torch.model import DejaVu
from dejavu_torch.streaming import coder, sample
from dejavu_torch.types import Traverse

CHUNK, PLACES = 50, 1030


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "SAMPLE", 400)
    monkeypatch.setattr(coder, "SHARD", 100)  # 11 shards of two chunks


def route(places: int = PLACES, numbers: int = 12) -> Tensor:
    noise = torch.randn(places + 9, 1, numbers, generator=torch.Generator().manual_seed(1))
    return 4 * torch.nn.functional.avg_pool1d(noise.permute(2, 1, 0), 10, 1)[:, 0].T.contiguous()


def learned(traverse: Traverse | Tensor, bytes_: float = 3.0, **settings: object) -> DejaVu:
    return DejaVu(mapper=SpectralMapper(bytes_, chunk=CHUNK)).learn(traverse, **settings)  # type: ignore[arg-type]


def file_of(model: DejaVu, folder: Path) -> bytes:
    model.save(folder / "map.safetensors")
    return (folder / "map.safetensors").read_bytes()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The places of each chunk that is coded."""
    seen: list[int] = []

    def counted(descriptors: Tensor, *rest: object) -> object:
        seen.append(len(descriptors))
        return code_chunk(descriptors, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(coder, "code_chunk", counted)
    return seen


def test_chunks_are_those_of_their_own_descriptors() -> None:
    model = learned(route())
    whitening, mapper = model.whitening, model.mapper
    assert whitening is not None
    coded = model.map.coded()
    for part, own in zip(route().split(CHUNK), coded, strict=True):
        descriptors = torch.cat([whitening(batch) for batch in part.split(model.batch_size)])
        expected = code_chunk(descriptors, model.map.mean, own.step, mapper.transform, mapper.resolution)
        assert torch.equal(own.stream.bytes, expected.stream.bytes)
        assert own.places == len(part)
    found = model.localize(route()[::7])
    assert (found.index == torch.arange(0, PLACES, 7)).float().mean() > 0.95


def test_a_short_route_is_learned_from_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "SAMPLE", PLACES)
    model = DejaVu(mapper=SpectralMapper(3.0, chunk=CHUNK))
    whole = model.learn_features(model.describe_reference(ArrayTraverse(route())), ArrayTraverse(route()))
    assert file_of(learned(route(), work=WorkFolder(tmp_path / "work")), tmp_path) == file_of(whole, tmp_path)
    assert not (tmp_path / "work").exists()


def test_bytes_do_not_hang_on_how_a_route_is_read(tmp_path: Path) -> None:
    whole = file_of(learned(route()), tmp_path)
    parts = route().split([333, 1, 696])
    assert file_of(learned(Stream(route())), tmp_path) == whole  # of unknown length, in odd batches
    assert file_of(learned(Chain([ArrayTraverse(part) for part in parts])), tmp_path) == whole
    assert file_of(learned(Chain([Stream(part) for part in parts])), tmp_path) == whole
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert file_of(learned(route()), tmp_path) == whole
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_bytes_do_not_hang_on_the_order_of_shards(tmp_path: Path) -> None:
    def shuffled(*work: object) -> Iterator[object]:
        model, traverse, shards, text = work
        for shard in sorted(shards, key=lambda shard: shard.start * 7 % 11):  # type: ignore[call-overload]
            yield from code_here(model, traverse, [shard], text)  # type: ignore[arg-type]

    assert file_of(learned(route(), make=shuffled), tmp_path) == file_of(learned(route()), tmp_path)


def test_convention_the_sample_is_evenly_spaced_and_of_whole_chunks() -> None:
    found = sample_of(PLACES, CHUNK)
    starts = found.frame[:: found.stretch]
    assert found.stretch == CHUNK
    assert len(found.frame) == 400
    assert set((starts % CHUNK).tolist()) == {0}
    assert starts[0] == 0
    assert starts[-1] == PLACES // CHUNK * CHUNK - CHUNK
    assert int(starts.diff().max() - starts.diff().min()) <= CHUNK
    # long chunks leave room for several stretches
    found = sample_of(PLACES, 500)
    assert found.stretch == 100
    assert len(found.frame) == 400
    assert int(found.frame.max()) < PLACES


def test_the_budget_is_met_as_far_as_the_sample_tells(caplog: pytest.LogCaptureFixture) -> None:
    def size(model: DejaVu) -> float:
        return model.summary().route_bytes / PLACES

    with caplog.at_level(logging.WARNING):
        assert abs(size(learned(route(), 4.0)) / 4 - 1) < 0.05
        caplog.clear()
        louder = route()
        louder[:CHUNK] *= 0.1  # the sample has all of it, and less of what follows
        louder[CHUNK : 2 * CHUNK] *= 9
        model = learned(louder, 4.0)
    assert abs(size(model) / 4 - 1) > 0.02
    assert [text for text in caplog.messages if f"{size(model):.3g}" in text and "400 of its 1030" in text]


def test_names_are_beside_the_budget() -> None:
    class Named(ArrayTraverse):
        def frame_name(self, i: int) -> str:
            return f"{i * i % 10007}"

    model, plain = learned(Named(route()), 4.0), learned(route(), 4.0)
    assert model.summary().fixed["names"] > PLACES
    assert model.summary().route == plain.summary().route
    assert model.frame_names[3] == "9"


def test_where_the_default_budget_gives_way_one_line_says_so(caplog: pytest.LogCaptureFixture) -> None:
    mapper = SpectralMapper(chunk=3)  # whose chunks alone take over 9 bytes per place
    model = DejaVu(whitening="none", mapper=mapper).learn(route())
    assert model.summary().route_bytes > 9 * PLACES
    assert len(caplog.messages) == 1


def test_a_second_traverse_tells_of_what_is_in_the_sample() -> None:
    torch.manual_seed(0)
    noisy = route() + 0.2 * torch.randn(PLACES, 12)
    views = Views(ArrayTraverse(noisy), torch.arange(PLACES))
    assert len(sample_of(PLACES, CHUNK).views(views).places) == 400
    shown = sample_of(PLACES, CHUNK).views(Views(views.traverse, torch.arange(PLACES) - 30))
    assert torch.equal(sample_of(PLACES, CHUNK).frame[shown.places] + 30, shown.traverse.frame)  # type: ignore[attr-defined]
    unseen = torch.tensor([one for one in range(PLACES) if one not in sample_of(PLACES, CHUNK).frame][:40])
    with refused("none of the 400 frames", "stretches of 50"):
        learned(route(), second=Views(ArrayTraverse(noisy[unseen]), unseen))
    model = DejaVu(whitening=Whitening(numbers=8), mapper=SpectralMapper(8.0, chunk=CHUNK))
    model.learn(route(), second=views)
    assert (model.localize(noisy[::7]).index == torch.arange(0, PLACES, 7)).float().mean() > 0.9


def test_finished_chunks_are_not_made_again(tmp_path: Path, made: list[int]) -> None:
    whole = file_of(learned(route()), tmp_path)
    assert sum(made) == PLACES
    made.clear()

    def killed(*work: object) -> Iterator[object]:
        for done, part in enumerate(code_here(*work)):  # type: ignore[arg-type]
            if done == 4:
                raise KeyboardInterrupt
            yield part

    with pytest.raises(KeyboardInterrupt):
        learned(route(), work=WorkFolder(tmp_path / "work"), make=killed)
    assert len(made) >= 8
    made.clear()
    work = WorkFolder(tmp_path / "work")
    again = learned(route(), work=work)
    assert sum(made) == PLACES - 8 * CHUNK
    assert file_of(again, tmp_path) == whole
    made.clear()
    # one that is damaged, and one that is lost
    files = sorted((tmp_path / "work").glob("chunks-*"))
    files[2].write_bytes(files[2].read_bytes()[:-1])
    files[5].unlink()
    assert file_of(learned(route(), work=WorkFolder(tmp_path / "work")), tmp_path) == whole
    assert made == [CHUNK] * 4
    work.remove()
    assert not (tmp_path / "work").exists()


def test_chunks_of_another_run_are_refused(tmp_path: Path) -> None:
    folder = work_folder_of(tmp_path / "map.safetensors")
    assert folder.name == "map.safetensors.work"
    learned(route(), work=WorkFolder(folder))
    kept = {file.name: file.read_bytes() for file in folder.iterdir()}
    with refused(str(folder), "settings"):
        learned(route(), bytes_=3.5, work=WorkFolder(folder))
    with refused(str(folder), "source"):
        learned(route() + 1, work=WorkFolder(folder))
    with refused(str(folder), "source"):
        learned(route(PLACES + 1), work=WorkFolder(folder))
    short = WorkFolder(folder)
    with refused(str(folder), "another run", "folder removed"):  # which keeps no chunks, but writes the map
        learned(route(400), work=short)
    short.remove()
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == kept
    mine = WorkFolder(tmp_path / "mine")
    mine.path.mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with refused("mine"):
        learned(route(), work=mine)
    learned(route(400), work=mine)
    mine.remove()
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


def test_what_the_whitening_learns_from_is_of_the_run(tmp_path: Path) -> None:
    def second(shift: float) -> Views:
        return Views(ArrayTraverse(route() + shift), torch.arange(PLACES))

    learned(route(), work=WorkFolder(tmp_path / "work"), second=second(0.1))
    for other in (second(0.2), None):
        with refused("work", "second differs"):
            learned(route(), work=WorkFolder(tmp_path / "work"), second=other)


def test_other_code_is_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "own_features.py"

    def key(factor: int) -> dict[str, str]:
        file.write_text(
            "import torch\nclass Own(torch.nn.Module):\n    def forward(self, x):\n"
            f"        return {factor} * x.flatten(1)\n"
        )
        own = importlib.import_module("own_features").Own()
        return DejaVu(own).run_key(ArrayTraverse(route()), PLACES)

    first = key(2)
    assert key(2) == first
    assert key(30) != first
    monkeypatch.setattr("dejavu_torch.model.__version__", "0.0.7")
    assert key(2) != first


def test_a_run_of_which_nothing_is_finished_blocks_no_other(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "route", frames(520, size=16))
    good = (folder / "1.png").read_bytes()  # in the sample

    def learn() -> None:
        mapper = SpectralMapper(8.0, chunk=CHUNK)
        model = DejaVu(HOG(cell=8), "none", mapper)
        model.learn(open_source(folder), work=WorkFolder(tmp_path / "work"))

    (folder / "1.png").write_bytes(b"no image")
    with refused("1.png"):
        learn()
    (tmp_path / "work" / f"{PREFIX}of-a-kill").mkdir()
    (folder / "1.png").write_bytes(good)
    WorkFolder(tmp_path / "work").check_unused()
    learn()
    assert len(list((tmp_path / "work").glob("chunks-*"))) == 6
    # a kill ahead of the first whole file
    (tmp_path / "other" / f"{PREFIX}of-a-kill").mkdir(parents=True)
    WorkFolder(tmp_path / "other").open({})


def test_a_full_disk_keeps_what_is_finished(
    tmp_path: Path, made: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = file_of(learned(route()), tmp_path)
    save, room = safetensors.torch.save_file, iter(range(4))  # the fit, and three shards

    def full(*file: object) -> None:
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")
        save(*file)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(safetensors.torch, "save_file", full)
        with refused("No space left", "300 of 1030", "work"):
            learned(route(), work=WorkFolder(tmp_path / "work"))
    made.clear()
    assert file_of(learned(route(), work=WorkFolder(tmp_path / "work")), tmp_path) == whole
    assert sum(made) == PLACES - 300


def test_an_image_that_cannot_be_read_is_named_and_the_rest_kept(tmp_path: Path, made: list[int]) -> None:
    folder = write_images(tmp_path / "route", frames(520, size=16))
    good = (folder / "434.png").read_bytes()
    settings = {"features": HOG(cell=8), "whitening": "none"}

    def model() -> DejaVu:
        return DejaVu(**settings, mapper=SpectralMapper(8.0, chunk=CHUNK))  # type: ignore[arg-type]

    assert 434 not in sample_of(520, CHUNK).frame
    whole = file_of(model().learn(open_source(folder)), tmp_path)
    (folder / "434.png").write_bytes(b"no image")
    with refused("434.png", "400 of 520", "work"):
        model().learn(open_source(folder), work=WorkFolder(tmp_path / "work"))
    (folder / "434.png").write_bytes(good)
    made.clear()
    assert file_of(model().learn(open_source(folder), work=WorkFolder(tmp_path / "work")), tmp_path) == whole
    assert sum(made) == 120
    # what was changed since is made again, and nothing else
    made.clear()
    (folder / "434.png").write_bytes((folder / "435.png").read_bytes())
    model().learn(open_source(folder), work=WorkFolder(tmp_path / "work"))
    assert sum(made) == 100


def test_a_route_that_ends_early_is_refused() -> None:
    model = DejaVu(whitening="none", mapper=SpectralMapper(3.0, chunk=CHUNK))
    settings = (model.pipeline, None, 64, PLACES + 60, CHUNK, route().mean(0).bfloat16(), 0.1, "dft", 0.0)
    with refused("1030", "1090"):
        all_chunks(ChunkCoder(*settings), ArrayTraverse(route()))  # type: ignore[arg-type]


def test_shards_cover_all_chunks_once() -> None:
    whole = ChunkCoder(None, None, 64, 1030, 30, torch.zeros(1), 1.0, "dft", 0.0)  # type: ignore[arg-type]
    numbers = [chunk for shard in whole.shards() for chunk in shard]
    assert numbers == list(range(35))
    assert whole.span(whole.shards()[-1]) == (960, 1030)
    assert [len(run) for run in joined([whole.shards()[i] for i in (0, 1, 3, 5, 6, 7)])] == [2, 1, 3]


def test_descriptors_of_a_long_route_in_one_chunk_lie_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    values = route(PLACES, 40)
    small = DejaVu().describe_reference(ArrayTraverse(values))
    assert small.dtype == torch.float32
    monkeypatch.setattr("dejavu_torch.model.IN_MEMORY", PLACES * 160 - 1)
    monkeypatch.setattr("dejavu_torch.model.FEW_DESCRIPTORS", PLACES * 100)
    model = DejaVu(whitening=Whitening(numbers=32))
    found = model.describe_reference(ArrayTraverse(values))
    assert found.dtype == torch.float16
    assert found.shape == (PLACES, 33)
    assert model.whitening is not None
    other = DejaVu(whitening=Whitening(numbers=32))
    other.describe_reference(ArrayTraverse(values[sample_of(PLACES, sample.SAMPLE).frame]))
    for name, value in other.whitening.state_dict().items():  # type: ignore[union-attr]
        assert torch.equal(value, model.whitening.state_dict()[name])
    exact = model.whitening(values)
    assert torch.allclose(found.float(), exact, rtol=1e-3, atol=1e-3)
    learnt = DejaVu(whitening=Whitening(numbers=32)).learn(values)
    assert (learnt.localize(values[::7]).index == torch.arange(0, PLACES, 7)).float().mean() > 0.95


@pytest.mark.parametrize("scale", [1e-8, 1e5])
def test_features_that_nothing_whitens_keep_their_scale(
    scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dejavu_torch.model.FEW_DESCRIPTORS", PLACES * 4)
    model = DejaVu(whitening="none").learn(route() * scale)
    assert (model.localize(route()[::7] * scale).index == torch.arange(0, PLACES, 7)).float().mean() > 0.95


def test_places_appended_to_a_map_are_kept_as_well(tmp_path: Path, made: list[int]) -> None:
    first, rest = route()[:500], route()[500:]

    def stopped(*work: object) -> Iterator[object]:
        for done, part in enumerate(code_here(*work)):  # type: ignore[arg-type]
            if done == 2:
                raise KeyboardInterrupt
            yield part

    whole = file_of(growth.append(learned(first), rest), tmp_path)
    with pytest.raises(KeyboardInterrupt):
        growth.append(learned(first), rest, work=WorkFolder(tmp_path / "work"), make=stopped)  # type: ignore[arg-type]
    model = learned(first)
    made.clear()
    assert file_of(growth.append(model, rest, work=WorkFolder(tmp_path / "work")), tmp_path) == whole
    assert sum(made) == PLACES - 500 - 4 * CHUNK
    with refused("work", "map"):  # it has more places by now
        growth.append(model, rest, work=WorkFolder(tmp_path / "work"))
    other = learned(first)
    other.map.mean += 1  # of the same streams
    with refused("work", "map"):
        growth.append(other, rest, work=WorkFolder(tmp_path / "work"))


def test_a_map_appended_to_is_that_of_both_parts(tmp_path: Path) -> None:
    whole = learned(route())
    assert whole.whitening is not None
    part = DejaVu(whitening=whole.whitening, mapper=whole.mapper)
    part.learn_features(whole.whitened(route()[:600]), ArrayTraverse(route()))
    part.map = SpectralMap.of_chunks(whole.map.coded()[:12], whole.map.mean, **whole.map.settings())
    growth.append(part, route()[600:])
    assert file_of(part, tmp_path) == file_of(whole, tmp_path)


def visits_of(places: Tensor, kind: type[Traverse] = ArrayTraverse) -> Views:
    """Frames that show these places; -1 is none."""
    noise = 0.5 * torch.randn(len(places), 12, generator=torch.Generator().manual_seed(2))
    return Views(kind(route()[places] + noise), places)  # type: ignore[call-arg]


def test_visits_are_averaged_in_chunk_by_chunk(tmp_path: Path, made: list[int]) -> None:
    # all places but some, one of them twice, some frames that show none, and against the direction
    places = torch.cat([torch.arange(0, 400), torch.tensor([7, -1, -1]), torch.arange(480, PLACES).flip(0)])

    def model() -> DejaVu:
        return DejaVu(whitening="none", mapper=SpectralMapper(3.0, chunk=CHUNK))

    whole = growth.learn_mean(model(), route(), visits_of(places))
    assert made == [CHUNK] * 20 + [30]
    sums, counts = route(), torch.ones(PLACES)
    shown = places >= 0
    sums.index_add_(0, places[shown], visits_of(places).traverse.values[shown])  # type: ignore[attr-defined]
    counts.index_add_(0, places[shown], torch.ones(int(shown.sum())))
    assert torch.equal(whole.map.visit_counts, counts.long())
    for own, mean in zip(whole.map.coded(), (sums / counts[:, None]).split(CHUNK), strict=True):
        settings = whole.map.mean, own.step, whole.map.transform, whole.map.resolution
        assert torch.equal(own.stream.bytes, code_chunk(mean, *settings).stream.bytes)
    bytes_ = file_of(whole, tmp_path)
    assert file_of(growth.learn_mean(model(), route(), visits_of(places, Stream)), tmp_path) == bytes_

    def stopped(*work: object) -> Iterator[object]:
        for done, part in enumerate(code_here(*work)):  # type: ignore[arg-type]
            if done == 4:
                raise KeyboardInterrupt
            yield part

    work = WorkFolder(tmp_path / "work")
    with pytest.raises(KeyboardInterrupt):
        growth.learn_mean(model(), route(), visits_of(places), work=work, make=stopped)  # type: ignore[arg-type]
    with refused("work", "visits differs"):
        growth.learn_mean(model(), route(), visits_of(places.clamp(min=0)), work=work)
    made.clear()
    assert file_of(growth.learn_mean(model(), route(), visits_of(places), work=work), tmp_path) == bytes_
    assert sum(made) == PLACES - 8 * CHUNK
    for bad, words in (
        (visits_of(places)._replace(places=places + 1), ("shows place 1030", "1030")),
        (visits_of(places)._replace(places=torch.arange(PLACES)), ("353", "of 400")),
    ):
        with refused(*words):
            growth.learn_mean(model(), route(), bad)


def test_visits_to_appended_places_are_averaged_in_chunk_by_chunk(tmp_path: Path, made: list[int]) -> None:
    def grown(**settings: object) -> DejaVu:
        model = learned(route()[:500])
        made.clear()
        visits = Views(ArrayTraverse(route()[500:] + 0.1), torch.arange(PLACES - 500))
        return growth.append(model, route()[500:], visits=visits, **settings)  # type: ignore[arg-type]

    whole = grown(work=WorkFolder(tmp_path / "work"))
    assert made == [CHUNK] * 10 + [30]
    assert whole.map.visits.tolist() == [[500, 1], [PLACES - 500, 2]]
    assert file_of(grown(work=WorkFolder(tmp_path / "work")), tmp_path) == file_of(whole, tmp_path)
    assert made == []


def test_a_long_route_of_ready_features_holds_their_variance(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Wide ones that change from place to place: reduced, though nothing whitens, and resumed alike."""
    random = torch.Generator().manual_seed(0)
    basis = torch.randn(60, 300, generator=random)
    places = torch.randn(PLACES, 60, generator=random) @ basis
    wide = ArrayTraverse(places)

    def learn() -> DejaVu:
        model = DejaVu(whitening="none", mapper=SpectralMapper(chunk=CHUNK))
        return model.learn(wide, work=WorkFolder(tmp_path / "work"))

    first, again = learn(), learn()
    assert first.map.dimension == 61
    assert first.summary().route_bytes > 8 * PLACES
    assert "route_bytes_per_place" not in caplog.text
    assert torch.equal(again(places[:9]), first(places[:9]))
    assert torch.equal(first.localize(places[::50]).index, torch.arange(0, PLACES, 50))
