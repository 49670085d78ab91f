"""The verb train on every variant of the paper's comparisons: a smoke epoch each, and a model that loads again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import train
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.training.checkpoint import load_trained
from attentionvote.workflows.train.settings import TrainSettings

# An epoch has the steps of the smoke preset's (3 of 4 scenes); scenes, clouds and network are smaller.
ONE_EPOCH = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2,3]", "workers=1", "trainer.max_epochs=1",
    "trainer.schedule.rise_steps=1", "trainer.validate_every=1", "force=false",
    # So few votes make no heat that the presets ask for.
    "model.voxel_fraction=0.1", "trainer.train_heat=0.0", "trainer.peak_threshold=0.01",
]  # fmt: skip
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("quick_training")]


@pytest.fixture(scope="module")
def places(put_tables: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """One data folder for all: the first training makes scenes and clouds."""
    folder = tmp_path_factory.mktemp("variants")
    put_tables(folder / "mlflow.db")
    return [f"root={folder / 'data'}", f"outputs={folder / 'out'}", f"tracking.store={folder / 'mlflow.db'}"]


@pytest.mark.parametrize(
    ("fusion_kind", "proposal_source", "more"),
    [
        ("aml", "heatmap", {}),
        ("aml", "fps", {"loss.settings.rotation": "slerp", "model.rotation": "quaternion"}),
        ("amx", "heatmap", {"loss.settings.rotation": "minra", "model.rotation": "quaternion"}),
        ("amx", "fps", {"model.merge_fraction": "null", "model.vote_rotation": "false"}),
        ("pn", "heatmap", {"loss.settings.rotation": "nlerp", "model.rotation": "quaternion"}),
        ("pn", "fps", {"model.voting_radius": "0.03", "model.test_voting_radius": "0.02"}),
    ],
)
def test_a_variant_trains_an_epoch(
    places: list[str], fusion_kind: str, proposal_source: str, more: dict[str, str]
) -> None:
    chosen = {"model.fusion_kind": fusion_kind, "model.proposal_source": proposal_source, **more}
    result = train.run(
        compose(TrainSettings, [*ONE_EPOCH, *places, *(f"{key}={value}" for key, value in chosen.items())])
    )
    assert result is not None
    assert (result["steps"], result["test_scenes"]) == (3, 3)
    assert {"ap_10", "add_recall_10", "proposal_recall", "proposal_repeats"} <= set(result["metrics"])
    model, metadata = load_trained(result["model"])
    assert (metadata["model"]["fusion_kind"], metadata["model"]["proposal_source"]) == (fusion_kind, proposal_source)
    assert all(torch.isfinite(value).all() for value in model.state_dict().values() if value.is_floating_point())
