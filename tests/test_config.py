"""Tests that impossible configurations raise one line with the name of the field."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rtd3jax as rtd
from rtd3jax.cli.sweep_options import overrides, parser


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
        ({"replay_capacity": 50}, "replay_capacity .50. holds less.*; raise replay_capacity"),
        (
            {"total_steps": 50},
            "replay_capacity .50. holds less.*; raise total_steps .50., which it",
        ),
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
    assert dataclasses.replace(config) == config and config.capacity == config.total_steps


def test_the_replay_is_as_large_as_the_training_unless_it_is_told_its_size():
    config = rtd.Config(total_steps=2_000)
    longer = dataclasses.replace(config, total_steps=50_000)
    assert (config.capacity, longer.capacity) == (2_000, 50_000)
    told = dataclasses.replace(rtd.Config(replay_capacity=3_000), total_steps=50_000)
    assert told.capacity == 3_000
    read = rtd.Config.from_dict(config.to_dict())
    assert config.to_dict()["replay_capacity"] == 2_000
    assert dataclasses.replace(read, total_steps=50_000).capacity == 50_000


def test_the_actor_starts_with_learning_unless_it_is_told_when():
    config = rtd.Config()
    later = dataclasses.replace(config, learning_starts=5_000)
    assert (config.first_actor_step, later.first_actor_step) == (1_000, 5_000)
    assert later.updates_before_the_actor == 0
    told = dataclasses.replace(rtd.Config(actor_starts=1_000), learning_starts=500)
    assert told.first_actor_step == 1_000 and told.updates_before_the_actor == 500
    # With 16 environments, the first update is after step 1,024.
    fields = dict(learning_starts=1_009, actor_starts=1_024, eval_every=992)
    many = rtd.Config(environments=16, **fields)
    assert many.updates_before_the_actor == 0
    # The first round with updates of the actor is the first one that follows its step.
    fields = dict(learning_starts=1_008, actor_starts=1_009, eval_every=992)
    late = rtd.Config(environments=16, update_every=1, total_steps=30_000, **fields)
    assert late.updates_before_the_actor == 16


@pytest.mark.parametrize(
    "given", [{}, {"actor_starts": 3_000}, {"learning_starts": 2_000}, {"replay_capacity": 9_000}]
)
def test_a_configuration_is_read_as_it_was_written(given):
    config = rtd.Config(**given)
    fields = config.to_dict()
    assert fields["actor_starts"] == config.first_actor_step  # a number, as it always was
    assert rtd.Config.from_dict(fields) == config
    del fields["actor_starts"]  # of before there was the field
    assert rtd.Config.from_dict(fields).actor_starts is None


def test_defaults_of_windows_do_not_stay_with_segments():
    windows, segments = rtd.Config(), rtd.Config(replay="segments")
    assert dataclasses.replace(windows, replay="segments") == segments
    assert dataclasses.replace(segments, replay="windows") == windows
    assert (segments.acting_mode, segments.segment_steps) == ("carry", 10)
    assert dataclasses.replace(segments, batch_size=64).segment_steps == 8
    chosen = rtd.Config(replay="segments", acting="window", segment_length=5)
    assert (chosen.acting_mode, chosen.segment_steps) == ("window", 5)
    for config in (windows, segments, chosen):
        assert rtd.Config.from_dict(config.to_dict()) == config
    changed = rtd.Config.from_dict({**windows.to_dict(), "replay": "segments"})
    assert changed.segment_steps == 10
    with pytest.raises(rtd.UserError, match="leave it out, or pass None"):
        dataclasses.replace(chosen, replay="windows")


def test_choices_and_numbers_are_read_from_the_command_line():
    words = "--env rover --precision bfloat16 --replay segments --acting window --gamma 0.5"
    options = parser(None).parse_args([*words.split(), "--segment-length", "5", "--start", "7"])
    found = overrides(options)
    expected = dict(precision="bfloat16", replay="segments", acting="window", gamma=0.5)
    assert found == {**expected, "segment_length": 5, "start": "7"}
    with pytest.raises(rtd.UserError, match="acting 'widow' is unknown; did you mean 'window'"):
        rtd.Config(acting="widow")


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
