"""What a bin of several parts means for the verbs: refusals, the network's arguments, what a checkpoint keeps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from attentionvote.command.configuration import compose
from attentionvote.part import Part, PartSet, only_part
from attentionvote.workflows.train.network import check_classes, described, network_arguments
from attentionvote.workflows.train.settings import TrainSettings

MODEL = compose(TrainSettings, ["object=gear", "model=smoke"]).model


def test_a_part_passes_and_a_set_is_refused_with_its_parts(box: Part, box_and_slab: PartSet) -> None:
    assert only_part(box, "an export") is box
    assert only_part(PartSet("alone", (box,)), "an export") is box
    with pytest.raises(ValueError, match="must be one part for an export, got box_and_slab with the parts box, slab:"):
        only_part(box_and_slab, "an export")


@pytest.mark.parametrize("classes", [0, 3])
def test_another_number_of_classes_is_refused(box_and_slab: PartSet, classes: int) -> None:
    check_classes(1, box_and_slab)  # the presets' default
    check_classes(2, box_and_slab)
    with pytest.raises(ValueError, match=rf"number of parts of box_and_slab \(2\), got {classes}: leave it out"):
        check_classes(classes, box_and_slab)


def test_the_network_is_as_large_as_the_largest_part_and_merges_as_the_thinnest_allows(
    box: Part, box_and_slab: PartSet
) -> None:
    alone = network_arguments(MODEL, box)
    assert (alone["diameter"], alone["classes"], alone["merge_fraction"]) == (0.075, 1, 0.08)
    assert alone["box"] == box.box.tolist()
    both = network_arguments(MODEL, box_and_slab)
    assert (both["diameter"], both["classes"]) == (0.096, 2)
    assert both["merge_fraction"] * both["diameter"] == pytest.approx(0.5 * 0.012)
    assert network_arguments(replace(MODEL, merge_fraction=0.01), box_and_slab)["merge_fraction"] == 0.01
    assert network_arguments(replace(MODEL, merge_fraction=None), box_and_slab)["merge_fraction"] is None


def test_a_checkpoint_keeps_a_part_as_ever_and_of_a_set_every_part(box: Part, box_and_slab: PartSet) -> None:
    titled = replace(box, title="a box")
    kept = described(titled)
    assert kept.keys() == {"part"}
    assert kept["part"].keys() == {"name", "title", "diameter", "digest", "symmetry"}
    both = described(box_and_slab)
    assert both["part"].keys() == {"name", "title", "diameter", "digest"}
    assert [part["name"] for part in both["parts"]] == ["box", "slab"]
    assert both["parts"][1]["symmetry"]["kind"] == "cyclic"
    assert json.loads(json.dumps(both))["part"]["digest"] == box_and_slab.digest
