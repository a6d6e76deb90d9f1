"""Folders of images: order, pixel formats, and images that do not fit."""

from __future__ import annotations

import shutil
import sys
import types

import numpy as np
import pytest
import torch
from helpers import all_of, refused
from PIL import Image

from dejavu_torch import memory
from dejavu_torch.data.folder import ImageFolder, _has_heif, read_image
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Chain, Part
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import Preprocess

GREY = np.arange(20, dtype=np.uint8).reshape(4, 5) * 10
COLOUR = np.stack([GREY, 255 - GREY, GREY // 2], 2)


def write(path, *names):
    """Grey images, the j-th all of value j."""
    for j, name in enumerate(names):
        Image.new("L", (5, 4), j).save(path / name)


def with_alpha(pixels):
    return np.concatenate([pixels.reshape(4, 5, -1), np.full((4, 5, 1), 90, np.uint8)], 2)


@pytest.mark.parametrize(
    ("names", "ordered"),
    [
        (("9.png", "10.png", "200.png"), True),
        (("drive_0001.png", "drive_0002.png"), True),
        (("a.png", "b.png"), False),
        (("a_7.png", "b_3.png"), False),  # each of another drive
        (("a_3.png", "b_3.png"), False),
        (("1.png", "2_left.png"), False),
        (("1305031102.175304.png", "1305031102.211214.png", "1305031103.011214.png"), True),
        (("1305031102.99.png", "1305031102.175304.png"), False),  # by their digits: 99 before 175304
    ],
)
def test_names_that_end_in_rising_numbers_are_in_order(tmp_path, names, ordered):
    write(tmp_path, *names)
    assert ImageFolder(tmp_path).ordered is ordered


@pytest.mark.parametrize(
    ("image", "name", "expected"),
    [
        (Image.fromarray(GREY), "a.png", GREY[..., None] / 255),
        (Image.fromarray(COLOUR), "a.png", COLOUR / 255),
        (Image.fromarray(with_alpha(COLOUR)), "a.png", COLOUR / 255),
        (Image.fromarray(with_alpha(GREY), "LA"), "a.png", GREY[..., None] / 255),
        (Image.fromarray(GREY.astype(np.uint16) * 257), "a.tif", GREY[..., None] / 255),
        (Image.fromarray(GREY > 90), "a.png", (GREY > 90)[..., None]),
        (Image.fromarray(COLOUR).quantize(256), "a.png", COLOUR / 255),
        (Image.fromarray(COLOUR), "a.bmp", COLOUR / 255),
        (Image.fromarray(COLOUR), "a.PPM", COLOUR / 255),
        (Image.fromarray(GREY), "a.pgm", GREY[..., None] / 255),
    ],
)
def test_pixel_formats(image, name, expected, tmp_path):
    image.save(tmp_path / name)
    found = read_image(tmp_path / name)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor(expected).float().permute(2, 0, 1), atol=1e-6, rtol=0)


def test_the_order_of_names_that_two_tools_sort_differently(tmp_path, caplog):
    write(tmp_path, "f9.png", "f10.png", "g.png")
    (tmp_path / "3.png").mkdir()
    natural, texts = ([0, 1, 2], [1, 0, 2])
    for order, expected in (("natural", natural), ("lexicographic", texts)):
        folder = ImageFolder(tmp_path, order=order)
        assert (all_of(folder)[:, 0, 0, 0] * 255).tolist() == expected
        assert folder.names == [["f9.png", "f10.png", "g.png"][i] for i in expected]
        assert not folder.ordered
    assert caplog.text == ""
    for _ in range(2):
        assert torch.equal(all_of(ImageFolder(tmp_path)), all_of(ImageFolder(tmp_path, order="natural")))
    (line,) = caplog.messages  # once
    for words in (str(tmp_path), "f9.png before f10.png", "?order=lexicographic", "?order=natural"):
        assert words in line


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("missing", (), ("missing", "expected a folder")),
        ("empty", (), ("empty", "contains no images", "expected files such as .png")),
        (".", (), ("contains no images", "but folders such as empty")),
        ("full", (-1, 0), ("width=-1", "expected width and height of at least 0")),
        ("full", (10**5, 10**5), ("expected", "at most")),
    ],
)
def test_what_is_no_folder_of_images_and_sizes_that_no_frame_has(tmp_path, name, given, words):
    for folder in ("empty", "full"):
        (tmp_path / folder).mkdir()
    (tmp_path / "empty" / "notes.txt").touch()
    write(tmp_path / "full", "1.png")
    with refused(*words):
        all_of(ImageFolder(tmp_path / name, *given))


def test_mixed_images_are_refused_by_name(tmp_path):
    write(tmp_path, "0.png", "1.png", "2.png")
    Image.new("L", (5, 6)).save(tmp_path / "1.png")
    with refused("1.png", "6 x 5 pixels of 1 channel", "expected 4 x 5 pixels of 1 channel", "0.png"):
        all_of(ImageFolder(tmp_path))


def test_all_images_have_the_channels_of_the_first(tmp_path, caplog):
    colours = np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8)
    for name, kinds in {"day": ("RGB", "L", "L"), "night": ("L", "RGB", "L")}.items():
        (tmp_path / name).mkdir()
        for i, kind in enumerate(kinds):
            Image.fromarray(colours).convert(kind).save(tmp_path / name / f"{i}.png")
    day, night = ImageFolder(tmp_path / "day"), ImageFolder(tmp_path / "night")
    late = ImageFolder(tmp_path / "day")[1:3]  # the first is read for its channels alone
    assert (all_of(day).shape, late.shape) == ((3, 3, 4, 5), (2, 3, 4, 5))
    assert torch.equal(all_of(day)[1:], late)
    assert torch.equal(late[0, 0], late[0, 2])
    mean = torch.from_numpy(colours.astype(np.float32)).div(255).mean(2)
    assert torch.allclose(all_of(night)[1, 0], mean, atol=1e-6)
    assert caplog.text.count("grey images are read as colour, as the first image is") == 1
    assert caplog.text.count("images in colour are read as grey, as the first image is") == 1


def test_images_that_are_left_out_are_told(tmp_path, caplog, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    _has_heif.cache_clear()
    write(tmp_path, "1.png", "2.png")
    for name in ("3.heic", "4.HEIC", "notes.txt", ".5.heic"):
        (tmp_path / name).touch()
    (tmp_path / "6.png").symlink_to(tmp_path / "gone.png")
    for name in ("cam0", "cam1", "other"):
        (tmp_path / name).mkdir()
    write(tmp_path / "cam0", "1.png")
    write(tmp_path / "cam1", "1.png")
    for _ in range(2):
        assert ImageFolder(tmp_path).names == ["1.png", "2.png"]
    (line,) = caplog.messages
    assert "2 .heic" in line
    assert "1 broken link" in line
    assert "2 folders of images are left out" in line
    assert "pip install 'dejavu_torch[heif]'" in line
    for name in ("1.png", "2.png"):
        (tmp_path / name).unlink()
    for name in ("cam0", "cam1", "other"):
        shutil.rmtree(tmp_path / name)
    with refused("contains no images but 2 .heic and 1 broken link"):
        ImageFolder(tmp_path)


def test_heif_is_read_by_pillow_heif(tmp_path, monkeypatch):
    called = []
    opener = types.SimpleNamespace(register_heif_opener=lambda: called.append(True))
    monkeypatch.setitem(sys.modules, "pillow_heif", opener)
    _has_heif.cache_clear()
    write(tmp_path, "1.png")
    (tmp_path / "1.png").rename(tmp_path / "1.heic")
    assert ImageFolder(tmp_path).names == ["1.heic"]
    assert called == [True]
    _has_heif.cache_clear()


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp", "a.tif", "a.webp", "a.ppm"])
def test_a_truncated_image_is_refused_by_name(tmp_path, name):
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    path = tmp_path / name
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    for part in (0.01, 0.1, 0.3, 0.6):
        path.write_bytes(whole[: int(part * len(whole))])
        with refused(str(path), "cannot be read as an image"):
            read_image(path)


def test_a_camera_held_upright_is_turned(tmp_path):
    picture = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(3, 4) * 20)
    exif = Image.Exif()
    exif[0x0112] = 6  # turn a quarter clockwise to see it upright
    picture.save(tmp_path / "a.png", exif=exif)
    expected = np.rot90(np.asarray(picture), -1) / 255
    assert np.allclose(all_of(ImageFolder(tmp_path))[0, 0].numpy(), expected)


@pytest.mark.parametrize(
    ("size", "words"),
    [((60_000, 60_000), "pixels"), ((10_000, 10_000), "10 MB free")],
)
def test_an_image_that_claims_too_many_pixels_is_refused_by_its_header(tmp_path, size, words, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 10e6)
    monkeypatch.setattr(Image.Image, "load", lambda _: pytest.fail("it was decoded"))
    (tmp_path / "a.ppm").write_bytes(f"P6 {size[1]} {size[0]} 255\n".encode() + bytes(99))
    with refused("a.ppm", words):
        read_image(tmp_path / "a.ppm")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1, 1.5])
def test_float_images_lie_from_0_to_1(tmp_path, bad):
    pixels = np.linspace(0, 1, 20, dtype=np.float32).reshape(4, 5)
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    assert torch.equal(read_image(tmp_path / "a.tif")[0], torch.tensor(pixels))
    pixels[2, 3] = bad
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    with refused("a.tif", "expected 0 to 1"):
        read_image(tmp_path / "a.tif")
    Image.fromarray(np.full((4, 5), -5 if bad < 0 else 70_000, np.int32)).save(tmp_path / "a.tif")
    with refused("a.tif", "expected 0 to 1"):
        read_image(tmp_path / "a.tif")


def test_images_of_16_bits_that_use_few_of_them_are_told(tmp_path, caplog):
    noise = np.random.default_rng(0).integers(0, 900, (12, 15))
    traverses = {}
    for name, values in {"thermal": 51_000 + noise, "depth": noise * 70, "grey": noise // 60}.items():
        (tmp_path / name).mkdir()
        pixels = values.astype(np.uint8 if name == "grey" else np.uint16)
        for i in range(2):
            Image.fromarray(pixels).save(tmp_path / name / f"{i}.png")
        traverses[name] = ImageFolder(tmp_path / name)
        Descriptor(features=PatchPixels((12, 15), 3)).learn(traverses[name])
    (line,) = caplog.messages
    low, high = 51_000 + noise.min(), 51_000 + noise.max()
    assert f"thermal has values from {low} to {high} of 65535; --preprocess.range auto" in line
    Descriptor(Preprocess(range="51000,51900"), PatchPixels((12, 15), 3)).learn(traverses["thermal"])
    assert caplog.messages == [line]
    assert Part(Chain([traverses["thermal"]]), range(1)).deep


def photo(file, time="", fraction=""):
    exif = Image.Exif()
    if time:
        exif.get_ifd(0x8769).update({36867: f"2026:05:03 {time}", 37521: fraction})
    Image.new("L", (5, 4)).save(file, exif=exif)


def test_photos_by_when_they_were_taken(tmp_path, caplog):
    """A camera that counts to 9999 and goes on from 0."""
    times = {"DSC_9998": "12:00:01", "DSC_9999": "12:00:02", "DSC_0000": "12:00:03", "DSC_0001": "12:00:03"}
    (tmp_path / "a").mkdir()
    for name, time in times.items():
        photo(tmp_path / "a" / f"{name}.jpg", time, {"DSC_0000": "25", "DSC_0001": "3"}.get(name, ""))
    plain = ImageFolder(tmp_path / "a")
    assert [*plain.names] == [f"DSC_{n}.jpg" for n in ("0000", "0001", "9998", "9999")]
    (line,) = caplog.messages
    assert "DSC_0001.jpg was taken after DSC_9998.jpg; ?order=time" in line
    by_time = ImageFolder(tmp_path / "a", order="time")
    assert [*by_time.names] == [f"{name}.jpg" for name in times]
    assert by_time.ordered
    photo(tmp_path / "a" / "DSC_0002.jpg")
    with refused("1 of 5 images, such as DSC_0002.jpg", "order=natural"):
        ImageFolder(tmp_path / "a", order="time")
    (tmp_path / "b").mkdir()
    for i in range(3):
        photo(tmp_path / "b" / f"{i}.jpg", f"12:00:0{i}")
    ImageFolder(tmp_path / "b")
    assert caplog.messages == [line]


def test_of_images_of_one_name_the_first_one_tells_the_channels(tmp_path):
    for folder, mode in (("a", "RGB"), ("b", "L")):
        (tmp_path / folder).mkdir()
        Image.new(mode, (8, 8)).save(tmp_path / folder / "1.png")
    Image.new("RGB", (8, 8)).save(tmp_path / "1.png")
    assert ImageFolder(tmp_path, recursive=True).names == ["1.png", "a/1.png", "b/1.png"]
    for first in (0, 1, 2):
        folder = ImageFolder(tmp_path, recursive=True)
        assert folder.read([first]).shape == (1, 3, 8, 8)


def test_some_images_and_those_in_folders_inside(tmp_path, caplog):
    for name in ("cam0", "cam1", ".thumbs"):
        (tmp_path / name).mkdir()
        write(tmp_path / name, "1.color.png", "1.depth.png")
    write(tmp_path, "2.color.png")
    every = ImageFolder(tmp_path, recursive=True)
    inside = [f"{cam}/1.{kind}.png" for cam in ("cam0", "cam1") for kind in ("color", "depth")]
    assert every.names == ["2.color.png", *inside]
    assert all_of(every).shape[0] == 5
    assert caplog.text == ""
    some = open_source(f"{tmp_path}?glob=*.color.png&recursive=1")
    assert [*some.names] == ["2.color.png", "cam0/1.color.png", "cam1/1.color.png"]
    assert open_source(f"{tmp_path / 'cam0'}?glob=*.depth.png").names == ["1.depth.png"]
    with refused("contains no images that match *.jpg"):
        ImageFolder(tmp_path, glob="*.jpg")
