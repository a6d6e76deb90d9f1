"""Checkpoints: what a run goes on from, what is refused, files that run no code, and maps without one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from command_line import fails
from helpers import refused
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import ModelCheckpoint
from safetensors.torch import load_file
from small_training import (
    FRAMES,
    Stop,
    coded,
    data_of,
    fit,
    footage,
    heights,
    last,
    mapper,
    new_descriptor,
    new_task,
    trainer,
    warned,
)

from dejavu_torch import DejaVu, ImposedPeriods
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.training.checkpoint import read_checkpoint

STEPS = 10
KINDS = {
    "templates": new_task,
    "code": lambda **given: new_task(**{"backbone": coded()} | given),
    "spectral": new_descriptor,
    "rate": lambda **given: new_descriptor(**{"rate": 1.0} | given),
}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Checkpoints of trainings that ended at step 4."""
    folder = tmp_path_factory.mktemp("parts")
    for kind, task in KINDS.items():
        trainer(folder, Stop(4, folder / f"{kind}.ckpt"), max_steps=STEPS).fit(task(), data_of())
    return {kind: folder / f"{kind}.ckpt" for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_takes_the_steps_that_are_left(tmp_path, parts, kind):
    again, running, rates = KINDS[kind](), trainer(tmp_path, max_steps=STEPS), []
    take = again.training_step

    def taken(*given):
        loss = take(*given)
        rates.append(running.optimizers[0].param_groups[0]["lr"] / again.lr)
        return loss

    again.training_step = taken  # type: ignore[method-assign]
    running.fit(again, data_of(), ckpt_path=parts[kind])
    assert rates == pytest.approx(heights(STEPS)[4:])
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.map.places) == (STEPS, FRAMES)


@pytest.mark.parametrize("stopped", [3, 4, 5])
@pytest.mark.parametrize("kind", ["templates", "spectral"])
def test_a_run_that_stops_and_goes_on_is_as_one_that_does_not(tmp_path, kind, stopped):
    """It draws the batches and augmentations that are left: in the middle of an epoch, and at its end."""
    maps = []
    for folder, ends in (("whole", (STEPS,)), ("parts", (stopped, STEPS))):
        torch.manual_seed(3)
        checkpoint = None
        for end in ends:
            task, data, stop = KINDS[kind](), data_of(), tmp_path / f"{end}.ckpt"
            running = trainer(tmp_path / folder, Stop(end, stop), max_steps=STEPS)
            running.fit(task, data, ckpt_path=checkpoint)
            checkpoint = stop
            torch.manual_seed(3)  # as of a new process
        maps.append(load_file(tmp_path / folder / "map.safetensors"))
    assert maps[0].keys() == maps[1].keys()
    assert all(torch.equal(maps[0][name], maps[1][name]) for name in maps[0])


# refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "task", "frames", "facts"),
    [
        (
            "templates",
            lambda: new_task(mapper=mapper(ImposedPeriods([3, 4], bin=2))),
            FRAMES,
            ["model", "map"],
        ),
        ("templates", lambda: new_task(mapper=mapper(metric="l2")), FRAMES, ["metric is 'l1'"]),
        ("templates", lambda: new_task(freeze=["linear"]), FRAMES, ["does not fit"]),
        ("templates", lambda: new_task(backbone=coded()), FRAMES, ["another model", "dejavu.descriptor"]),
        ("templates", new_task, 30, ["the map has 40 places", "the array has 30"]),
        ("spectral", new_task, FRAMES, ["of a DescriptorTask", "one of a TemplateTask"]),
        ("spectral", new_descriptor, 30, ["another model", "proxies"]),
        ("spectral", KINDS["rate"], FRAMES, ["another model", "log_step"]),
    ],
    ids=range(8),
)
def test_a_checkpoint_of_another_training_is_refused(tmp_path, parts, kind, task, frames, facts):
    running, data, own = trainer(tmp_path, max_steps=STEPS), data_of(footage(frames=frames)), task()
    with refused(*facts):
        from dejavu_torch.training.checkpoint import taking_over

        with taking_over(parts[kind], lambda: own.resumed):
            running.fit(own, data, ckpt_path=parts[kind])


def test_a_task_is_not_fitted_to_a_second_route(tmp_path):
    task = new_task()
    model = fit(tmp_path, task, data_of())
    for stage in ("fit", "validate"):
        with refused("the map has 40 places", "the array has 30", "expected the route"):
            getattr(trainer(tmp_path), stage)(task, data_of(footage()[:30]))
    # the same route once more goes on from its map
    templates = task.route.templates.detach().clone()
    assert torch.equal(templates, model.map.templates)
    trainer(tmp_path, max_steps=1).fit(task, data_of(second=ArrayTraverse(footage(0.1)), second_truth="0"))
    assert 0 < (task.route.templates - templates).abs().max() < 0.02


# files ---------------------------------------------------------------------------------------------------


class Touch:
    """Runs code if it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def test_a_pickle_runs_nothing_whatever_the_config_says(folder, parts, tmp_path, capfd):
    bad, root = tmp_path / "bad.ckpt", tmp_path / "new"
    torch.save(torch.load(parts["templates"], weights_only=True) | {"more": Touch()}, bad)
    words = ["--config", "train.yaml", "--ckpt_path", bad, "--weights_only", "false"]
    error = fails(capfd, "train", "fit", *words, "--trainer.default_root_dir", root)
    assert "more than tensors and plain data" in error
    assert not root.exists()
    assert not (folder / "executed").exists()


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda path, _: None, ["is not there"]),
        (lambda path, good: path.write_bytes(good[: len(good) // 2]), ["cannot be read"]),
        (lambda path, _: torch.save([1, 2], path), ["cannot be read"]),
        (lambda path, _: torch.save({"epoch": 1}, path), ["has no global_step"]),
    ],
)
def test_what_is_no_checkpoint(tmp_path, parts, make, facts):
    make(tmp_path / "bad.ckpt", parts["templates"].read_bytes())
    with refused("bad.ckpt", *facts, "expected a checkpoint that `dejavu train fit` wrote"):
        read_checkpoint(tmp_path / "bad.ckpt")


class Tidy(Callback):
    """Deletes the best checkpoint."""

    def on_train_end(self, trainer, pl_module):
        Path(trainer.checkpoint_callbacks[0].best_model_path).unlink()  # type: ignore[attr-defined]


def test_what_leaves_no_map_or_another_than_expected_warns(tmp_path, caplog):
    trainer(tmp_path, limit_train_batches=0).fit(new_task(), data_of())
    assert warned(caplog) == ["no training step was made: no map is written"]
    assert not (tmp_path / "map.safetensors").exists()
    caplog.clear()
    best, task = ModelCheckpoint(tmp_path, monitor="val/auc_augmented", mode="max"), new_task()
    trainer(tmp_path, best, Tidy(), last(tmp_path)).fit(task, data_of())
    assert warned(caplog) == [f"{best.best_model_path} is gone: the map is from the last step"]
    caplog.clear()
    trainer(tmp_path).fit(new_task(), data_of(), ckpt_path=tmp_path / "checkpoints" / "last.ckpt")
    (line,) = warned(caplog)
    assert line.startswith("nothing was trained: step 4 is already reached")
    assert torch.equal(DejaVu.load(tmp_path / "map.safetensors").map.templates, task.route.templates)
