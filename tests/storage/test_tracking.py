"""Optional logging: off by default, and then a copy of metrics.csv."""

import csv
import io
import sys
import warnings
from pathlib import Path

import pytest

from hjepa_cli.errors import MissingInputError, UsageError
from hjepa_cli.storage.runs import Run

ROWS = [{"level": "high", "step": step, "loss": 1 / step, "note": None} for step in (10, 20, 30)]


def run(directory: Path, rows: list[dict]) -> None:
    with Run.create("train-hierarchy", directory, {}) as record:
        for row in rows:
            record.metric(row)


def test_nothing_is_logged_unless_asked_for(tmp_path, monkeypatch):
    monkeypatch.delenv("HJEPA_LOG", raising=False)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)  # would be noticed
    run(tmp_path / "r", ROWS)
    assert not list((tmp_path / "r").glob("events.out*"))


def test_tensorboard_gets_what_metrics_csv_gets(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    monkeypatch.setenv("HJEPA_LOG", "tensorboard")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other people's deprecations
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        run(tmp_path / "r", ROWS)
        logged = EventAccumulator(str(tmp_path / "r"))
        logged.Reload()
    assert logged.Tags()["scalars"] == ["high/loss"]
    values = [(event.step, event.value) for event in logged.Scalars("high/loss")]
    table = csv.DictReader(io.StringIO((tmp_path / "r" / "metrics.csv").read_text()))
    assert values == [(int(row["step"]), pytest.approx(float(row["loss"]))) for row in table]


def test_what_cannot_be_logged_to_is_refused_before_the_run_starts(tmp_path, monkeypatch):
    monkeypatch.setenv("HJEPA_LOG", "wandb")
    with pytest.raises(UsageError, match="wandb"):
        run(tmp_path / "r", ROWS)
    monkeypatch.setenv("HJEPA_LOG", "tensorboard")
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingInputError) as refused:
        run(tmp_path / "r", ROWS)
    assert 'pip install "hjepa[track]"' in (refused.value.hint or "")
    assert not (tmp_path / "r").exists()
