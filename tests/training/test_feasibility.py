"""Tests warnings for configurations that will not train their networks."""

import warnings

import pytest

import rtd3jax as rtd
from rtd3jax.study.cells import Grid, cell_jobs, make_cells
from rtd3jax.training.feasibility import updates_of, why_untrained
from rtd3jax.training.jobs import make_jobs

SMALL = {"algorithm": "td3", "batch_size": 8, "learning_starts": 20}


def config(**changes):
    return rtd.Config(**{**SMALL, **changes})


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"total_steps": 20}, r"total_steps \(20\) is not more than learning_starts \(20\)"),
        ({"total_steps": 900, "learning_starts": 1_000}, "there will be no update"),
        (
            {
                "total_steps": 1_008,
                "learning_starts": 1_000,
                "environments": 16,
                "eval_every": 1_008,
            },
            r"is not more than learning_starts \(1,000, which becomes 1,008\)",
        ),
        ({"total_steps": 21}, r"policy_delay \(2\) is more than the 1 critic updates"),
        ({"total_steps": 40, "update_every": 20}, "lower policy_delay or update_every"),
        ({"total_steps": 40, "policy_delay": 30}, "policy_delay .30. is more than the 20"),
        ({"actor_learning_rate": 0}, "actor_learning_rate is 0"),
        ({"critic_learning_rate": 0}, "critic_learning_rate is 0"),
        ({"tau": 0}, "tau is 0, so the target networks"),
        ({"reward_scale": 0}, "all rewards in updates will be 0"),
        ({"freeze": "actor,critics"}, "freeze names the actor and the critics"),
    ],
)
def test_it_is_said(changes, match):
    with pytest.warns(UserWarning, match=match):
        make_jobs(rtd.make("rover"), config(**changes), [0])


def test_a_sweep_says_it_too():
    grid = Grid("rover", ("ar1-slip",), ("td3",), (1,))
    with pytest.warns(UserWarning, match="td3: total_steps .900. is not more"):
        cell_jobs(make_cells([grid], {"total_steps": 900}), [0], "map")


@pytest.mark.parametrize(
    "changes",
    [
        {"total_steps": 22},
        {"total_steps": 23, "update_every": 2},
        {"total_steps": 40},
        {"total_steps": 40, "freeze": "actor", "actor_learning_rate": 0},
        {"total_steps": 40, "freeze": "critics", "critic_learning_rate": 0},
    ],
)
def test_what_trains_is_silent(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_jobs(rtd.make("rover"), config(**changes), [0])


def test_updates_are_counted_as_the_loop_makes_them():
    """The loop's own condition, step by step."""
    for total in range(18, 40):
        for every in (1, 3):
            for delay in (1, 2, 5):
                c = config(total_steps=total, update_every=every, policy_delay=delay)
                since = [step - 20 for step in range(total) if step >= 20]
                due = [s // every + 1 for s in since if s % every == 0]
                assert updates_of(c) == (len(due), sum(n % delay == 0 for n in due))
                assert (why_untrained(c) is None) == (updates_of(c)[1] > 0)
