"""The rows of ``make bench``: what is measured and what it has to reach; beside what, each row's own module says."""

from __future__ import annotations

from difflib import get_close_matches

from attentionvote.workflows.speed.contest import Goal, Row

COMPACT, FULL = "compact", "full"
EAGER, CONV, CDIST = "plain torch", "Conv2d and BatchNorm", "torch cdist"
QUICKFPS, OPEN3D, GRAPH = "torch-quickfps", "Open3D", "the graph alone"
_CDIST_GOAL = ">= 20 x faster than torch cdist"

ROWS: tuple[Row, ...] = (
    *(
        Row(name, title, f"points:{prepare}", (Goal(text, most, against),))
        for name, title, prepare, text, most, against in (
            ("farthest-points", "farthest-point order", "farthest_points", "<= 1.2 x torch-quickfps", 1.2, QUICKFPS),
            ("ball-query", "first-k ball query, four levels", "ball_queries", _CDIST_GOAL, 1 / 20, CDIST),
            ("normals", "normals of 30 neighbours", "normals", "<= 1.3 x Open3D", 1.3, OPEN3D),
        )
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
    *(
        Row(f"growth-{name}", f"the whole cost as {grows}: no worse than {bound}", f"growth:{name}")
        for name, grows, bound in (
            ("points", "N grows", "N log N"),
            ("instances", "instances grow", "N log N"),
            ("proposals", "K grows", "K log K"),
        )
    ),
    *(
        Row(f"gpu-{name}", title, f"gpu:{name}", (Goal(text, most),), item, cuda=True)
        for name, title, text, most, item in (
            ("training", "a training step, full, data on the GPU", ">= 1,000 scenes/s", 1.0, "scene"),
            ("inference", "one scene, order computed", "<= 5 ms", 5.0, "cloud"),
            ("champion", "from CAD to champion", "<= 30 min", 1.8e6, "part"),
        )
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
