"""Tests that impossible configurations raise one line with the name of the field."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rtd3jax as rtd


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algorithm": "lstm-td3-1ha1h"}, "did you mean 'lstm-td3-1ha1hc'"),
        ({"precision": "float16"}, "precision 'float16' is unknown.*float32 or bfloat16"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        ({"total_steps": -3}, "total_steps must be at least 1"),
        ({"total_steps": 2.5}, "total_steps must be an integer"),
        ({"history_length": 0}, "history_length must be at least 1"),
        ({"gamma": 1.5}, "gamma must be between 0 and 1"),
        ({"tau": math.nan}, "tau must be a number"),
        ({"hidden_size": True}, "hidden_size must be an integer"),
        ({"actor_learning_rate": "fast"}, "actor_learning_rate must be a number"),
        ({"batch_size": 2_000}, "batch_size .2000. is larger than learning_starts"),
        ({"replay_capacity": 50}, "replay_capacity .50. holds less"),
        ({"eval_every": 2**31}, "eval_every must be below"),
    ],
)
def test_impossible_values_are_named(change, message):
    with pytest.raises(rtd.UserError, match=message) as error:
        rtd.Config(**change)
    assert "\n" not in str(error.value)


def test_a_history_length_on_td3_warns():
    with pytest.warns(UserWarning, match="td3 has no window"):
        assert rtd.Config(algorithm="td3", history_length=5).history_length == 0


def test_a_resolved_configuration_is_a_fixed_point():
    config = rtd.Config(algorithm="h-td3")
    assert dataclasses.replace(config) == config and config.replay_capacity == config.total_steps


@given(
    st.dictionaries(
        st.sampled_from([f.name for f in dataclasses.fields(rtd.Config)]),
        st.one_of(
            st.integers(), st.floats(), st.text(max_size=4), st.none(), st.booleans(), st.just([1])
        ),
    )
)
def test_anything_is_accepted_or_named_in_one_line(values):
    try:
        config = rtd.Config(**values)
    except rtd.UserError as error:
        assert "\n" not in str(error)
    else:
        assert config.batch_size <= config.learning_starts
