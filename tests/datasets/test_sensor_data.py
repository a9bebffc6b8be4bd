"""A sensor goes from the settings of a collection to all that sees its pictures."""

import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line_error, open_shell

from hjepa_cli.config.schema import SensorSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.networks.model import Model, load_modules
from hjepa_cli.core.plants.frames import frames_back
from hjepa_cli.core.plants.named import camera_of, plant, sensor_in
from hjepa_cli.core.plants.sensor import Sensed
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect
from hjepa_cli.stages.data import data_camera
from hjepa_cli.stages.inputs import brought_along, check_same_plant, open_dataset, render
from hjepa_cli.stages.model_set import under_law_of
from hjepa_cli.storage import seals, zoo
from hjepa_cli.storage.checkpoints import load_checkpoint

SENSOR = SensorSettings(vignette=0.2, exposure_ms=0.5, read_noise=3.0)
SCREEN = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())


def settings_of(sensor=SENSOR, frames="rendered"):
    settings = load_settings("smoke")
    small = {"trajectories": 3, "test_trajectories": 2, "clean_trajectories": 2, "steps": 6}
    counts = dataclasses.replace(settings.collect, frames=frames, clean_steps=6, **small)
    return dataclasses.replace(settings, collect=counts, sensor=sensor)


def collected(directory, **options):
    collect.run(settings_of(**options), SCREEN, out=directory)
    return load_dataset(directory, "desktop")


@pytest.fixture(scope="module")
def model():
    """The zoo's, as if it had been trained on pictures of the sensor."""
    checkpoint = load_checkpoint(zoo.resolve_model("desktop-h4m2l1"))
    metadata = json.loads(json.dumps(checkpoint.metadata))
    metadata["settings"]["sensor"] = {"vignette": 0.2, "exposure_ms": 0.5, "read_noise": 3.0}
    metadata.pop("camera", None)
    checkpoint = dataclasses.replace(checkpoint, metadata=metadata)
    return Model(load_modules(checkpoint), metadata, checkpoint.digest, "cpu")


def test_pictures_are_the_same_stored_and_rendered_when_they_are_read(tmp_path):
    stored = collected(tmp_path / "stored", frames="stored")
    rendered = collected(tmp_path / "rendered")
    for data in (stored, rendered):
        assert data.settings["sensor"] == dataclasses.asdict(SENSOR)
        assert data.camera["sensor"]["vignette"] == 0.2
        assert isinstance(data_camera(data), Sensed)
    pictures = stored.split("train").frames
    np.testing.assert_array_equal(
        data_camera(rendered).render(rendered.split("train").states.reshape(-1, 4)),
        pictures.reshape(-1, 64, 128, 3),
    )
    # Training is given settings without a sensor, and sees the dataset's.
    settings = dataclasses.replace(load_settings("smoke"), seed=5)
    data = open_dataset(tmp_path / "rendered", settings)
    settings = brought_along(settings, data.settings, data.path)
    assert settings.sensor == SENSOR
    split = render(data.split("train"), settings, SCREEN)
    np.testing.assert_array_equal(split.frames.numpy(), pictures)


def test_an_ideal_dataset_has_no_trace_of_a_sensor(tmp_path):
    data = collected(tmp_path / "data", sensor=SensorSettings())
    text = (tmp_path / "data" / "dataset.json").read_text()
    assert "sensor" not in text and data.camera == plant("desktop").camera().manifest()


def test_a_damaged_sensor_in_a_dataset_is_refused(tmp_path):
    collected(tmp_path / "data")
    path = tmp_path / "data" / "dataset.json"
    manifest = json.loads(path.read_text())
    manifest["config"]["sensor"]["vignette"] = 7
    path.write_text(json.dumps(seals.sealed({k: v for k, v in manifest.items() if k != "sha256"})))
    with pytest.raises(DataError, match="vignette"):
        load_dataset(tmp_path / "data")


def test_a_model_s_loops_take_pictures_as_it_was_trained(model, monkeypatch):
    assert sensor_in(model.camera.manifest()) == SENSOR
    seen, encode = [], model.encode
    monkeypatch.setattr(model, "encode", lambda frames: encode((seen.append(frames), frames)[1]))
    states = np.random.default_rng(0).normal(size=(5, 16, 4)) * [0.02, 0.2, 0.2, 1]
    own = SensorSettings(ideal=True)
    for sensor, expected in ((SensorSettings(), SENSOR), (own, own)):
        settings = dataclasses.replace(load_settings(), sensor=sensor)
        assert under_law_of(model, settings).sensor == expected
        build_driver("local", settings, model).sensor(states)
        camera = camera_of(plant("desktop"), settings.camera, expected)
        shown = states[:, frames_back(model.look)]
        wanted = camera.render(shown.reshape(-1, 4)).reshape(5, -1, 64, 128, 3)
        np.testing.assert_array_equal(seen.pop(), wanted)


def test_curves_of_another_sensor_are_measured_again():
    plain, sensed = (Digest.of("m", settings_of(one)) for one in (SensorSettings(), SENSOR))
    assert plain != sensed


def test_an_encoder_of_another_sensor_is_refused_for_a_dataset(model):
    settings = dataclasses.replace(load_settings(), sensor=SENSOR)
    check_same_plant(model.metadata, settings, "encoder")
    with pytest.raises(DataError, match="pictures of another sensor"):
        check_same_plant(model.metadata, load_settings(), "encoder")
    with pytest.raises(DataError, match="sensor than dataset my data has") as caught:
        check_same_plant(model.metadata, load_settings(), "encoder", Path("my data"))
    assert caught.value.hint.startswith("hjepa train-encoder --dataset 'my data', or")


def test_a_collection_cannot_be_of_a_sensor_that_is_told_off():
    with pytest.raises(UsageError, match=r"sensor\.ideal = true is for models"):
        collect.check(settings_of(SensorSettings(ideal=True)))


def test_an_exposure_longer_than_a_step_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "c.toml").write_text("[sensor]\nexposure_ms = 3.0\n")
    shell = open_shell(tmp_path, monkeypatch, capsys)
    with shell.untouched():
        outcome = shell("collect", "--config", "c.toml", "--dry-run")
    assert_one_line_error(outcome, 2, "exposed for 1 ms at most")
