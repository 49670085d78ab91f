"""What a sensor can tell of a part; sensor models against the figures of their sheets."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import trimesh

from attentionvote.part import Part, PartSet
from attentionvote.section import read
from attentionvote.simulation.resolution import log_resolution, noise_of, resolution, simulated_distance
from attentionvote.simulation.scene_spec import SimulationSettings
from attentionvote.simulation.sensor import Sensor
from attentionvote.simulation.sensor_models import SENSOR_MODELS

SETTINGS = {
    "seed": 0, "cycles": {"train": 1}, "drop_counts": [5, 20], "bin": {}, "camera": {}, "drop": {},
    "visibility_stride": 2,
}  # fmt: skip


def ball(diameter: float, name: str = "ball") -> Part:
    mesh = trimesh.creation.icosphere(3, diameter / 2)
    return Part(name, np.array(mesh.vertices), np.array(mesh.faces), diameter)


@pytest.mark.parametrize("name", SENSOR_MODELS)
def test_a_model_shows_its_field_at_its_best_distance_and_its_noise(name: str) -> None:
    model = SENSOR_MODELS[name]
    assert model.near < model.best < model.far
    assert model.camera.width * model.best / model.camera.fx == pytest.approx(model.field, rel=1e-3)
    for distance in (model.near, model.best, model.far):
        assert noise_of(model.sensor, distance) == pytest.approx(model.noise(distance), rel=2e-3)
    assert model.noise(model.best) == pytest.approx(model.noise_mm / 1000)
    assert not model.sensor.scaled
    assert str(round(model.near * 1000)) in model.sheet or f"{model.near:g}" in model.sheet


def test_the_stereo_camera_is_its_disparity_error() -> None:
    model = SENSOR_MODELS["realsense_d435"]
    for z in (0.3, 0.5, 1.0):
        assert model.noise(z) == pytest.approx(0.08 * z**2 / (model.camera.fx * model.baseline), rel=0.02)


def test_figures_of_a_ball() -> None:
    model = SENSOR_MODELS["phoxi_m"]
    found = resolution(ball(0.1), model.camera, 0.65, model.sensor, 10**9, 30)
    assert found.pixels == pytest.approx(0.1 * model.camera.fx / 0.65)
    assert found.points == pytest.approx(np.pi / 4 * found.pixels**2, rel=0.03)
    assert found.noise == pytest.approx(1e-4, rel=1e-3)
    assert found.advice() == ""
    assert "D 100 mm, at 650 mm: 350 pixels across" in found.sentence()
    assert "noise 0.1 mm or 0.1% of D" in found.sentence()
    assert resolution(ball(0.1), model.camera, 0.65, model.sensor, 30_000, 30).points == 1000
    # Twice as far: half of the pixels, four times the noise.
    far = resolution(ball(0.1), model.camera, 1.3, model.sensor, 10**9, 30)
    assert (far.pixels, far.noise) == pytest.approx((found.pixels / 2, found.noise * 4))


def test_a_part_too_small_for_its_sensor_is_said_with_what_would_do() -> None:
    model = SENSOR_MODELS["realsense_d435"]
    found = resolution(ball(0.012), model.camera, 0.4, model.sensor, 40_000, 30)
    assert found.noise_share == pytest.approx(0.0500, abs=1e-3)
    assert found.advice() == (
        "noise is 5.0% of D: AP at 5 % D will be near 0; take phoxi_s at 442 mm or phoxi_m at 650 mm or zivid_m70 at "
        "700 mm"
    )
    # Over a bin that a small scanner's picture does not hold.
    wide = resolution(ball(0.012), model.camera, 0.6, model.sensor, 40_000, 30, (0.36, 0.28, 0.16))
    assert wide.advice().endswith("; take phoxi_m at 650 mm or zivid_m70 at 700 mm")
    wider = resolution(ball(0.008), model.camera, 0.6, model.sensor, 40_000, 30, (0.75, 0.55, 0.32))
    assert wider.advice().endswith("take phoxi_s at 442 mm or zivid_m70 at 700 mm over a smaller bin")
    few = resolution(ball(0.012), model.camera, 0.4, Sensor(), 40_000, 400)
    assert "100 points" not in few.advice()
    assert resolution(ball(0.012), model.camera, 0.4, Sensor(), 2_000, 30).advice().startswith("67 points on a part")
    tiny = resolution(ball(0.001), model.camera, 0.4, model.sensor, 40_000, 30)
    assert tiny.advice().endswith("no sensor that is known here measures so small a part well")


def test_the_smallest_part_of_a_set_decides_and_the_protocol_has_its_own_distance(
    caplog: pytest.LogCaptureFixture,
) -> None:
    both = PartSet("both", (ball(0.143, "large"), ball(0.01, "small")))
    settings = read(SimulationSettings, SETTINGS)
    assert simulated_distance(both, settings) > 0.79
    given = read(SimulationSettings, SETTINGS | {"camera": {"distance": 0.5}})
    assert simulated_distance(both, given) == 0.5
    with caplog.at_level(logging.INFO):
        log_resolution(logging.getLogger("x"), both, given, Sensor("gaussian", sigma_mm=0.3))
        log_resolution(logging.getLogger("x"), both, given)
    assert "small, D 10 mm, at 500 mm" in caplog.text
    warnings = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == 1
    assert warnings[0].startswith("noise is 3.0% of D: AP at 5 % D will be near 0")
