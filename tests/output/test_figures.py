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
from hjepa_cli.output.looks import Looks
from hjepa_cli.plugins import SCHEDULERS

matplotlib = pytest.importorskip("matplotlib")
from matplotlib.text import Text  # noqa: E402 - an annotation's own extent has its line in it

from hjepa_cli.output import figures, lettering  # noqa: E402 - needs matplotlib

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


def test_axes_are_linear_from_zero_unless_a_logarithm_is_asked_for():
    far = rows(METHODS[:2], snr_db=(20.0,)) + rows(["oracle"], snr_db=(20.0,), scale=2000.0)
    assert figures.devices_figure(far).axes[0].get_yscale() == "linear"
    assert figures.devices_figure(far).axes[0].get_ylim()[0] == 0
    assert figures.devices_figure(far, Looks(log=True)).axes[0].get_yscale() == "log"


def test_nothing_is_cut_off():
    for data in (rows(), rows(scale=1e4)[:8] + rows()[8:], rows(spread=0.9)):
        for log in (False, True):
            axes = figures.devices_figure(data, Looks(log=log)).axes[0]
            low, high = axes.get_ylim()
            counts = [row["devices"] for row in data]
            assert low < min(counts) and high > max(counts)


def test_methods_without_devices_are_named_and_methods_without_counts_left_out():
    data = rows(["hjepa"])
    data += [row | {"method": "zero", "devices": 0, "devices_ci95": [0, 0]} for row in data]
    data += [row | {"method": "optimal", "devices": None, "devices_ci95": None} for row in data[:3]]
    figure = figures.devices_figure(data)
    assert set(lines(figure)) == {"hjepa"}
    assert [legend.get_title().get_text() for legend in figure.legends] == ["no devices: zero"]


def test_a_count_of_nobody_is_drawn_where_an_axis_has_a_zero():
    data = rows(["hjepa"])
    data[0] |= {"devices": 0, "devices_ci95": [0, 0]}
    linear, log = (
        lines(figures.devices_figure(data, Looks(log=log)))["hjepa"].get_ydata()
        for log in (False, True)
    )
    assert linear[0] == 0 and np.isnan(log[0])


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
    figure = figures.scale_figure(result, Looks(title="a cell"))
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


# --- letters


def names(figure):
    """The names at the ends of lines, the highest first."""
    return sorted(figure.axes[0].texts, key=lambda text: -text.get_position()[1])


def test_lines_are_named_at_their_ends_in_their_colour_and_from_the_highest_down():
    figure = figures.devices_figure(rows(), Looks(labels={"hjepa": "H-JEPA"}))
    drawn = lines(figure)
    told = {text.get_text(): text for text in names(figure)}
    assert list(told) == [*METHODS[:0:-1], "H-JEPA"]
    for name, text in told.items():
        assert text.get_color() == drawn[name].get_color()
        assert text.xy == (20, drawn[name].get_ydata()[-1])


def test_lines_on_each_other_are_said_to_be():
    """A twentieth apart can be seen, a hundredth cannot."""
    data = rows(["hjepa"])
    scaled = lambda name, by: [  # noqa: E731
        row | {"method": name, "devices": by * row["devices"]} for row in rows(["hjepa"])
    ]
    figure = figures.devices_figure([*data, *scaled("hold", 0.99), *scaled("zero", 0.9)])
    assert [text.get_text() for text in names(figure)] == ["hjepa", "≈ hold", "zero"]
    assert [legend.get_title().get_text() for legend in figure.legends] == [lettering.LIES_ON]
    apart = figures.devices_figure([*data, *scaled("zero", 0.9)])
    assert not apart.legends


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ([0.8, 0.5, 0.2], [0.8, 0.5, 0.2]),
        ([0.5, 0.5], [0.55, 0.45]),
        ([0.5, 0.5, 0.46], [0.5867, 0.4867, 0.3867]),  # mean of 0.5, 0.6 and 0.66, less 0, 1, 2
        ([1.0, 1.0], [0.95, 0.85]),
        ([0.0, 0.0], [0.15, 0.05]),
        ([], []),
    ],
)
def test_names_are_spread_by_the_least_moves(wanted, expected):
    assert lettering.spread(wanted, 0.1) == pytest.approx(expected, abs=1e-3)


def overlapping(figure):
    """Pairs of texts of an axis, or of names at lines, that are drawn on each other."""
    figure.draw_without_rendering()
    found = []
    for axes in figure.axes:
        low, high = sorted(axes.get_xlim())
        groups = [axes.texts]
        for axis, ends in (
            (axes.xaxis, sorted(axes.get_xlim())),
            (axes.yaxis, sorted(axes.get_ylim())),
        ):
            low, high = ends
            shown = [
                tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high
            ]
            groups.append([label for label in shown if label.get_visible() and label.get_text()])
            texts = [label.get_text() for label in groups[-1]]
            assert len(set(texts)) == len(texts), texts  # none twice
        for group in groups:
            boxes = [(text.get_text(), Text.get_window_extent(text)) for text in group]
            found += [
                (one, other)
                for number, (one, box) in enumerate(boxes)
                for other, another in boxes[number + 1 :]
                if box.shrunk(0.98, 0.8).overlaps(another.shrunk(0.98, 0.8))
            ]
    return found


@pytest.mark.parametrize("looks", [Looks(), Looks(log=True), Looks().wide()])
@pytest.mark.parametrize(
    "data",
    [
        rows(),
        rows(scale=0.01),  # counts of a few
        rows(scale=1e4),
        rows(snr_db=(10.0, 10.25, 10.5, 20.0)),
        rows(snr_db=tuple(map(float, range(10, 31)))),
        rows(METHODS[:2]) + rows(["oracle"], scale=1e4),
        rows(spread=0.0, scale=1.0)[:1],
    ],
)
def test_letters_never_collide_or_repeat(data, looks):
    assert not overlapping(figures.devices_figure(data, looks))


@pytest.mark.parametrize("log", [None, False, True])
def test_letters_of_scores_and_errors_never_collide_or_repeat(log):
    entries = {
        name: {
            "nmae": [0.1],
            "nmae_windows": {"1-20": 2e-4 * 9**rank, "81-100": 0.03 / (rank + 1)},
            "nmae_windows_ci95": {"1-20": [1e-4, 0.9], "81-100": [0.001, 0.2]},
            "tolerance_gap_steps": 80.0,
            "gap_curve": [
                {"d": d, "score": 1 / d, "ci95": [0.9 / d, 1.1 / d]} for d in (1, 20, 320)
            ],
            "delivery_curve": [
                {"p": 1 / d, "score": 1 / d, "ci95": [0.9 / d, 1.1 / d]} for d in (1, 20, 320)
            ],
        }
        for rank, name in enumerate(METHODS[:4])
    }  # fmt: skip
    looks = Looks(log=log)
    for kind in ("gap", "delivery"):
        assert not overlapping(
            figures.score_figure(entries, kind, acceptable_score=0.62, step_s=1e-3, asked=looks)
        )
    assert not overlapping(figures.error_figure(entries, step_s=20e-3, asked=looks))
