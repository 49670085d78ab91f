"""The rows of ``make bench``: what is measured and what it has to reach; beside what, each row's own module says."""

from __future__ import annotations

from difflib import get_close_matches

from attentionvote.workflows.speed.contest import Goal, Row

COMPACT, FULL = "compact", "full"
EAGER, CONV, CDIST = "plain torch", "Conv2d and BatchNorm", "torch cdist"
QUICKFPS, OPEN3D, GRAPH = "torch-quickfps", "Open3D", "the graph alone"

ROWS: tuple[Row, ...] = (
    Row(
        "farthest-points",
        "farthest-point order",
        "points:farthest_points",
        (Goal("<= 1.2 x torch-quickfps", 1.2, QUICKFPS),),
    ),
    Row(
        "ball-query",
        "first-k ball query, four levels",
        "points:ball_queries",
        (Goal(">= 20 x faster than torch cdist", 1 / 20, CDIST),),
    ),
    Row(
        "normals",
        "normals of 30 neighbours",
        "points:normals",
        (Goal("<= 1.3 x Open3D", 1.3, OPEN3D),),
    ),
    *(
        Row(
            f"{kind}-{size}",
            f"{title}, {size}",
            prepare,
            (Goal(f"<= {most} ms", float(most)),),
            "sample",
            arguments=(size,),
        )
        for kind, title, prepare, most in (
            ("sample", "a training sample from stored poses", "data:new_sample", 120),
            ("cached", "a sample of a later epoch", "data:cached_sample", 15),
        )
        for size in (COMPACT, FULL)
    ),
    Row(
        "scenes",
        "settled scenes of a drop cycle",
        "data:settled_scenes",
        (Goal(">= 6 scenes/s", 1e3 / 6),),
        "scene",
    ),
    Row(
        "set-abstraction",
        "a set abstraction, forward and backward",
        "training:set_abstraction",
        (Goal(">= 3 x faster than Conv2d and BatchNorm", 1 / 3, CONV),),
        "cloud",
    ),
    *(
        Row(
            f"step-{size}",
            f"a training step, {size}",
            "training:step",
            (Goal(f">= {least} x plain torch's scenes/s", 1 / least, EAGER),),
            "scene",
            2,
            arguments=(size,),
        )
        for size, least in ((COMPACT, 3), (FULL, 4))
    ),
    *(
        Row(
            f"graph-{size}",
            f"the exported graph, {size}",
            "export:graph",
            (Goal(">= 3 x faster than plain torch", 1 / 3, EAGER), Goal(f"<= {most} ms", float(most))),
            "cloud",
            arguments=(size,),
        )
        for size, most in ((COMPACT, 20), (FULL, 200))
    ),
    *(
        Row(
            f"cell-{size}",
            f"the cell, cloud in to poses out, {size}",
            "export:cell",
            (Goal("<= 1.5 x the graph", 1.5, GRAPH),),
            "cloud",
            arguments=(size,),
        )
        for size in (COMPACT, FULL)
    ),
    Row(
        "growth-points",
        "the whole cost as N grows: no worse than N log N",
        "growth:points",
    ),
    Row(
        "growth-instances",
        "the whole cost as instances grow: no worse than N log N",
        "growth:instances",
    ),
    Row(
        "growth-proposals",
        "the whole cost as K grows: no worse than K log K",
        "growth:proposals",
    ),
    Row(
        "gpu-training",
        "a training step, full, data on the GPU",
        "gpu:training",
        (Goal(">= 1,000 scenes/s", 1.0),),
        "scene",
        cuda=True,
    ),
    Row(
        "gpu-inference",
        "one scene, order computed",
        "gpu:inference",
        (Goal("<= 5 ms", 5.0),),
        "cloud",
        cuda=True,
    ),
    Row(
        "gpu-champion",
        "from CAD to champion",
        "gpu:champion",
        (Goal("<= 30 min", 1.8e6),),
        "part",
        cuda=True,
    ),
)


def select_rows(names: str | None) -> list[Row]:
    """The rows of a list of names with commas between them, in the table's order; all without one.

    Raises:
        ValueError: when a name is no row's.
    """
    if names is None:
        return list(ROWS)
    wanted = [name.strip() for name in names.split(",")]
    valid = [row.name for row in ROWS]
    for name in wanted:
        if name not in valid:
            near = get_close_matches(name, valid, n=1, cutoff=0.0)[0]
            raise ValueError(f"rows must be among {', '.join(valid)}; got {name!r}, did you mean {near!r}?")
    return [row for row in ROWS if row.name in wanted]
