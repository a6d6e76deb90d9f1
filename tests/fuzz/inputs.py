"""Valid input, made once and small: each maker fills a folder, from which readers take what they change."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image
from pytorch_lightning import Trainer
from videos import clip

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.templates import TemplateTask


def pictures(count, side=16, noise=0.0):
    """(count,side,side) uint8, a window slid along a strip that repeats every 12 pixels."""
    drawn = np.random.default_rng(0)
    strip = np.tile(drawn.integers(40, 215, (side, 12)), (1, 2 * count))[:, : count + side]
    strip = 0.6 * strip + 0.4 * drawn.integers(0, 255, strip.shape)
    frames = np.stack([strip[:, i : i + side] for i in range(count)])
    return np.clip(frames + noise * drawn.normal(size=frames.shape), 0, 255).astype(np.uint8)


def maps(folder):
    """Map files of every kind."""
    frames = torch.from_numpy(pictures(40))[:, None].float() / 255
    features = torch.from_numpy(np.random.default_rng(1).normal(size=(40, 12))).float()
    periods = ImposedPeriods([3, 4, 5], bin=2)
    network = SmallCNN(8, channels=1, resize=(16, 16), widths=(4, 8), squeeze=4)
    models = {
        "templates": (DejaVu(network, mapper=TemplateMapper(periods)), frames),
        "plan": (DejaVu(mapper=TemplateMapper(periods, reduction="sum", metric="l2")), features),
        "spectral": (DejaVu(), frames),
        "chunked": (DejaVu(mapper=SpectralMapper(chunk=16), whitening="none"), features),
        "rounded": (DejaVu(network, mapper=SpectralMapper(20.0), weight_bits=8), frames),
    }
    for name, (model, reference) in models.items():
        model.learn(reference).save(folder / f"{name}.safetensors")


def write_images(folder, images):
    folder.mkdir()
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{i}.png")


def images(folder):
    """One picture in every form that is read."""
    grey = pictures(1, 24)[0]
    colour = Image.fromarray(np.stack([grey, grey.T, 255 - grey], 2))
    for suffix in ("png", "jpg", "bmp", "tif", "webp", "ppm"):
        colour.save(folder / f"colour.{suffix}")
    for suffix in ("png", "jpg", "pgm", "tif"):
        Image.fromarray(grey).save(folder / f"grey.{suffix}")
    colour.quantize(16).save(folder / "palette.png")
    colour.convert("RGBA").save(folder / "alpha.png")
    Image.fromarray(grey.astype(np.uint16) * 256).save(folder / "sixteen.png")
    Image.fromarray(grey.astype(np.float32) / 255).save(folder / "float.tif")
    Image.fromarray(grey > 128).save(folder / "bits.png")
    colour.save(folder / "lzw.tiff", compression="tiff_lzw")
    turned = Image.Exif()
    turned[0x0112] = 6
    colour.save(folder / "turned.jpg", exif=turned)


def videos(folder):
    """Clips of a dozen frames in several containers."""
    kinds = {"a.mp4": ("libx264", "yuv420p"), "b.avi": ("mjpeg", "yuvj420p"), "c.mkv": ("ffv1", "bgr0")}
    kinds |= {"d.ts": ("libx264", "yuv420p"), "e.mov": ("mpeg4", "yuv420p"), "f.mjpeg": ("mjpeg", "yuvj420p")}
    frames = np.stack([pictures(12, 48)[:, :32]] * 3, 3)
    for name, (codec, pixels) in kinds.items():
        clip(folder / name, frames, codec, pixels)


def new_task():
    backbone = SmallCNN(8, channels=1, resize=(16, 16), widths=(4, 8), squeeze=4)
    return TemplateTask(backbone=backbone, mapper=TemplateMapper(ImposedPeriods([3, 4, 5], bin=2)))


def checkpoints(folder):
    """The checkpoint of a training of two steps."""
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = Trainer(
        accelerator="cpu", default_root_dir=folder, max_steps=2, enable_checkpointing=False, **quiet
    )
    trainer.fit(new_task(), RouteData(ArrayTraverse(pictures(40)), batch_size=20, tolerance=2))
    trainer.save_checkpoint(folder / "last.ckpt")


def inputs(folder):
    """A source of every kind: `in` of the folder of a case."""
    np.save(folder / "frames.npy", pictures(40))
    np.save(folder / "features.npy", np.random.default_rng(1).normal(size=(40, 12)).astype(np.float32))
    write_images(folder / "photos", pictures(30))
    clip(folder / "clip.mp4", np.stack([pictures(12, 48)[:, :32]] * 3, 3), "libx264", "yuv420p")
    Image.fromarray(pictures(1, 40)[0]).save(folder / "strip.png")
    (folder / "empty").mkdir()
    (folder / "a_file").write_text("a file")


def matches_text():
    rows = [f"{i},{max(0, i - i % 3)},{0.1 * i:.9g},{i % 2},{i}.png,{i}.png\n" for i in range(12)]
    return "query,place,score,accepted,query_name,place_name\n" + "".join(rows)
