"""The notebook of the documentation runs from top to bottom, without Jupyter."""

import json

import pytest
from command_line import ROOT

from hjepa_cli.storage import zoo

NOTEBOOK = json.loads((ROOT / "docs/first_cell.ipynb").read_text(encoding="utf-8"))
CODE = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


@pytest.mark.skipif("desktop-h4m2l1" not in zoo.list_models(), reason="the zoo lacks the model")
def test_the_cells_run_and_draw_what_they_say(tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    monkeypatch.chdir(tmp_path)
    known = {"__name__": "notebook"}
    for number, code in enumerate(CODE):
        exec(compile(code, f"cell {number}", "exec"), known)
    assert known["z"].shape == (1, 256) and known["forces_n"].shape == (1, 100)
    assert abs(known["imagined"][-1]) < 4 and abs(known["held"][-1]) > 20  # degrees
    axes = known["axes"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [*known["names"].values()]
    top = {line.get_label(): line.get_ydata()[-1] for line in axes.get_lines()}
    assert top["perfect model"] > top["H-JEPA"] > top["fading reflex"] > 0
    pyplot.close("all")


def test_it_is_kept_as_it_is_written():
    """Without outputs: they would be another zoo's."""
    for cell in NOTEBOOK["cells"]:
        assert cell["cell_type"] == "markdown" or (
            not cell["outputs"] and not cell["execution_count"]
        )
