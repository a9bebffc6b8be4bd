"""The README: what a newcomer sees first, and its numbers against what its commands print."""

import importlib.machinery
import importlib.util
import json
import re

import numpy as np
import pytest
from command_line import ROOT, open_shell
from test_zoo_numbers import agree, numbers

from hjepa_cli.core.statistics import student_interval
from hjepa_cli.stages.compare import differences
from hjepa_cli.storage import files, zoo

MODEL = "desktop-h4m2l1"
TEXT = (ROOT / "README.md").read_text()
FIRST_SCREEN = "\n".join(TEXT.splitlines()[:30])

pytestmark = pytest.mark.skipif(MODEL not in zoo.list_models(), reason="the zoo lacks the model")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def rows(text, header):
    """A table of a page by the backticked name of each row: heading → cell."""
    lines = text[text.index(header) :].split("\n\n")[0].splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {
        re.match(r"`([^`]+)`", row[0])[1]: dict(zip(table[0], row, strict=True))
        for row in table[2:]
    }


def test_the_first_screen_says_what_it_is_and_how_to_get_the_figure():
    for text in (
        "How many inverted pendulums",
        "docs/figures/devices.png",
        "    make demo",
        "oracle",
    ):
        assert text in FIRST_SCREEN, text


def test_the_main_table_is_what_its_command_prints(shell):
    """``hjepa scale --snr 10:30`` in an empty directory, for real."""
    assert "    .venv/bin/hjepa scale --snr 10:30\n" in TEXT
    document = shell("scale", "--snr", "10:30", "--json").document
    counted = {(row["method"], row["snr_db"]): row for row in document["rows"]}
    table = rows(TEXT, "| method | gap D* [ms]")
    assert {"oracle", "hjepa", "ts-jepa-1", "hold"} <= table.keys()
    for method, row in table.items():
        for column, snr_db in (("devices at 10 dB", 10), ("at 20 dB", 20), ("at 30 dB", 30)):
            found = counted[method, snr_db]
            assert numbers(row[column]) == [found["devices"], *found["devices_ci95"]], method
        found = counted[method, 20]  # one step is a millisecond
        assert agree(row["gap D* [ms]"], found["tolerance"], *found["tolerance_ci95"]), method
        if method in ("hjepa", "hold", "oracle"):
            assert f"{found['devices']:,}" in FIRST_SCREEN
    if importlib.util.find_spec("sionna"):
        document_nr = shell("scale", "--phy", "nr", "--snr", "20", "--json").document
        for found in document_nr["rows"]:
            if found["method"] in table:
                cell = table[found["method"]]["at 20 dB, 5G NR"]
                assert numbers(cell) == [found["devices"], *found["devices_ci95"]], found
    gains = {gain["over"]: gain for gain in document["gains"] if gain["method"] == "hjepa"}
    low, high = gains["ts-jepa-1"]["ratio_ci95"]
    more = f"{100 * (gains['ts-jepa-1']['ratio'] - 1):.1f} % ({100 * (low - 1):.1f} to"
    assert more.replace("-", "−") + f" {100 * (high - 1):.1f})" in TEXT
    share, (low, high) = gains["oracle"]["ratio"], gains["oracle"]["ratio_ci95"]
    assert f"{100 * share:.0f} % ({100 * low:.0f} to {100 * high:.0f})" in TEXT


def test_scores_in_the_text_are_those_of_the_curves():
    entries = files.read_json(zoo.zoo_directory() / MODEL / zoo.CURVES_FILE)["methods"]
    (point,) = [point for point in entries["hjepa"]["gap_curve"] if point["d"] == 80]
    low, high = point["ci95"]
    assert f"{point['score']:.3f} ({low:.3f}–{high:.3f}, 64 devices)" in TEXT
    page = (ROOT / "docs/metrics.md").read_text()
    table = rows(page, "| D [steps] | 20")
    for method, row in table.items():
        curve = {point["d"]: point for point in entries[method]["gap_curve"]}
        for gap_steps, cell in list(row.items())[1:]:
            point = curve[float(gap_steps)]
            score, ratio = cell.split(" / ")
            assert agree(score, point["score"]) and agree(ratio, point["lq_ratio"]), (method, cell)


def test_the_five_trainings_are_what_was_measured():
    """README's table from the results that are kept, by the rules of the study."""
    kept = json.loads((ROOT / "docs/results/five_trainings.json").read_text())["methods"]
    assert all(len(by_seed) == 5 for by_seed in kept.values())
    found = {one["over"]: one for one in differences(kept, left_out=())}
    header, gap = "| method | gap D* [ms] | delivery p* | D* of", "gap D* [ms]"
    over_gap, over_p = "D* of `hjepa` ÷ its", "its p* ÷ that of `hjepa`"
    for method, row in rows(TEXT, header).items():
        for column, key in ((gap, "tolerance_gap_steps"), ("delivery p*", "tolerance_p")):
            values = np.array([entry[key] for entry in kept[method].values()])
            assert agree(row[column], values.mean(), *student_interval(values)), (method, column)
        for column, key in ((over_gap, "tolerance_gap_ratio"), (over_p, "tolerance_p_ratio")):
            if method != "hjepa":
                ratio = found[method][key]
                assert agree(row[column].strip("*"), ratio["mean"], *ratio["ci95"]), method


def test_eval_and_report_in_an_empty_directory(shell):
    """The other commands that need nothing before them, for real."""
    assert shell("eval", "--quiet").code == shell("scale", "--quiet").code == 0
    assert len(shell("report", "--json").document["runs"]) == 2
    assert (shell.directory / "report.html").read_text().count("<img") == 4


@pytest.mark.slow
def test_the_pictures_of_the_documentation_are_drawn_by_the_script(tmp_path):
    """Up to how other versions of matplotlib and Pillow set letters."""
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    loader = importlib.machinery.SourceFileLoader("figures_script", str(ROOT / "scripts/figures"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    module.main(tmp_path)
    made, kept = ({path.name for path in folder.iterdir()} for folder in
                  (tmp_path, ROOT / "docs/figures"))  # fmt: skip
    of_several = {"embedding.png", "training_size.png"}  # not of the zoo's models
    assert made == kept - of_several
    page = (ROOT / "docs/figures.md").read_text()
    for name in made:
        assert f"figures/{name}" in page
        pixels = []
        for folder in (tmp_path, ROOT / "docs/figures"):
            with image.open(folder / name) as picture:  # of a film one in its middle
                picture.seek(getattr(picture, "n_frames", 1) // 2)
                pixels.append(np.asarray(picture.convert("L"), float))
        assert pixels[0].shape == pixels[1].shape, name
        assert np.abs(pixels[0] - pixels[1]).mean() < 3, name
