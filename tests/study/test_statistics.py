"""Compares the statistics over seeds with oracles by hand."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtd3jax.study import statistics
from rtd3jax.study.statistics import (
    iqm_bands,
    probability_of_improvement,
    seed_means,
    summarise,
)

returns = st.floats(-1e4, 1e4, allow_nan=False)


def episodes(values_by_seed):
    """EPISODES rows of one cell; the true return is the return plus one."""
    return pd.DataFrame(
        [
            {
                "env": "pendulum",
                "disturbance": "none",
                "algorithm": "td3",
                "history_length": 0,
                "seed": seed,
                "episode": episode,
                "return": np.float32(value),
                "true_return": np.float32(value + 1),
            }
            for seed, values in values_by_seed.items()
            for episode, value in enumerate(values)
        ]
    )


@given(st.integers(1, 5).flatmap(lambda k: st.lists(returns, min_size=4 * k, max_size=4 * k)))
@settings(max_examples=40, deadline=None)
def test_iqm_is_the_mean_of_the_middle_half(values):
    quarter = len(values) // 4
    middle = sorted(values)[quarter : 3 * quarter]
    assert summarise(values).iqm == pytest.approx(sum(middle) / len(middle), abs=1e-6)


def test_iqm_ignores_an_outlier_that_moves_the_mean():
    assert summarise([1.0, 2.0, 3.0, -1e6]).iqm == 1.5


@given(st.lists(returns, min_size=2, max_size=12))
@settings(max_examples=40, deadline=None)
def test_interval_contains_the_iqm(values):
    summary = summarise(values)
    assert summary.iqm_low - 1e-6 <= summary.iqm <= summary.iqm_high + 1e-6


def test_interval_of_varied_seeds_has_a_width():
    summary = summarise([1.0, 2.0, 3.0, 4.0, 5.0])
    assert summary.iqm_low < summary.iqm < summary.iqm_high


def test_interval_matches_an_enumerated_bootstrap():
    # All 4**4 equally likely resamples of four seeds; the IQM of each is its middle pair's mean.
    values = np.array([0.0, 1.0, 4.0, 9.0])
    picks = np.stack(np.meshgrid(*[range(4)] * 4), axis=-1).reshape(-1, 4)
    iqms = np.sort(values[picks], axis=1)[:, 1:3].mean(axis=1)
    summary = summarise(values)
    # The distribution is discrete, so sampled quantiles may lie one atom beside the exact ones.
    assert summary.iqm_low == pytest.approx(np.quantile(iqms, 0.025), abs=0.5)
    assert summary.iqm_high == pytest.approx(np.quantile(iqms, 0.975), abs=2.5)


def test_interval_of_many_seeds_has_the_quantiles_of_resampled_means():
    """The distribution is nearly continuous, so it shows the level: 95%."""
    values = np.random.default_rng(0).normal(size=40)
    chosen = np.sort(np.random.default_rng(1).choice(values, (20_000, 40)), axis=1)
    low, high = np.quantile(chosen[:, 10:30].mean(axis=1), [0.025, 0.975])
    summary = summarise(values)
    found = summary.iqm_low, summary.iqm_high
    assert found == pytest.approx((low, high), abs=0.05 * (high - low))


def test_interval_narrows_with_more_seeds():
    values = np.random.default_rng(1).normal(size=64)
    few, many = summarise(values[:8]), summarise(values)
    assert many.iqm_high - many.iqm_low < few.iqm_high - few.iqm_low


def test_the_same_values_always_give_the_same_summary():
    values = np.random.default_rng(2).normal(size=7)
    assert summarise(values) == summarise(values)


def test_the_order_of_seeds_does_not_change_the_interval():
    values = np.random.default_rng(2).normal(size=7)
    first, second = summarise(values), summarise(values[::-1])
    assert (first.iqm_low, first.iqm_high) == (second.iqm_low, second.iqm_high)


def test_mean_and_sample_standard_deviation():
    summary = summarise([1.0, 2.0, 6.0])
    assert (summary.n, summary.mean) == (3, 3.0)
    assert summary.std == pytest.approx(math.sqrt((4 + 1 + 9) / 2))


def test_a_single_seed_has_neither_deviation_nor_interval():
    summary = summarise([5.0])
    assert (summary.mean, summary.iqm) == (5.0, 5.0)
    assert all(math.isnan(v) for v in (summary.std, summary.iqm_low, summary.iqm_high))


def test_equal_seeds_have_an_interval_of_no_width():
    summary = summarise([2.0] * 5)
    assert (summary.iqm_low, summary.iqm_high, summary.std) == (2.0, 2.0, 0.0)


def test_failed_seeds_are_dropped_and_counted():
    summary = summarise([1.0, math.nan, 3.0, -math.inf])
    assert (summary.n, summary.failed, summary.mean) == (2, 2, 2.0)


def test_no_finished_seed_gives_nan():
    summary = summarise([math.nan, math.nan])
    assert (summary.n, summary.failed) == (0, 2)
    assert math.isnan(summary.mean) and math.isnan(summary.iqm)


def test_seed_means_average_episodes_within_each_seed():
    means = seed_means(episodes({0: [1, 3], 1: [10]}))
    assert means[["seed", "return", "true_return"]].values.tolist() == [[0, 2, 3], [1, 10, 11]]


def test_seed_means_keep_cells_apart():
    first = episodes({0: [1]})
    second = first.assign(**{"history_length": 3, "return": np.float32(7)})
    means = seed_means(pd.concat([first, second]))
    assert means.set_index("history_length")["return"].to_dict() == {0: 1.0, 3: 7.0}


def test_a_seed_with_one_nan_episode_has_a_nan_mean():
    means = seed_means(episodes({0: [1, math.nan], 1: [4]}))
    assert means["return"].isna().tolist() == [True, False]


def test_seed_means_do_not_lose_precision():
    # In float32 the running sum of these would stall.
    means = seed_means(episodes({0: [2.0**24] + [1.0] * 63}))
    assert means["return"].iloc[0] == (2.0**24 + 63) / 64


def test_a_long_curve_is_resampled_in_blocks_with_the_same_bits(monkeypatch):
    values = np.random.default_rng(3).normal(size=(3, 150))
    values[0, 7], values[:2, 9], values[:, 11] = np.nan, np.nan, np.nan
    real, sizes = statistics._bootstrap_interval, []
    monkeypatch.setattr(
        statistics, "_bootstrap_interval", lambda own: (sizes.append(own.shape[1]), real(own))[1]
    )
    found = iqm_bands(values)
    assert max(sizes) == 64 and sum(sizes) == 148
    monkeypatch.setattr(statistics, "_BLOCK", 1_000)
    for one, other in zip(found, iqm_bands(values), strict=True):
        np.testing.assert_array_equal(one, other)


def test_probability_of_improvement_counts_pairs_and_half_ties():
    # Pairs: 1>0, 1=1 (half), 2>0, 2>1.
    assert probability_of_improvement([1, 2], [0, 1]) == 3.5 / 4


@given(st.lists(returns, min_size=1, max_size=8), st.lists(returns, min_size=1, max_size=8))
def test_probability_of_improvement_is_complementary(x, y):
    both = probability_of_improvement(x, y) + probability_of_improvement(y, x)
    assert both == pytest.approx(1.0)


def test_probability_of_improvement_leaves_failed_seeds_out():
    assert probability_of_improvement([1.0, math.nan], [0.0]) == 1.0


def test_probability_of_improvement_over_nothing_is_nan():
    assert math.isnan(probability_of_improvement([math.nan], [0.0]))
