"""Tests the jobs that the cells of a study make."""

from rtd3jax.study.cells import Grid, cell_jobs, make_cells


def test_side_by_side_an_environment_has_the_windows_of_its_own_longest():
    settings = {"total_steps": 40, "learning_starts": 10, "batch_size": 4, "hidden_size": 4}
    grids = [
        Grid("rover", ("none",), ("lstm-td3",), (1, 2), settings),
        Grid("pendulum", ("none",), ("lstm-td3",), (3, 5), settings),
    ]
    for strategy, tokens in (("vmap", [2, 2, 5, 5]), ("map", [1, 2, 3, 5])):
        jobs = cell_jobs(make_cells(grids, {}), [0], strategy)
        assert [job.program.window_tokens for job in jobs] == tokens


def test_a_window_is_not_longer_for_cells_that_cannot_share_its_program():
    settings = {"learning_starts": 64, "batch_size": 4, "hidden_size": 4, "environments": 16}
    settings |= {"total_steps": 640, "eval_every": 640, "replay_capacity": 64}
    grids = [
        Grid("rover", ("none",), ("lstm-td3",), (1, 2), settings),
        Grid("rover", ("none",), ("h-td3",), (39,), {**settings, "replay_capacity": 640}),
        Grid("rover", ("none",), ("lstm-td3",), (1,), {**settings, "gamma": 0.5}),
        Grid("rover", ("sine-slip",), ("lstm-td3",), (7,), {**settings, "replay": "segments"}),
    ]
    grids[-1].settings["replay_capacity"] = 640
    jobs = cell_jobs(make_cells(grids, {}), [0], "vmap")
    assert [job.program.window_tokens for job in jobs] == [2, 2, 39, 2, 7]
