"""`python -m benchmarks NAME --out DIR`: this package beside what users would pick instead."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import cluster, live, matcher, memory, scale, scale_report, storage
from benchmarks.measure import table
from dejavu_torch.cli import errors_of_one_line, fail, main
from dejavu_torch.cli.device import device_of
from dejavu_torch.cli.parser import command_parser
from dejavu_torch.data.source import check_not_read
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.model import DejaVu
from dejavu_torch.text import printable


def run_matcher(*, out: Path) -> None:
    """Time of HOG, L1 distances, sequences, filters and exported maps.

    Args:
        out: folder for bench.json and bench.png
    """
    rows = matcher.run_matcher(out)
    print(text_table(table(rows, matcher.COLUMNS)))
    if any("No module" in (row["skipped"] or "") for row in rows):
        print("what is skipped needs pip install '.[bench,export]'")
    close(out, "x ours: seconds / those of the fastest dejavu")


def run_storage(
    sources: Sequence[str] = (),
    *,
    out: Path,
    map: Path | None = None,
    codebooks: str | None = None,
    whitening: Path | None = None,
    places: Sequence[int] = (),
) -> None:
    """Accuracy over bytes of ways to store the descriptors of a route.

    Args:
        sources: pairs REFERENCE QUERY; the built-in routes if not given
        out: folder for bench.json and bench.png
        map: a map of the REFERENCE to set beside the others
        codebooks: another route, where codebooks and a whitening are learned that count nothing
        whitening: a map whose whitening describes all routes; each learns its own if not given
        places: frames of the built-in sim:aerial; 3072 and 10000 if not given
    """
    check_not_read(out / "bench.json", *sources, codebooks)
    given, shared = (None if one is None else DejaVu.load(one) for one in (map, whitening))
    found = storage.run_storage(out, sources, places, codebooks, given, shared, progress=True)
    for title, lines in storage.storage_tables(found):
        print(*[printable(title)] * bool(title), text_table(lines), "", sep="\n")
    for line in storage.skipped_lines(found):
        print(printable(line))
    close(out, "the best of each family, T queries matched together")


def run_train(
    sources: Sequence[str] = (), *, out: Path, steps: int | None = None, seeds: Sequence[int] = ()
) -> None:
    """Seconds of a training, and the accuracy of its descriptor.

    Args:
        sources: REFERENCE QUERY; the built-in road if not given
        out: folder for bench.json and bench.png
        steps: those of each training; 600 if not given
        seeds: a training each; 0, 1 and 2 if not given
    """
    from benchmarks import train  # and with it Lightning, which takes seconds to import

    check_not_read(out / "bench.json", *sources)
    rows = train.run_train(out, sources, steps, seeds)
    print(text_table(train.train_table(rows)))
    seeded = ", ".join(dict.fromkeys(str(row["seed"]) for row in rows))
    seen = f"{rows[0]['case']}, seeds {seeded}, threads: {rows[0]['threads']}"
    close(out, f"{seen}; each row changes one thing of the row above")


def run_live(*, out: Path) -> None:
    """Time of single frames of a video on a map of 100000 places.

    Args:
        out: folder for bench.json and bench.png
    """
    print(text_table(live.live_table(live.run_live(out))))
    close(out, "100000 places; found: within 5; from decoding on: milliseconds of each part by itself")


def run_memory(*, out: Path, places: Sequence[int] = ()) -> None:
    """Memory of learning a route and of localizing on it.

    Args:
        out: folder for bench.json and bench.png
        places: frames that are learned; 1000, 10000 and 50000 if not given
    """
    print(text_table(table(memory.run_memory(out, places), memory.COLUMNS)))
    close(out, "peak: beyond that of the programs loaded")


def run_scale(*, out: Path, places: Sequence[int] = (), device: str = "cpu") -> None:
    """Time, memory, bytes and accuracy over the number of places, beside the indexes of faiss.

    Args:
        out: folder for bench.json and bench.png
        places: 10000, 100000 and 1000000 if not given
        device: what localizes: as of `dejavu localize`
    """
    rows = scale.run_scale(out, places, str(device_of(device)), progress=True)
    for title, lines in scale_report.scale_tables(rows):
        print(title, text_table(lines), "", sep="\n")
    close(out, f"recall within {scale.TOLERANCE} places; localized on one thread")


def run_cluster(*, out: Path) -> None:
    """Time of the workers of a cluster, beside one process.

    Args:
        out: folder for bench.json and bench.png
    """
    print(text_table(cluster.cluster_table(cluster.run_cluster(out))))
    close(out, "other chunks: share unlike those of one process; processor seconds of all processes")


BENCHES: dict[str, Any] = {
    "matcher": run_matcher,
    "storage": run_storage,
    "train": run_train,
    "live": run_live,
    "memory": run_memory,
    "scale": run_scale,
    "cluster": run_cluster,
}


def close(out: Path, note: str) -> None:
    """Say what the figures are, and where the picture is."""
    print(printable(f"{note}; next: open {out / 'bench.png'}"))


def run(given: Sequence[str]) -> None:
    """Run a command line."""
    if not given or given[0] in ("--help", "-h"):
        print("usage: python -m benchmarks NAME [...] --out DIR\n")
        for name, function in BENCHES.items():
            print(f"  {name:<8}  {function.__doc__.splitlines()[0]}")
        return
    if given[0] not in BENCHES:
        fail(f"{given[0]!r} is no benchmark; expected one of {', '.join(BENCHES)}")
    with errors_of_one_line(given):
        parser = command_parser(given[0], BENCHES[given[0]], "python -m benchmarks")
        BENCHES[given[0]](**parser.parse_args(given[1:]).as_dict())


if __name__ == "__main__":
    main(program=run)
