"""The cell of an object in every verb's settings: written where the user leaves open, nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest
from settings_of_verbs import settings_of

from attentionvote.command.conf_folder import CONF
from attentionvote.command.configuration import VerbSettings, compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.identity import identity
from attentionvote.section import Target
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.settings import GenerateSettings, PromoteSettings, ViewSettings
from attentionvote.workflows.train.settings import TrainSettings

CELL = """
cell:
  sensor: phoxi_s
  distance: 0.44
  camera: {width: 2064, height: 1544, fx: 2534.1, fy: 2534.1, cx: 1031.5, cy: 771.5}
  measures: {preset: phoxi, axial_sigma_mm: 0.1081, baseline: 0.23, scaled: false}
  bin:
    size: [0.08, 0.06, 0.03]
    jitter: 0.01
    walls: {thickness: 0.0015, rim: 0.003, rim_height: 0.003, radius: 0.004, draft_degrees: 2.0}
  area: [0.0302, 0.0235]
"""


@pytest.fixture(autouse=True)
def _objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of the user's with a washer, another one like it, one of another cell, and sets of them."""
    folder = tmp_path / "object"
    folder.mkdir()
    text = (CONF / "object" / "brick.yaml").read_text().rpartition("\n#")[0] + "\n"
    for name, cell in (("washer", CELL), ("nut", CELL), ("rod", CELL.replace("0.44", "0.45"))):
        (folder / f"{name}.yaml").write_text(text.replace("name: brick", f"name: {name}") + cell)
    for name, member in (("same", "nut"), ("mixed", "rod")):
        (folder / f"{name}.yaml").write_text(
            f"defaults:\n  - washer@parts.washer\n  - {member}@parts.{member}\n  - _self_\n"
            "_target_: attentionvote.simulation.load_parts\n_recursive_: false\n_convert_: all\n"
            f"name: {name}\nbase_radius: null\nvoxel_size: null\n"
        )
    monkeypatch.setenv("ATTENTIONVOTE_CONF", str(tmp_path))


def train(*words: str) -> TrainSettings:
    return compose(TrainSettings, ["object=washer", *words])


def test_a_cell_sets_scenes_and_sensor_of_a_training() -> None:
    cfg = train()
    assert cfg.simulation.bin.size == (0.08, 0.06, 0.03)
    assert cfg.simulation.bin.jitter == 0.01
    assert cfg.simulation.bin.walls is not None
    assert cfg.simulation.bin.walls.radius == 0.004
    assert (cfg.simulation.camera.distance, cfg.simulation.camera.camera.fx) == (0.44, 2534.1)
    assert (cfg.simulation.drop.area, cfg.simulation.visibility_stride) == ((0.0302, 0.0235), 4)
    assert (cfg.data.sensor.preset, cfg.data.sensor.baseline, cfg.data.sensor.scaled) == ("phoxi", 0.23, False)
    assert (cfg.simulation.drop.hull_threshold, cfg.simulation.drop.hull_volume) == (0.1, 1.2)
    assert "cell" not in cfg.composed["object"]


@pytest.mark.parametrize("verb", [EvaluateSettings, PromoteSettings, ViewSettings, GenerateSettings])
def test_every_verb_has_the_same_scenes(verb: type[VerbSettings]) -> None:
    assert compose(verb, ["object=washer"]).simulation == train().simulation  # type: ignore[attr-defined]


def test_evaluation_and_view_have_the_same_sensor() -> None:
    assert compose(EvaluateSettings, ["object=washer"]).evaluation.sensor == train().data.sensor
    view = compose(ViewSettings, ["object=washer"])
    assert view.shown_sensor.axial_sigma_mm == 0.1081
    assert compose(ViewSettings, ["object=washer", "sensor=gaussian", "sigma_mm=1.0"]).shown_sensor.sigma_mm == 1.0
    assert compose(ViewSettings, ["object=washer", "sensor=none"]).shown_sensor.preset == "none"
    assert compose(ViewSettings, ["object=brick", "sensor=phoxi"]).shown_sensor.scaled


def test_a_word_wins_also_one_that_says_the_default() -> None:
    cfg = train("simulation.camera.distance=0.5", "data.sensor.preset=gaussian", "simulation.bin.jitter=0.15")
    assert (cfg.simulation.camera.distance, cfg.simulation.bin.jitter) == (0.5, 0.15)
    assert (cfg.data.sensor.preset, cfg.data.sensor.baseline) == ("gaussian", 0.23)
    assert train("simulation.bin.walls=null").simulation.bin.walls is None
    walls = train("simulation.bin.walls.radius=0.002").simulation.bin.walls
    assert walls is not None
    assert (walls.radius, walls.rim) == (0.002, 0.003)  # the rest is the cell's
    assert train("object.cell.distance=0.46").simulation.camera.distance == 0.46
    assert train("object.cell=null").simulation == compose(TrainSettings, ["object=brick"]).simulation


def test_a_choice_of_a_group_wins_where_it_says_something_else() -> None:
    cfg = train("simulation=smoke", "experiment=paper")
    assert cfg.simulation.visibility_stride == 4
    assert cfg.simulation.camera.distance == 0.44
    assert train("simulation=fast").simulation.visibility_stride == 3
    assert train("simulation=fast").simulation.bin.size == (0.08, 0.06, 0.03)


def test_a_training_is_known_by_its_values_wherever_they_come_from() -> None:
    plain = identity(train())
    assert plain["simulation"]["camera"]["distance"] == 0.44
    assert identity(train("simulation.camera.distance=0.44", "data.sensor.preset=phoxi")) == plain
    assert identity(train("simulation.camera.distance=0.45")) != plain
    # What was composed composes to the same again: a training is made again by it (make reproduce).
    cfg = train("simulation.camera.distance=0.5")
    assert TrainSettings.of(cfg.composed).composed == cfg.composed


def test_an_object_without_a_cell_is_as_it_was() -> None:
    cfg = compose(TrainSettings, ["object=brick"])
    assert (cfg.simulation.bin.size, cfg.simulation.camera.distance, cfg.data.sensor.preset) == (None, None, "gaussian")
    assert "walls" not in cfg.composed["simulation"]["bin"]
    assert "cell" not in cfg.composed["object"]


def test_the_parts_of_a_set_have_one_cell() -> None:
    same = compose(TrainSettings, ["object=same"])
    assert same.simulation == train().simulation
    assert all("cell" not in part for part in same.composed["object"]["parts"].values())
    with pytest.raises(ConfigurationError, match="must have one cell, but those of washer and rod differ: make them"):
        compose(TrainSettings, ["object=mixed"])


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("object.cell.distance=-1", "object.cell.distance must be greater than 0 and at most 100; got -1"),
        ("+object.cell.distanc=1", "there is no setting 'object.cell.distanc', did you mean 'object.cell.distance'"),
        ("object.cell.bin.walls.radius=0.05", "radius must be at most half of the bin's shorter side"),
        (
            "object.cell.distance=0.9",
            "distance must lie within 0.384..0.52 m, the range of phoxi_s, got 0.9: take 0.52",
        ),
        ("object.cell.bin.size=[0.36,0.28,0.1]", "distance must be at least 0.577 m, from where on the picture holds"),
        ("object.cell.sensor=phoxi", "object.cell.sensor must be one of phoxi_s, phoxi_m"),
        ("object.cell.measures.preset=foxi", "object.cell.measures.preset must be one of none, gaussian, phoxi"),
    ],
)
def test_an_impossible_cell_is_one_sentence(word: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        train(word)


def test_verbs_without_scenes_do_not_mind() -> None:
    cfg = compose(settings_of("history"), ["object=washer"])
    assert isinstance(cfg.object, Target)  # type: ignore[attr-defined]
    assert cfg.object().name == "washer"  # type: ignore[attr-defined]


def test_half_a_camera_or_sensor_of_a_group_is_not_mixed_with_the_cells(tmp_path: Path) -> None:
    # Width, height and centre are as the project's default has them: the whole camera is the user's all the same.
    camera = "{width: 1032, height: 772, fx: 1200.0, fy: 1200.0, cx: 516.0, cy: 386.0}"
    for group, text in (
        ("simulation", f"defaults: [default]\ncamera: {{camera: {camera}}}\n"),
        ("data", "defaults: [compact]\nsensor: {preset: gaussian, sigma_mm: 0.8}\n"),
    ):
        (tmp_path / group).mkdir()
        (tmp_path / group / "mine.yaml").write_text(text)
    cfg = train("simulation=mine", "data=mine")
    seen = cfg.simulation.camera.camera
    assert (seen.width, seen.height, seen.fx, seen.cx) == (1032, 772, 1200.0, 516.0)
    assert (cfg.data.sensor.preset, cfg.data.sensor.sigma_mm) == ("gaussian", 0.8)
    assert cfg.simulation.camera.distance == 0.44  # of which the group says nothing
    assert train("data.sensor.baseline=0.3").data.sensor.preset == "phoxi"  # a word is for itself alone


def test_parts_of_a_set_may_differ_in_the_area_of_their_heaps(tmp_path: Path) -> None:
    file = tmp_path / "object" / "nut.yaml"
    file.write_text(file.read_text().replace("area: [0.0302, 0.0235]", "area: [0.05, 0.02]"))
    cfg = compose(TrainSettings, ["object=same"])
    assert (cfg.simulation.camera.distance, cfg.simulation.drop.area) == (0.44, (0.05, 0.0235))
    file.write_text(file.read_text().replace("area: [0.05, 0.02]", "area: null"))
    assert compose(TrainSettings, ["object=same"]).simulation.drop.area is None
