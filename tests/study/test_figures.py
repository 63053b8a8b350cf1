"""Tests figures by the drawn axes and the written files."""

import numpy as np
import pandas as pd
import pytest

from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.study import figures
from rtd3jax.study.colours import colour_of
from rtd3jax.study.statistics import summarise


def cell(algorithm="td3", length=0, disturbance="none", seeds=3, level=-100.0):
    """Curve and episode rows of one cell, improving from ``level - 50`` to ``level``."""
    base = {
        "env": "pendulum",
        "disturbance": disturbance,
        "algorithm": algorithm,
        "history_length": length,
    }
    curves, episodes = [], []
    for seed in range(seeds):
        for index in range(11):
            value = level - 50 + 5 * index + seed
            row = {"seed": seed, "step": 1000 * index, "return": value, "true_return": value}
            curves.append(base | row)
        value = level + seed
        row = {"seed": seed, "episode": 0, "return": value, "true_return": value}
        episodes.append(base | row)
    return curves, episodes


def tables(*cells):
    curves = pd.DataFrame([row for c in cells for row in c[0]])
    return curves, pd.DataFrame([row for c in cells for row in c[1]])


def reference(name, level, disturbance="none"):
    _, episodes = cell(name, disturbance=disturbance, seeds=1, level=level)
    return [], [row | {"seed": -1} for row in episodes]


@pytest.fixture
def drawn(monkeypatch):
    """The figures passed to the writer, in order; it writes nothing."""
    seen = []
    monkeypatch.setattr(figures, "_save", lambda figure, *rest: seen.append(figure) or [])
    return seen


def line(axes, label):
    (found,) = [drawn_line for drawn_line in axes.lines if drawn_line.get_label() == label]
    return found


def labels(axes):
    return [drawn_line.get_label() for drawn_line in axes.lines]


def test_learning_curves_write_a_png_and_an_svg(tmp_path):
    curves, _ = tables(cell())
    paths = figures.learning_curves(curves, None, tmp_path)
    assert [path.name for path in paths] == ["learning_curves.png", "learning_curves.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG") and b"</svg>" in paths[1].read_bytes()


def test_final_returns_write_a_png_and_an_svg(tmp_path):
    _, episodes = tables(cell())
    paths = figures.final_returns(episodes, tmp_path)
    assert [path.name for path in paths] == ["final_returns.png", "final_returns.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG") and b"</svg>" in paths[1].read_bytes()


def test_svg_bytes_are_the_same_for_the_same_data_in_any_order(tmp_path):
    curves, episodes = tables(cell(), cell("lstm-td3", 3), reference("random", -160))
    first, second = tmp_path / "a", tmp_path / "b"
    figures.learning_curves(curves, episodes, first)
    figures.final_returns(episodes, first)
    figures.learning_curves(curves[::-1], episodes[::-1], second)
    figures.final_returns(episodes[::-1], second)
    for name in ("learning_curves.svg", "final_returns.svg"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_a_curve_is_the_iqm_over_seeds_against_steps(tmp_path, drawn):
    curves, _ = tables(cell(seeds=3, level=-100.0))
    figures.learning_curves(curves, None, tmp_path)
    steps, mean = line(drawn[0].axes[0], "td3").get_data()
    np.testing.assert_array_equal(steps, np.arange(11) * 1000)
    np.testing.assert_allclose(mean, -150 + 5 * np.arange(11) + 1)


def test_the_band_is_the_interval_of_the_iqm_and_no_better_than_any_seed(tmp_path, drawn):
    curves, _ = tables(cell(seeds=5, level=-100.0))
    curves.loc[(curves["seed"] == 0) & (curves["step"] == 0), "return"] = -9_000.0
    figures.learning_curves(curves, None, tmp_path)
    (band,) = drawn[0].axes[0].collections
    at_start = [y for x, y in band.get_paths()[0].vertices if x == 0]
    summary = summarise(curves.loc[curves["step"] == 0, "return"])
    assert (min(at_start), max(at_start)) == pytest.approx((summary.iqm_low, summary.iqm_high))
    assert max(at_start) <= -146.0 and min(at_start) < -1_000.0


def test_a_curve_of_very_many_evaluations_is_thinned(tmp_path, drawn):
    rows, _ = cell(seeds=1)
    curves = pd.DataFrame([{**rows[0], "step": step, "return": -step / 10} for step in range(999)])
    figures.learning_curves(curves, None, tmp_path)
    steps = line(drawn[0].axes[0], "td3").get_xdata()
    assert (len(steps), steps[0], steps[-1]) == (200, 0, 998)


def test_a_lost_seed_does_not_break_the_mean(tmp_path, drawn):
    curves, _ = tables(cell(seeds=2, level=-100.0))
    curves.loc[(curves["seed"] == 1) & (curves["step"] > 5000), "return"] = np.nan
    figures.learning_curves(curves, None, tmp_path)
    assert line(drawn[0].axes[0], "td3").get_ydata()[-1] == -100.0


def test_there_is_a_panel_per_disturbance_and_history_length(tmp_path, drawn):
    cells = [cell("lstm-td3", n, d) for n in (1, 3) for d in ("none", "drift")]
    figures.learning_curves(tables(*cells)[0], None, tmp_path)
    assert [axes.get_title() for axes in drawn[0].axes] == [
        "no disturbance, history 1",
        "no disturbance, history 3",
        "drift, history 1",
        "drift, history 3",
    ]


def test_td3_is_drawn_beside_every_history_length(tmp_path, drawn):
    curves, _ = tables(cell(), cell("lstm-td3", 1), cell("lstm-td3", 3))
    figures.learning_curves(curves, None, tmp_path)
    assert [labels(axes) for axes in drawn[0].axes] == [["td3", "lstm-td3"]] * 2


def test_each_panel_shows_its_own_history_length(tmp_path, drawn):
    curves, _ = tables(cell("lstm-td3", 1, level=-90.0), cell("lstm-td3", 3, level=-70.0))
    figures.learning_curves(curves, None, tmp_path)
    ends = [line(axes, "lstm-td3").get_ydata()[-1] for axes in drawn[0].axes]
    assert ends == [-89.0, -69.0]


def test_each_algorithm_has_its_own_colour():
    agents = (*ALGORITHMS, "lstm-td3-privileged", "another")
    for on_dark in (False, True):
        assert len({colour_of(name, on_dark=on_dark) for name in agents}) == len(agents)


def test_references_are_lines_at_their_mean_return(tmp_path, drawn):
    curves, episodes = tables(cell(), reference("random", -160), reference("constant", -120))
    figures.learning_curves(curves, episodes, tmp_path)
    assert line(drawn[0].axes[0], "random").get_ydata()[0] == -160
    assert line(drawn[0].axes[0], "constant").get_ydata()[0] == -120


def test_a_far_reference_is_named_instead_of_squashing_the_panel(tmp_path, drawn):
    _, episodes = tables(cell(), reference("random", -5000))
    figures.final_returns(episodes, tmp_path)
    axes = drawn[0].axes[0]
    assert [text.get_text() for text in axes.texts] == ["↓ random: -5000"]
    assert axes.get_ylim()[0] > -200


def test_a_terrible_start_does_not_squash_the_end(tmp_path, drawn):
    rows, _ = cell(level=-100.0)
    # 61 evaluations, the first of them disastrous.
    curves = pd.concat(
        [pd.DataFrame(rows).assign(step=lambda t, k=k: t["step"] + 11000 * k) for k in range(6)]
    )
    curves.loc[curves["step"] == 0, "return"] = -1e6
    figures.learning_curves(curves, None, tmp_path)
    assert drawn[0].axes[0].get_ylim()[0] > -500


def test_no_final_mean_is_clipped(tmp_path, drawn):
    cells = [cell("lstm-td3", n) for n in range(1, 40)] + [cell("h-td3", 1, level=-1000.0)]
    curves, _ = tables(*cells)
    # One poor cell of forty: rarer than the clipped share.
    figures.learning_curves(curves, None, tmp_path)
    assert drawn[0].axes[0].get_ylim()[0] < -999


def test_panels_of_one_disturbance_share_their_limits(tmp_path, drawn):
    curves, _ = tables(cell("lstm-td3", 1, level=-90.0), cell("lstm-td3", 3, level=-700.0))
    figures.learning_curves(curves, None, tmp_path)
    first, second = drawn[0].axes
    assert first.get_ylim() == second.get_ylim()


def test_final_marker_is_the_iqm_with_its_interval(tmp_path, drawn):
    _, episodes = tables(cell("lstm-td3", 3, seeds=5))
    figures.final_returns(episodes, tmp_path)
    axes, expected = drawn[0].axes[0], summarise(episodes["return"])
    assert line(axes, "lstm-td3 3").get_ydata()[0] == expected.iqm
    (bar,) = [drawn_line for drawn_line in axes.lines if len(drawn_line.get_xdata()) == 2]
    assert list(bar.get_ydata()) == [expected.iqm_low, expected.iqm_high]


def test_every_seed_is_a_dot(tmp_path, drawn):
    _, episodes = tables(cell(seeds=4, level=-100.0))
    figures.final_returns(episodes, tmp_path)
    (dots,) = drawn[0].axes[0].collections
    assert dots.get_offsets()[:, 1].tolist() == [-100, -99, -98, -97]


def test_a_single_seed_has_no_error_bar(tmp_path, drawn):
    _, episodes = tables(cell(seeds=1))
    figures.final_returns(episodes, tmp_path)
    assert [len(drawn_line.get_xdata()) for drawn_line in drawn[0].axes[0].lines] == [1]


def test_history_lengths_have_different_markers(tmp_path, drawn):
    _, episodes = tables(cell("lstm-td3", 1), cell("lstm-td3", 3))
    figures.final_returns(episodes, tmp_path)
    axes = drawn[0].axes[0]
    markers = {line(axes, f"lstm-td3 {length}").get_marker() for length in (1, 3)}
    assert len(markers) == 2


def test_references_are_not_on_the_axis_of_algorithms(tmp_path, drawn):
    _, episodes = tables(cell(), cell("h-td3", 3), reference("random", -160))
    figures.final_returns(episodes, tmp_path)
    names = [label.get_text() for label in drawn[0].axes[0].get_xticklabels()]
    assert names == ["td3", "h-td3"]


def test_a_study_without_finished_lanes_still_draws(tmp_path):
    curves, episodes = tables(cell())
    figures.learning_curves(curves[:0], episodes[:0], tmp_path)
    figures.final_returns(episodes[:0], tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


def test_drawing_leaves_the_settings_of_the_caller_alone(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    figures.learning_curves(tables(cell())[0], None, tmp_path)
    assert dict(matplotlib.rcParams) == before


def test_figures_keep_no_global_state():
    """pyplot keeps every figure it makes; these are made without it."""
    from matplotlib import pyplot

    from rtd3jax.study import figures

    assert not any(value is pyplot for value in vars(figures).values())
    assert pyplot.get_fignums() == []


def test_ceilings_are_lines_where_they_are_known(tmp_path, drawn):
    environments = ("none", "sine-slip", "other", "noise")
    made = [cell(level=-1.0, disturbance=name) for name in environments]
    curves, episodes = tables(*made)
    env = curves["env"].iloc[0]
    ceilings = {
        (env, "none"): {"mean": -0.9, "kind": "exact", "measure": "return"},
        (env, "sine-slip"): {"mean": -0.5, "kind": "upper bound", "measure": "return"},
        (env, "noise"): {"mean": -0.5, "kind": "upper bound", "measure": "true_return"},
        (env, "other"): {"missing": "nobody knows"},
    }
    figures.learning_curves(curves, None, tmp_path, ceilings)
    figures.final_returns(episodes, tmp_path, ceilings)
    for figure in drawn:
        by_title = {axes.get_title().split(",")[0]: axes for axes in figure.axes}
        found = [labels(by_title[t]) for t in ("no disturbance", "sine-slip", "other", "noise")]
        assert "ceiling" in found[0] and "upper bound" in found[1]
        assert not {"ceiling", "upper bound"} & {*found[2], *found[3]}
        words = [text.get_text() for text in figure.legends[0].get_texts()]
        assert words[-2:] == ["ceiling", "upper bound"]


def test_a_reference_with_an_episode_without_a_number_has_no_line(drawn, tmp_path):
    """The mean of its other episodes would be too high; an agent's mean is NaN then, too."""
    good, bad = reference("random", -120.0), reference("controller", -110.0)
    bad[1].append(bad[1][0] | {"episode": 1, "return": np.nan})
    _, episodes = tables(cell(), good, bad)
    figures.final_returns(episodes, tmp_path)
    shown = {line.get_label() for axes in drawn[0].axes for line in axes.lines}
    legend = {text.get_text() for text in drawn[0].legends[0].get_texts()}
    assert "random policy" in legend and "controller policy" not in legend | shown
