"""Figures: equal bytes, the right size and fonts, nothing lost on the way to the axes."""

import struct
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from hjepa_cli import plugins
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import SCHEDULERS

matplotlib = pytest.importorskip("matplotlib")
from hjepa_cli.output import figures  # noqa: E402 - needs matplotlib

METHODS = ("hjepa", "ts-jepa-1", "ts-jepa-4", "hold", "zero", "hold-true", "zero-true", "oracle")


def rows(methods=METHODS, snr_db=(10.0, 15.0, 20.0), spread=0.1, scale=100.0):
    return [
        {
            "snr_db": snr,
            "method": method,
            "devices": int(scale * (rank + 1) * snr),
            "devices_ci95": [int(scale * (rank + 1) * snr * (1 + s)) for s in (-spread, spread)],
        }
        for snr in snr_db
        for rank, method in enumerate(methods)
    ]


def lines(figure):
    return {line.get_label(): line for line in figure.axes[0].lines}


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_equal_data_give_equal_bytes(tmp_path, kind):
    first = figures.save(figures.devices_figure(rows()), tmp_path / f"first.{kind}")
    second = figures.save(figures.devices_figure(rows()), tmp_path / f"second.{kind}")
    assert first.read_bytes() == second.read_bytes()
    other = figures.devices_figure(rows(scale=101.0))
    assert figures.save(other, tmp_path / f"other.{kind}").read_bytes() != first.read_bytes()


def test_another_process_writes_the_same_svg(tmp_path):
    """Element ids come from the salt, not from a process's random numbers; no date either."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[2]); from pathlib import Path\n"
        "from hjepa_cli.output import figures; from test_figures import rows\n"
        "figures.save(figures.devices_figure(rows()), Path(sys.argv[1]))"
    )
    path = tmp_path / "elsewhere.svg"
    here = str(Path(__file__).parent)
    root = str(Path(__file__).parents[2])
    subprocess.run(
        [sys.executable, "-c", script, str(path), here], check=True, cwd=root, timeout=120
    )
    text = figures.save(figures.devices_figure(rows()), tmp_path / "here.svg").read_bytes()
    assert path.read_bytes() == text
    assert b"<dc:date>" not in text


def test_figures_are_one_column_wide(tmp_path):
    png = figures.save(figures.devices_figure(rows()), tmp_path / "f.png").read_bytes()
    width_px, _ = struct.unpack(">II", png[16:24])
    assert width_px == 3.5 * 300
    svg = ElementTree.parse(figures.save(figures.devices_figure(rows()), tmp_path / "f.svg"))
    assert float(svg.getroot().get("width").removesuffix("pt")) == pytest.approx(3.5 * 72)


def test_pdf_fonts_are_truetype(tmp_path):
    pdf = figures.save(figures.devices_figure(rows()), tmp_path / "f.pdf").read_bytes()
    assert b"/FontFile2" in pdf or b"/CIDFontType2" in pdf
    assert b"/Type3" not in pdf


def test_every_method_is_a_line_through_its_counts():
    drawn = lines(figures.devices_figure(rows()))
    assert set(drawn) == set(METHODS)
    assert list(drawn["hold"].get_xdata()) == [10, 15, 20]
    assert list(drawn["hold"].get_ydata()) == [4000, 6000, 8000]


def test_bands_are_the_intervals():
    figure = figures.devices_figure(rows(methods=["hjepa"]))
    (band,) = figure.axes[0].collections
    corners = band.get_paths()[0].vertices
    assert {(10.0, 900.0), (10.0, 1100.0), (20.0, 1800.0), (20.0, 2200.0)} <= {
        (float(x), float(y)) for x, y in corners
    }


def test_methods_differ_without_colour():
    drawn = lines(figures.devices_figure(rows()))
    assert len(
        {(line.get_marker(), line.get_markerfacecolor() == "none") for line in drawn.values()}
    ) == len(METHODS)


def test_every_look_is_one_method_s_also_without_colour():
    styles = [plugins.METHODS[name].style for name in plugins.METHODS]
    looks = {(style.marker, style.hollow) for style in styles}
    assert len(looks) == len(styles)


def test_curves_on_top_of_each_other_all_stay_visible():
    """Each is drawn over those with larger markers, and the largest has the solid line."""
    drawn = lines(figures.devices_figure(rows(("hjepa", "ts-jepa-1", "ts-jepa-4"))))
    above = sorted(drawn, key=lambda name: drawn[name].get_zorder())
    assert above == ["hjepa", "ts-jepa-4", "ts-jepa-1"]
    sizes = [drawn[name].get_markersize() for name in above]
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == 3
    assert drawn["hjepa"].get_linestyle() == "-" != drawn["ts-jepa-1"].get_linestyle()


def test_methods_differ_by_name_not_by_order():
    """A method keeps its look whatever else is in the figure."""
    alone, all_of_them = (
        lines(figures.devices_figure(rows(methods)))["hold"] for methods in (["hold"], METHODS)
    )
    assert alone.get_color() == all_of_them.get_color()
    assert alone.get_marker() == all_of_them.get_marker()


def test_rows_in_any_order_give_the_same_lines():
    backwards = lines(figures.devices_figure(rows()[::-1]))
    assert list(backwards["hjepa"].get_xdata()) == [10, 15, 20]


def test_methods_a_decade_apart_are_logarithmic_and_close_ones_start_at_zero():
    close = rows(METHODS[:3], snr_db=(1.0, 20.0))  # a decade apart by SNR only
    assert figures.devices_figure(close).axes[0].get_yscale() == "linear"
    assert figures.devices_figure(close).axes[0].get_ylim()[0] == 0
    far = rows(METHODS[:2], snr_db=(20.0,)) + rows(["oracle"], snr_db=(20.0,), scale=2000.0)
    assert figures.devices_figure(far).axes[0].get_yscale() == "log"


def test_nothing_is_cut_off():
    for data in (rows(), rows(scale=1e4)[:8] + rows()[8:], rows(spread=0.9)):
        axes = figures.devices_figure(data).axes[0]
        low, high = axes.get_ylim()
        counts = [row["devices"] for row in data]
        assert low < min(counts) and high > max(counts)


def test_methods_without_devices_are_named_and_methods_without_counts_left_out():
    data = rows(["hjepa"])
    data += [row | {"method": "zero", "devices": 0, "devices_ci95": [0, 0]} for row in data]
    data += [row | {"method": "optimal", "devices": None, "devices_ci95": None} for row in data[:3]]
    drawn = lines(figures.devices_figure(data))
    assert set(drawn) == {"hjepa", "zero (0)"}
    assert np.isnan(drawn["zero (0)"].get_ydata()).all()


def test_one_snr_shows_its_interval_as_a_bar():
    figure = figures.devices_figure(rows(["hjepa"], snr_db=(20.0,)))
    (bar,) = figure.axes[0].collections
    assert bar.get_segments()[0][:, 1].tolist() == [1800.0, 2200.0]


def test_nobody_anywhere_still_draws(tmp_path):
    data = [row | {"devices": 0, "devices_ci95": [0, 0]} for row in rows(["hjepa", "hold"])]
    assert figures.save(figures.devices_figure(data), tmp_path / "f.png").stat().st_size > 0


def test_unknown_format(tmp_path):
    with pytest.raises(UsageError, match=r"\.png, \.svg, \.pdf"):
        figures.save(figures.devices_figure(rows()), tmp_path / "f.gif")


def test_no_global_state_is_left_behind():
    before = dict(matplotlib.rcParams)
    figures.devices_figure(rows())
    assert dict(matplotlib.rcParams) == before
    assert (
        "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()
    )


def test_bounds_are_named_as_such() -> None:
    measured = [{**row, "at_least": row["method"] == "oracle"} for row in rows()]
    assert "oracle (at least)" in lines(figures.devices_figure(measured))
    assert "hjepa" in lines(figures.devices_figure(measured))


def scheduled_rows(methods=("hjepa", "hold"), snr_db=(10.0, 20.0, 30.0)):
    return [
        {**row, "method": method, "scheduler": row["method"]}
        for method in methods
        for row in rows(list(SCHEDULERS), snr_db=snr_db)
    ]


@pytest.mark.parametrize("snr_db", [(10.0, 20.0, 30.0), (20.0,)])
def test_every_scheduler_is_a_line_in_its_method_s_panel(snr_db):
    result = {"law": "scheduled", "rows": scheduled_rows(snr_db=snr_db)}
    figure = figures.scale_figure(result, title="a cell")
    assert len(figure.axes) == 2 and figure.axes[0].get_title() == "a cell"
    for axes in figure.axes:
        drawn = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
        assert list(drawn) == list(SCHEDULERS)
        for rank, bars in enumerate(drawn.values()):
            line, _, (interval,) = bars.lines
            assert list(line.get_ydata()) == [int(100 * (rank + 1) * snr) for snr in snr_db]
            assert np.abs(line.get_xdata() - np.array(snr_db)).max() < 2  # apart, but at its SNR
            ends = np.array([segment[:, 1] for segment in interval.get_segments()])
            assert ends == pytest.approx(np.outer(line.get_ydata(), [0.9, 1.1]), abs=1)


def test_schedulers_differ_without_colour():
    styles = [SCHEDULERS[name].style for name in SCHEDULERS]
    looks = {(style.marker, str(style.line), style.hollow) for style in styles}
    assert len(looks) == len(styles)
