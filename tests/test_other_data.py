"""Data of other tools, as docs/howto/other_data.md shows it: their files in, their figures and pairs out."""

from __future__ import annotations

import re
from glob import glob
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, report_of, rows_of, run
from PIL import Image
from test_readme import understand

PAGE = (Path(__file__).parents[1] / "docs" / "howto" / "other_data.md").read_text()
VALUES = (1, 5, 10, 20)


def descriptors(count, seed=0):
    """Descriptors that change slowly along a route, with noise of their own."""
    waves = np.random.default_rng(9).normal(size=(2, 12))
    along = np.sin(np.arange(count)[:, None] * 0.15 * np.abs(waves[0]) + waves[1])
    return (along + 0.3 * np.random.default_rng(seed).normal(size=along.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """A data set in the layout of VPR-datasets-downloader, whose names two tools sort differently; some
    queries are far from all of the database. Beside it descriptors of its images, sorted as text."""
    folder = tmp_path_factory.mktemp("toy")
    for name, count, step, first in (("database", 60, 10, 500), ("queries", 24, 30, 507)):
        (folder / "test" / name).mkdir(parents=True)
        for i in range(count):
            east = first + step * i
            path = folder / "test" / name / f"@{east}@4000000.0@17@S@@@@@{i}@@@@@@@@.jpg"
            Image.fromarray(np.full((8, 8), 4 * i, np.uint8)).save(path)
        natural = descriptors(60, count)[:: step // 10]
        natural = np.concatenate([natural, descriptors(60, 5)[: count - len(natural)]])
        order = sorted(range(count), key=lambda i: f"@{first + step * i}@")
        assert order != sorted(order)
        np.save(folder / f"{name}_descriptors.npy", natural[order])
    return folder


def recalls(folder, predictions, values=VALUES):
    """The line of VPR-methods-evaluation for predictions (Q,K), numbers of database images sorted as text."""
    places = {}
    for name in ("database", "queries"):
        paths = sorted(glob(f"{folder}/test/{name}/**/*.jpg", recursive=True))
        places[name] = np.array([path.split("@")[1:3] for path in paths], dtype=float)
    hits = np.zeros(len(values))
    for query, predicted in zip(places["queries"], predictions, strict=True):
        positives = np.flatnonzero(np.linalg.norm(places["database"] - query, axis=1) <= 25)
        hits += [np.isin(predicted[:n], positives).any() for n in values]
    return ", ".join(
        f"R@{n}: {100 * share:.1f}" for n, share in zip(values, hits / len(predictions), strict=True)
    )


def test_ranks_of_another_tool_have_its_recall(toy, tmp_path, capsys):
    database, queries = (np.load(toy / f"{name}_descriptors.npy") for name in ("database", "queries"))
    distances = np.linalg.norm(queries[:, None] - database, axis=2)
    predictions = distances.argsort(1)[:, :20]
    lines = [
        f"{query},{place},{distances[query, place]},{rank}\n"
        for query, row in enumerate(predictions)
        for rank, place in enumerate(row, 1)
    ]
    matches = tmp_path / "m.csv"
    matches.write_text("query,place,score,rank\n" + "".join(lines))
    folders = {"--reference": toy / "test" / "database", "--query": toy / "test" / "queries"}
    texts = [word for name, path in folders.items() for word in (name, f"{path}?order=lexicographic")]
    options = "--truth", "utm:25", "--recall_values", *map(str, VALUES), "--out", tmp_path / "scores"
    run("evaluate", matches, *texts, "--tolerance", "0", *options)
    printed = capsys.readouterr().out
    expected = recalls(toy, predictions)
    assert expected in printed.splitlines()
    shares = report_of(tmp_path / "scores")["recall_values"]
    assert ", ".join(f"R@{n}: {100 * share:.1f}" for n, share in shares.items()) == expected
    assert 0 < shares["1"] < shares["20"] < 1  # some queries have no right answer
    assert "VPR-methods-evaluation allows none" not in printed
    run("evaluate", matches, *texts, "--tolerance", "3", *options)
    assert "may be 3 frames off" in capsys.readouterr().out
    naturally = [word for pair in folders.items() for word in pair]
    run("evaluate", matches, *naturally, "--tolerance", "0", *options)
    assert expected not in capsys.readouterr().out  # the frames have other numbers
    error = fails(capsys, "evaluate", matches, *texts, *options[:-2], "21", *options[-2:])
    assert "first 21 of 20 ranks" in error
    assert "--top 21" in error


@pytest.mark.slow
def test_the_page_from_descriptors_to_recall(toy, monkeypatch, capsys):
    monkeypatch.chdir(toy)
    named = next(code for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "glob" in code)
    exec(named, {})
    sources = "database_descriptors.npy", "queries_descriptors.npy"
    options = "--truth", "utm:25", "--tolerance", "0"
    run("compare", *sources, *options, "--top", "20", "--out", "report")
    beside = "--reference", sources[0], "--query", sources[1]
    values = "--recall_values", *map(str, VALUES)
    run("evaluate", "report/matches.csv", *options, *beside, *values, "--out", "scores")
    rows = rows_of(toy / "report" / "matches.csv")
    predictions = np.array([int(row["place"]) for row in rows]).reshape(24, 20)
    assert all(len({*row}) == 20 for row in predictions.tolist())  # nothing is left out
    assert recalls(Path(), predictions) in capsys.readouterr().out.splitlines()
    images = {name: sorted(glob(f"test/{name}/*.jpg")) for name in ("database", "queries")}
    for row in rows:
        assert row["query_name"] == images["queries"][int(row["query"])]
        assert row["place_name"] == images["database"][int(row["place"])]


def test_a_list_of_another_tool_becomes_a_truth(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    right = np.empty(2, dtype=object)
    right[0], right[1] = np.array([18, 17]), [3]
    np.save("pitts30k_val_gt_25m.npy", right, allow_pickle=True)
    (code,) = (code for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "allow_pickle" in code)
    assert len(code.splitlines()) == 3
    exec(code, {})
    (table,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    Path("matches.csv").write_text(table)
    words = "--truth", "truth.json", "--recall_values", "1", "2", "--tolerance", "0"
    run("evaluate", "matches.csv", *words, "--out", "s")
    assert "R@1: 50.0, R@2: 50.0" in capsys.readouterr().out.splitlines()


@pytest.fixture(scope="module")
def extracted(tmp_path_factory):
    """Descriptors of two traverses as hloc writes them, of images in folders, with coordinates in names."""
    h5py = pytest.importorskip("h5py")
    folder = tmp_path_factory.mktemp("extracted")
    for name in ("db", "query"):
        with h5py.File(folder / f"{name}.h5", "w", libver="latest") as file:
            for i, row in enumerate(descriptors(60, len(name))):
                group = file.create_group(f"{name}/left/@{10 * i}@0@.jpg")
                group.create_dataset("global_descriptor", data=row.astype(np.float16))
    run("learn", folder / "db.h5", "--map", folder / "map.safetensors")
    return folder


@pytest.mark.parametrize("top", [None, 3])
def test_localize_writes_pairs(extracted, tmp_path, top):
    matches, pairs = tmp_path / "m.csv", tmp_path / "pairs.txt"
    options = () if top is None else ("--top", str(top))
    source = f"{extracted / 'query.h5'}?start=5&stop=25"
    run("localize", extracted / "map.safetensors", source, *options, "--out", matches, "--pairs", pairs)
    rows = rows_of(matches)
    found = [tuple(line.split(" ")) for line in pairs.read_text().splitlines()]
    assert found == [(row["query_name"], row["place_name"]) for row in rows]
    assert len(found) == 20 * (top or 1)
    assert found[0][0] == "query/left/@50@0@.jpg"
    assert {name.split("/")[0] for _, name in found} == {"db"}


def test_pairs_need_names_and_a_file_of_their_own(extracted, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("unnamed.npy", descriptors(60))
    run("learn", "unnamed.npy", "--map", "unnamed.safetensors")
    monkeypatch.setattr("dejavu_torch.model.DejaVu.matches", lambda *_: pytest.fail("the work has begun"))
    known, query = extracted / "map.safetensors", extracted / "query.h5"
    for map, source, out, pairs, words in (
        (known, "unnamed.npy", "m.csv", "p.txt", ("unnamed.npy", "without a name", "--pairs")),
        ("unnamed.safetensors", query, "m.csv", "p.txt", ("map unnamed.safetensors", "without a name")),
        (known, query, "m.csv", "./m.csv", ("--pairs m.csv is --out",)),
        (known, query, "m.csv", "no/p.txt", ("no/p.txt", "does not exist")),
        (known, query, "m.csv", query, ("query.h5 is an input",)),
    ):
        error = fails(capsys, "localize", map, source, "--out", out, "--pairs", pairs)
        assert [word for word in words if word not in error] == []
    assert {file.name for file in tmp_path.iterdir()} == {"unnamed.npy", "unnamed.safetensors"}


def test_the_page_is_short_and_its_commands_are_understood():
    assert len(PAGE.split()) < 700
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    assert len(lines) == 7
    for line in lines:
        understand(line)
