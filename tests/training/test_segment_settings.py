"""Tests that impossible settings of segments and carries are refused before compilation."""

import warnings

import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.study.cells import Grid, cell_jobs, make_cells
from rtd3jax.training.jobs import make_jobs


@pytest.mark.parametrize(
    "fields, line",
    [
        (dict(segment_length=7), r"segment_length \(7\) does not divide batch_size \(100\)"),
        (dict(segment_length=0), "segment_length must be at least 1"),
        (dict(segment_length=-5), "segment_length must be at least 0"),
        (dict(segment_length=2.5), "segment_length must be an integer"),
        (
            dict(segment_length=50, replay_capacity=40, batch_size=50),
            r"segment_length \(50\) is longer than the replay \(40\)",
        ),
        (dict(replay="segment"), "did you mean 'segments'"),
        (dict(replay=None), "replay None is unknown"),
        (dict(replay="windows", segment_length=10), "needs replay='segments'"),
        (dict(acting="carries"), "acting 'carries' is unknown; did you mean 'carry'"),
        (dict(burn_in_gradient="yes"), "burn_in_gradient must be True or False"),
    ],
)
def test_a_wrong_value_is_one_line(fields, line):
    with pytest.raises(rtd.UserError, match=line):
        rtd.Config(**{"replay": "segments", **fields})


def test_a_segment_is_not_longer_than_an_episode():
    env = rtd.make("rover", "ar1-slip", max_steps_in_episode=20)
    config = rtd.Config(replay="segments", segment_length=25)
    with pytest.raises(rtd.UserError, match=r"longer than any episode \(20 steps\)"):
        make_jobs(env, config, [0])


def test_a_carry_beyond_the_windows_is_warned_of():
    with pytest.warns(UserWarning, match="trained on windows has never seen a carry older"):
        rtd.Config(acting="carry")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rtd.Config(replay="segments").acting_mode == "carry"
        assert rtd.Config(replay="segments", acting="window").acting_mode == "window"
        config = rtd.Config("td3", replay="segments", segment_length=10, acting="carry")
        assert (config.replay, config.acting_mode, config.segment_steps) == ("windows", "window", 0)


@pytest.mark.parametrize("batch_size, length", [(100, 10), (50, 10), (8, 8), (14, 7), (13, 1)])
def test_the_default_length_divides_the_batch(batch_size, length):
    for kind in (int, float, np.int64):
        config = rtd.Config(replay="segments", batch_size=kind(batch_size))
        assert (config.batch_size, config.segment_steps) == (batch_size, length)


def test_a_gradient_of_the_burn_in_without_a_burn_in_is_a_warning():
    with pytest.warns(UserWarning, match="burn_in_gradient=True has no effect: windows have no"):
        rtd.Config("lstm-td3", burn_in_gradient=True)


def test_a_training_does_not_repeat_the_warnings_of_its_configuration():
    with pytest.warns(UserWarning, match="burn_in_gradient=True"):
        config = rtd.Config("lstm-td3", burn_in_gradient=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert make_jobs(rtd.make("rover", "none"), config, [0])[0].program.config.burn_in_gradient


def test_cells_of_a_sweep_give_a_warning_once_in_all():
    grid = Grid("rover", ("none", "ar1-slip"), ("td3", "lstm-td3"), (1, 3))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")  # Python's own, by which a line is shown once
        jobs = cell_jobs(make_cells([grid], {"burn_in_gradient": True}), [0], "vmap")
    assert len(jobs) == 6
    assert [str(one.message).split()[0] for one in caught] == ["burn_in_gradient=True"]
