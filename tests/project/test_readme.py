"""The README: what a newcomer sees first, and its numbers against what its commands print."""

import importlib.machinery
import importlib.util
import re

import numpy as np
import pytest
from command_line import ROOT, open_shell
from test_zoo_numbers import agree, numbers

from hjepa_cli.storage import files, zoo

MODEL = "desktop-h4m2l1"
TEXT = (ROOT / "README.md").read_text()
FIRST_SCREEN = "\n".join(TEXT.splitlines()[:32])
CLAIM = TEXT[TEXT.index("<!-- table: claim -->") :].partition("<!-- end -->")[0]

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


def test_the_first_screen_says_what_goes_in_what_comes_out_what_was_found_and_what_it_cannot_do():
    for text in (
        "How many inverted pendulums",
        "- **In:**",
        "- **Out:**",
        "<!-- table: claim -->",
        "    make demo",
        "**What it cannot do.**",
        "docs/figures/",
    ):
        assert text in FIRST_SCREEN, text


def test_the_main_table_is_what_the_commands_print(shell):
    """``make demo`` in an empty directory, for real; and the same on a 5G uplink."""
    assert "scale --snr 10:30 --checkpoint desktop-h4m2l1" in (ROOT / "Makefile").read_text()
    document = shell("scale", "--snr", "10:30", "--checkpoint", MODEL, "--json").document
    counted = {row["method"]: row for row in document["rows"] if row["snr_db"] == 20}
    table = rows(TEXT, "| method | gap D* [ms]")
    assert len(table) == 5 and {"oracle", "hjepa", "chunk"} <= table.keys()
    for method, row in table.items():
        found = counted[method]
        assert numbers(row["devices, Shannon"]) == [found["devices"], *found["devices_ci95"]]
        assert agree(row["gap D* [ms]"], found["tolerance"], *found["tolerance_ci95"]), method
    if importlib.util.find_spec("sionna"):
        document_nr = shell("scale", "--phy", "nr", "--snr", "20", "--json").document
        for found in document_nr["rows"]:
            if found["method"] in table:
                cell = table[found["method"]]["devices, 5G NR"]
                assert numbers(cell) == [found["devices"], *found["devices_ci95"]], found
    gains = {gain["over"]: gain["ratio"] for gain in document["gains"] if gain["method"] == "hjepa"}
    assert f"on time, as many as without prediction, {100 * gains['oracle']:.0f} % of" in CLAIM
    low, high = next(g["ratio_ci95"] for g in document["gains"] if g["over"] == "chunk")
    assert low < 1 < high


def test_the_claim_is_of_the_delays_that_were_measured():
    """Its rivals predict nothing: a network, and forces that fade, each made for one gap."""
    best: dict[str, list[int]] = {}  # devices and the ends of their interval
    for row in files.read_json(ROOT / "docs/results/delay.json")["rows"]:
        if row["delay_ms"] == 40:
            found = [row["devices"], *row["devices_ci95"]]
            best[row["method"]] = max(found, best.get(row["method"], [0]))
    own, reflex = best["hjepa"], max(best["chunk-forces"], best["hold-decay-linear"])
    ratio, least = own[0] / reflex[0], own[1] / reflex[2]
    assert "40 ms late" in CLAIM and f"{ratio:.1f} times (at least {least:.1f})" in CLAIM
    assert f"{100 * own[0] / best['oracle'][0]:.0f} % as many as with a\n> perfect model" in CLAIM


def test_limits_of_pictures_are_those_that_were_measured():
    """÷ the nominal score at a gap of 80 steps."""
    stress = files.read_json(ROOT / f"docs/results/stress-{MODEL}.json")["stress"]
    assert stress["gaps"][1] == 80
    kept = {
        row["condition"]: row["points"][1]["relative"] for row in stress["methods"]["hjepa"]["rows"]
    }
    mild = ("light=0.7", "light=1.3", "gamma=0.8", "gamma=1.25", "blur=1.5", "jpeg=75", "noise=8")
    (said,) = re.findall(r"cost at most (\d+) % of the score at gaps of 80\s+ms", TEXT)
    assert round(100 * (1 - min(kept[name] for name in mild))) == int(said)
    assert abs(kept["jitter=0.1"] - 4 / 5) < 0.05
    audit = files.read_json(ROOT / f"docs/results/audit-{MODEL}.json")["stress"]
    at = {row["condition"]: row["points"][1] for row in audit["methods"]["hjepa"]["rows"]}
    assert min(kept["rotation=2"], kept["shift=4"], at["shift_down=4"]["relative"]) > 9 / 10
    assert abs(at["post=4"]["relative"] - 1 / 3) < 0.05
    assert at["top=0.3333"]["lost"] == 3 / 8


def test_scores_of_those_who_know_the_state_are_those_of_the_curves():
    entries = files.read_json(zoo.zoo_directory() / MODEL / zoo.CURVES_FILE)["methods"]
    page = (ROOT / "docs/reference/metrics.md").read_text()
    for method, row in rows(page, "| D [steps] | 20").items():
        curve = {point["d"]: point for point in entries[method]["gap_curve"]}
        for gap_steps, cell in list(row.items())[1:]:
            point = curve[float(gap_steps)]
            score, ratio = cell.split(" / ")
            assert agree(score, point["score"]) and agree(ratio, point["lq_ratio"]), (method, cell)


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
    page = (ROOT / "docs/how-to/figures.md").read_text()
    for name in made:
        assert f"figures/{name}" in page
        pixels = []
        for folder in (tmp_path, ROOT / "docs/figures"):
            with image.open(folder / name) as picture:
                pixels.append(np.asarray(picture.convert("L"), float))
        assert pixels[0].shape == pixels[1].shape, name
        assert np.abs(pixels[0] - pixels[1]).mean() < 3, name
