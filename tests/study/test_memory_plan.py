"""Compares the memory plan with XLA's reservations, and tests the split of lanes."""

import gc
import time
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.study import memory_plan
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.lanes import advance_groups


def _jobs(seeds=1, **changes):
    changes = {"algorithm": "td3", "total_steps": 2_000, **changes}
    return make_jobs(rtd.make("rover", "ar1-slip"), rtd.Config(**changes), list(range(seeds)))


@pytest.mark.parametrize(
    ("algorithm", "length", "replay"),
    [
        ("lstm-td3-1ha1hc", 8, "windows"),
        ("lstm-td3-1ha2hc", 20, "segments"),
        pytest.param("h-td3", 8, "windows", marks=pytest.mark.slow),
        pytest.param("h-td3", 20, "segments", marks=pytest.mark.slow),
    ],
)
def test_the_plan_is_within_15_percent_of_what_xla_reserves(algorithm, length, replay):
    changes = dict(algorithm=algorithm, history_length=length, replay=replay)
    (job,) = _jobs(**changes, total_steps=10_000)
    state = jax.eval_shape(job.program.init, job.lane)
    step = jax.ShapeDtypeStruct((), jnp.int32)
    advance = jax.jit(job.program.advance, donate_argnums=1)
    options = {"xla_cpu_multi_thread_eigen": False}
    used = advance.lower(job.lane, state, step, step).compile(options).memory_analysis()
    kept, work = memory_plan.job_bytes([job])[job.executable]
    assert abs(kept / used.output_size_in_bytes - 1) < 0.01
    assert abs((kept + work) / (used.output_size_in_bytes + used.temp_size_in_bytes) - 1) < 0.15


def test_lanes_that_do_not_fit_wait_for_their_turn():
    jobs = _jobs(seeds=10)
    kept, work = memory_plan.job_bytes(jobs)[jobs[0].executable]
    need = (5 * kept + 2 * work) / 0.8
    assert memory_plan.lanes_at_once(jobs, "map", 2, int(need) + 1) == 4
    assert memory_plan.lanes_at_once(jobs, "vmap", 2, int(3.5 * (kept + work) / 0.8)) == 3
    assert [g.wave for g in make_groups(jobs, "map", 2, 4)] == [0] * 4 + [1] * 4 + [2] * 2
    groups = make_groups(jobs, "vmap", 1, 4)
    assert [len(g.jobs) for g in groups] == [4, 4, 2] and [g.wave for g in groups] == [0, 1, 2]
    with pytest.raises(rtd.UserError, match="one lane needs .* lower replay_capacity"):
        memory_plan.lanes_at_once(jobs, "map", 2, kept)


def test_a_small_limit_leaves_room_for_the_process(monkeypatch):
    """With 3 GB four replays of 410 MB were planned, a fifth comes and goes: it was killed."""
    for limit, lanes in ((3_000_000_000, 1_794_137_600), (64_000_000_000, 51_200_000_000)):
        monkeypatch.setattr(memory_plan, "memory_limit", lambda limit=limit: limit)
        assert abs(0.8 * memory_plan.usable_memory() - lanes) < 2
    monkeypatch.setattr(memory_plan, "memory_limit", lambda: 10**9)
    assert memory_plan.usable_memory() == 0


def test_a_wave_begins_when_the_one_before_is_recorded():
    """Recording takes a while: workers that went on had all lanes in memory at the same time."""
    jobs = _jobs(
        seeds=6, hidden_size=4, batch_size=4, learning_starts=8, total_steps=24, eval_every=24
    )
    groups = make_groups(jobs, "map", 2, 2)
    in_memory = []

    def record(group):
        if group.finished and group.state is not None:
            time.sleep(0.3)
            in_memory.append(sum(other.state is not None for other in groups))
            group.state = None

    advance_groups(groups, record, devices=[jax.devices()[0]] * 2)
    assert all(group.finished and group.error is None for group in groups)
    assert len(in_memory) == 6 and max(in_memory) <= 2


@pytest.mark.slow
def test_chunks_give_the_same_results():
    jobs = _jobs(
        seeds=2, hidden_size=4, batch_size=4, learning_starts=8, total_steps=24, eval_every=12
    )
    found = {}
    for at_once in (None, 1):
        for strategy in ("map", "vmap"):
            groups = make_groups(jobs, strategy, 1, at_once)
            advance_groups(groups, lambda group: None)
            found[strategy, at_once] = {
                job.seed: state.returns for g in groups for job, state in g.lanes()
            }
    for (strategy, _), returns in found.items():
        for seed, curve in returns.items():
            exact = found[strategy, None][seed]
            assert jnp.allclose(curve, exact, rtol=0 if strategy == "map" else 1e-4)


def test_the_plan_counts_a_recording_which_the_lanes_of_a_cell_share():
    log = np.zeros((250_000, 2), np.float32)
    env = rtd.disturb(rtd.make("rover"), rtd.Recorded(log))
    jobs = make_jobs(env, rtd.Config("td3", total_steps=2_000), [0, 1])
    without, _ = memory_plan.job_bytes(_jobs())[_jobs()[0].executable]
    kept, _ = memory_plan.job_bytes(jobs)[jobs[0].executable]
    assert 0 <= kept - without - log.nbytes < 1_000
    one, other = (jax.tree.leaves(job.lane.env_params) for job in jobs)
    assert all(a is b for a, b in zip(one, other, strict=True))


def test_the_plan_does_not_keep_a_lane_in_memory():
    (job,) = _jobs()
    memory_plan.job_bytes([job])
    gone = weakref.ref(job)
    del job
    gc.collect()
    assert gone() is None


def test_the_plan_looks_at_every_disturbance_of_an_environment():
    """The program of two recordings is the same, so the later one does not hide the earlier one."""
    envs = [
        rtd.disturb(rtd.make("rover"), rtd.Recorded(np.zeros((rows, 2), np.float32)))
        for rows in (250_000, 300)
    ]
    jobs = [job for env in envs for job in make_jobs(env, rtd.Config("td3"), [0])]
    sizes = [kept for kept, _ in memory_plan.job_bytes(jobs).values()]
    assert len(sizes) == 2 and max(sizes) - min(sizes) > 1_900_000
