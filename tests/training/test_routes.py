"""One descriptor for several routes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails, run, write_images
from helpers import refused
from small_training import CONFIG, Stop, backbone, data_of, footage, recall, trainer
from torch import nn

from dejavu_torch import DejaVu, RouteData, SpectralMapper, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import routes_of
from dejavu_torch.features.embedding import to_length
from dejavu_torch.training.descriptors import DescriptorTask, similar_span

LENGTHS = [40, 31, 23]
WEIGHTS = "out/descriptor.safetensors"
FIT = ("train", "fit", "--config", "train.yaml", "--data.source")


def routes(sizes=(16, 16, 16)):
    """Different routes; their names are their numbers."""
    made = []
    for i, (length, side) in enumerate(zip(LENGTHS, sizes, strict=True)):
        frames = footage(frames=length, side=side)
        made.append(ArrayTraverse(frames.flip(i % 2 + 1) if i else frames, str(i)))
    return made


def listed(source=None, **settings):
    return RouteData(routes() if source is None else source, **{"tolerance": 2, "batch_size": 16} | settings)


def task_of(**settings):
    return DescriptorTask(**{"backbone": backbone(), "mapper": SpectralMapper(20.0)} | settings)


# what is trained on --------------------------------------------------------------------------------------


def test_places_are_numbered_one_route_after_the_other_and_no_clip_crosses():
    data = listed(clip=4)
    data.setup("fit")
    frames, truth = data.sets["reference"][[0, 39, 40, 70, 71, 93]]
    assert truth.positives[:, 0].tolist() == [0, 39, 40, 70, 71, 93]
    at = [(0, 0), (0, 39), (1, 0), (1, 30), (2, 0), (2, 22)]
    expected = [routes()[i][frame] for i, frame in at]
    torch.testing.assert_close(frames, torch.stack(expected))
    for batch in data.train_dataloader():
        clips = torch.bucketize(batch.truth.positives[:, 0], torch.tensor([40, 71, 94]), right=True)
        assert bool((clips.view(-1, 4) == clips[::4, None]).all())


def test_neither_stretches_nor_the_tolerance_cross_from_one_route_to_the_next(tmp_path):
    """The loss is that of literal loops over places and proxies."""
    data, task = listed(tolerance=3), task_of()
    running = trainer(tmp_path, max_steps=1)
    running.fit(task, data)
    every = similar_span(data.sets["reference"], data.lengths, 3)
    assert every == 2  # shorter than the tolerance
    places = [(route, i) for route, length in enumerate(LENGTHS) for i in range(length)]
    stretches = list(dict.fromkeys((route, i // every) for route, i in places))
    assert len(task.proxies) == len(stretches)
    shown = [0, 38, 39, 40, 41, 70, 71, 93]
    batch = data.sets["reference"][shown]
    data.augmented = lambda frames, clip: frames  # type: ignore[method-assign]
    torch.manual_seed(1)
    loss = task.losses(batch).total
    torch.manual_seed(1)
    described = to_length(task.dejavu.descriptor.describe(batch.frames).float())
    noisy = described + 0.5 * torch.randn_like(described)
    distance = 1 - nn.functional.cosine_similarity(noisy[:, None], task.proxies[None], dim=2)
    surprise = []
    for row, place in zip(-distance / task.log_temperature.exp(), shown, strict=True):
        logits = torch.stack([row[stretches.index((route, i // every))] for route, i in places])
        here, at = places[place]
        right = [k for k, (route, i) in enumerate(places) if route == here and abs(i - at) <= every]
        surprise.append(logits.logsumexp(0) - logits[right].logsumexp(0))
    torch.testing.assert_close(loss, torch.stack(surprise).mean(), rtol=1e-4, atol=1e-4)
    loss.backward()
    assert all(bool(p.grad.isfinite().all()) for p in task.parameters() if p.grad is not None)


def test_an_answer_within_the_tolerance_beyond_the_end_of_a_route_is_wrong(tmp_path):
    """Every answer is one place after the right one."""
    data, task, asked = listed(tolerance=2), task_of(), []
    every = {"val_check_interval": 1, "check_val_every_n_epoch": None, "num_sanity_val_steps": 0}
    running = trainer(tmp_path, max_steps=1, **every)

    def scores(frames):
        answers = (torch.arange(len(frames)) + len(asked) + 1) % sum(LENGTHS)
        asked.extend(frames)
        return 1.0 - nn.functional.one_hot(answers, sum(LENGTHS)).float()

    task.forward = scores  # type: ignore[method-assign]
    running.fit(task, data)
    found = running.callback_metrics["val/recall_at_1_augmented"]
    assert float(found) == pytest.approx(1 - len(LENGTHS) / sum(LENGTHS))  # wrong at the end of each route


@pytest.mark.parametrize(
    ("sizes", "resize", "stored"),
    [
        ((20, 16, 12), None, (16, 16)),  # the backbone's
        ((12, 12, 12), None, (12, 12)),  # smaller than the backbone's: as they are
        ((20, 16, 12), (8, 10), (8, 10)),
    ],
    ids=str,
)
def test_all_routes_are_of_one_size(tmp_path, sizes, resize, stored):
    data = listed(routes(sizes), resize=resize)
    trainer(tmp_path, max_steps=1).fit(task_of(), data)
    assert {tuple(part.shape[1:]) for part in data.sets["reference"].parts} == {(1, *stored)}


def test_second_traverses_are_of_their_own_routes(tmp_path):
    second = [None, None, ArrayTraverse(footage(0.1, frames=20), "winter")]
    data = listed(second=second, second_truth=[None, None, "3"])
    trainer(tmp_path).fit(task_of(), data)
    start = sum(LENGTHS[:2])
    assert data.sets["second"].truth.positives[:, 0].tolist() == list(range(start + 3, start + 23))
    assert len(data.train_dataloader().dataset) == sum(LENGTHS) + 20  # type: ignore[arg-type]


# what it leaves ------------------------------------------------------------------------------------------


def test_a_training_leaves_a_descriptor_with_which_another_route_is_learned(tmp_path):
    trainer(tmp_path, max_steps=30).fit(task_of(), listed())
    base = DejaVu.load(tmp_path / "descriptor.safetensors")
    assert not (tmp_path / "map.safetensors").exists()
    assert (base.map.places, base.velocity, base.frame_shape) == (0, None, None)
    assert base.whitening is not None
    assert base.whitening.learned
    assert base.trained is not None
    assert base.trained.steps == 30
    other = footage(frames=60).flip(2)
    model, shared = (DejaVu(mapper=SpectralMapper(20.0)) for _ in range(2))
    model.descriptor.take(base.descriptor)
    model.learn(ArrayTraverse(other))
    assert model.whitening is not None
    assert not torch.equal(model.whitening.scale[:2], base.whitening.scale[:2])  # of this route
    assert recall(model, other) > 0.9
    shared.descriptor.take(DejaVu.load(tmp_path / "descriptor.safetensors").descriptor, whitening=True)
    shared.learn(ArrayTraverse(other))
    assert shared.whitening is not None
    assert torch.equal(shared.whitening.projection, base.whitening.projection)
    with refused("descriptor without a map", "learn"):
        base.localize(routes()[0])


def test_an_interrupted_run_resumes_with_the_same_list_and_no_other(tmp_path):
    part, alone = tmp_path / "part.ckpt", tmp_path / "alone.ckpt"
    trainer(tmp_path, Stop(4, part), max_steps=8).fit(task_of(), listed())
    trainer(tmp_path, Stop(4, alone), max_steps=8).fit(task_of(), data_of())
    on = trainer(tmp_path / "on", max_steps=8)
    on.fit(task_of(), listed(), ckpt_path=part)
    assert on.global_step == 8
    same_lengths = [ArrayTraverse(route.values, f"other {i}") for i, route in enumerate(routes())]
    three = "['0', 40], ['1', 31], ['2', 23]"
    for path, other, fact in (
        (part, listed(same_lengths), three),
        (part, listed(routes()[:2]), three),
        (part, data_of(), three),
        (alone, listed(), "trained on one route, the data is 0 and 2 more"),
    ):
        with refused(fact, "the same routes in the same order"):
            trainer(tmp_path / "no").fit(task_of(), other, ckpt_path=path)


# refusals ------------------------------------------------------------------------------------------------

POOLED = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(16, 8))


@pytest.mark.parametrize(
    ("source", "settings", "task", "facts"),
    [
        ([], {}, {}, ("source is an empty list", "at least one traverse")),
        (["a", None], {}, {}, ("source is of type NoneType", "a path")),
        (["sim:aerial", "sim:aerial"], {}, {}, ("sim:aerial is given twice",)),
        (None, {"second": routes()[0]}, {}, ("second lists 1, and there are 3 routes", "null")),
        (None, {"second_truth": "3"}, {}, ("second_truth lists 1, and there are 3 routes",)),
        (None, {"query": [routes()[0]] * 3}, {}, ("query is given", "3 routes", "--descriptor")),
        (routes((16, 20, 16))[:2], {}, {"backbone": POOLED}, ("1 has frames of (1, 20, 20)", "data.resize")),
        (None, {}, {"rate": 1.0}, ("model.rate is 1.0", "3 routes", "model.rate 0")),
    ],
    ids=["empty", "none", "twice", "one second", "one truth", "query", "sizes", "rate"],
)
def test_what_does_not_fit_several_routes_is_refused(tmp_path, source, settings, task, facts):
    with refused(*facts):
        trainer(tmp_path).fit(task_of(**task), listed(source, **settings))


# as a user of the commands meets it ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of two routes in `photos`, a third route in `third.npy`, and a training in `out`."""
    folder = tmp_path_factory.mktemp("routes")
    (folder / "photos").mkdir()
    for i, route in enumerate(routes()[:2]):
        write_images(folder / "photos" / f"day{9 + i}", np.asarray(route.values))
    np.save(folder / "third.npy", np.asarray(routes()[2].values))
    head, tail = CONFIG.partition("    mapper:")[0], CONFIG[CONFIG.index("data:") :].replace("run", "out")
    head = head.replace("TemplateTask", "DescriptorTask")
    mapper = "    mapper: {class_path: SpectralMapper, init_args: {route_bytes_per_place: 20}}\n"
    (folder / "train.yaml").write_text(head + mapper + tail)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run(*FIT, "photos")
    return folder


@pytest.fixture(autouse=True)
def _here(folder, monkeypatch):
    monkeypatch.chdir(folder)


def test_a_folder_of_folders_is_a_route_each(tmp_path):
    assert routes_of(Path("photos")) == ["photos/day9", "photos/day10"]
    assert routes_of("photos?width=8") == ["photos/day9?width=8", "photos/day10?width=8"]
    assert len(open_source(routes_of("photos?width=8")[1])) == LENGTHS[1]
    for whole in ("photos/day9", ".", "third.npy", "gone", "", "sim:aerial", str(tmp_path)):
        assert routes_of(whole) == [whole]


def test_info_says_what_it_is(capsys):
    run("info", WEIGHTS)
    told = capsys.readouterr().out
    hint = f"next: dejavu learn ROUTE --descriptor {WEIGHTS}"
    assert [
        one for one in ("without a map", "SmallCNN", "trained for 4 steps", hint) if one not in told
    ] == []


LEARN = ["learn", "third.npy", "--map", "new.safetensors", "--descriptor", WEIGHTS]


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (["localize", WEIGHTS, "third.npy", "--out", "m.csv"], ["without a map", f"--descriptor {WEIGHTS}"]),
        (["compare", "third.npy", "third.npy", "--map", WEIGHTS, "--out", "o"], ["without a map"]),
        ([*LEARN, "--features.cell", "4"], ["learned with", "SmallCNN"]),
        ([*LEARN, "--preprocess.contrast", "patch"], ["--preprocess.contrast", "one or the other"]),
        ([*LEARN, "--weight_bits", "8"], ["--weight_bits", "one or the other"]),
        ([*LEARN, "--whitening", WEIGHTS], ["--whitening", "--descriptor"]),
        ([*LEARN[:4], "--descriptor", "train.yaml"], ["train.yaml"]),
        ([*LEARN[:3], WEIGHTS, "--descriptor", WEIGHTS], ["is an input"]),
        (
            ["compare", *2 * ["third.npy"], "--map", "m.safetensors", "--descriptor", WEIGHTS, "--out", "o"],
            ["--descriptor", "--map has its own settings"],
        ),
    ],
    ids=lambda given: " ".join(given)[:60],
)
def test_a_mistake_is_one_line(capsys, words, facts):
    error = fails(capsys, *words)
    assert [fact for fact in facts if fact not in error] == [], error
    assert not Path("new.safetensors").exists()
