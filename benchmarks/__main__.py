"""`python -m benchmarks NAME --out DIR`: the package against what users would pick instead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks import (
    alike,
    areas,
    chosen,
    chunks,
    cluster,
    cross,
    distil,
    drives,
    ends,
    features,
    files,
    front,
    headings,
    live,
    matcher,
    memory,
    odometry,
    order,
    own_copies,
    provenance,
    results,
    scale,
    spread,
    storage,
    teaching,
    terrain,
    train,
    trainings,
    views,
    visits,
)
from dejavu_torch.cli import errors_of_one_line, fail, main
from dejavu_torch.cli.parser import command_parser
from dejavu_torch.data.output import check_output_folder
from dejavu_torch.data.source import check_not_read
from dejavu_torch.text import printable

BENCHES: dict[str, Any] = {  # each returns the lines to print
    "results": results.run_results,
    "front": front.run_front,
    "files": files.run_files,
    "order": order.run_order,
    "areas": areas.run_areas,
    "chosen": chosen.run_chosen,
    "odometry": odometry.run_odometry,
    "own_copies": own_copies.run_copies,
    "headings": headings.run_headings,
    "terrain": terrain.run_terrain,
    "matcher": matcher.run_matcher,
    "storage": storage.run_storage,
    "drives": drives.run_drives,
    "ends": ends.run_ends,
    "cross": cross.run_cross,
    "teaching": teaching.run_teaching,
    "views": views.run_views,
    "visits": visits.run_visits,
    "alike": alike.run_alike,
    "provenance": provenance.run_provenance,
    "features": features.run_features,
    "chunks": chunks.run_chunks,
    "train": train.run_train,
    "trainings": trainings.run_trainings,
    "distil": distil.run_distil,
    "live": live.run_live,
    "memory": memory.run_memory,
    "scale": scale.run_scale,
    "cluster": cluster.run_cluster,
    "spread": spread.run_spread,
}


def run(given: Sequence[str]) -> None:
    """Run a command line."""
    if not given or given[0] in ("--help", "-h"):
        print("usage: python -m benchmarks NAME [...] --out DIR\n")
        for name, function in BENCHES.items():
            print(f"  {name:<9}  {function.__doc__.splitlines()[0]}")
        return
    if given[0] not in BENCHES:
        fail(f"{given[0]!r} is no benchmark; expected one of {', '.join(BENCHES)}")
    with errors_of_one_line(given):
        parser = command_parser(given[0], BENCHES[given[0]], "python -m benchmarks")
        options = parser.parse_args(given[1:]).as_dict()
        out = options["out"]
        check_not_read(out / "bench.json", *options.get("sources", ()), options.get("codebooks"))
        check_output_folder(out)  # before the work
        *tables, note = BENCHES[given[0]](**options)
        shown = out / ("bench.png" if (out / "bench.png").exists() else "bench.json")
        print(*tables, printable(f"{note}; next: open {shown}"), sep="\n")


if __name__ == "__main__":
    main(program=run)
