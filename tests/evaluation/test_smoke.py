"""Models of preset smoke have learned nothing, and nobody gets one without asking for it."""

import io
import shutil

from command_line import open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.model_set import default_model
from hjepa_cli.storage.checkpoints import MODEL_FILE
from hjepa_cli.storage.runs import Run
from hjepa_cli.storage.zoo import zoo_directory


def test_a_smoke_model_is_nobody_s_default(tmp_path, monkeypatch, capsys) -> None:
    """`hjepa reproduce --preset smoke` and then a plain `scale` is what people try first."""
    shell = open_shell(tmp_path, monkeypatch, capsys)
    smoke = load_settings("smoke").as_dict()
    model = zoo_directory() / "desktop-h4m2l1" / MODEL_FILE
    with Run.create("train-hierarchy", None, smoke) as record:
        shutil.copy(model, record.path(MODEL_FILE))
        record.finish({"checkpoint": record.path(MODEL_FILE)})
    screen = Screen(stdout=io.StringIO(), stderr=io.StringIO())
    assert default_model(load_settings(), screen) == model
    assert "is of preset smoke, too small to learn" in screen._stderr.getvalue()
    assert default_model(load_settings("smoke"), screen) == record.path(MODEL_FILE).relative_to(".")
    plan = shell("scale", "--dry-run", "--json").document["plan"]
    assert not any("runs/train-hierarchy" in line for line in plan["reads"])
    plan = shell("scale", "--dry-run", "--json", "--preset", "smoke").document["plan"]
    assert any("runs/train-hierarchy" in line for line in plan["reads"])
