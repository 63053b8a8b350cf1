"""Tests which ceilings a study stores, and of which return."""

import rtd3jax as rtd
from rtd3jax.study import ceilings


def _cells(*disturbances):
    return [rtd.Cell("pendulum", name, rtd.Config("td3")) for name in disturbances]


def test_under_a_disturbed_reward_the_ceiling_is_that_of_the_true_return(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "rtd3jax.envs.pendulum.optimum.mean_optimal_return", lambda _: (-137.0, 0.2)
    )
    cells = _cells("none", "noise", "noise:reward_from=state")
    found = ceilings.ceilings_of(tmp_path, cells, compute=True)
    none, noise, rewarded = (found["pendulum", cell.disturbance] for cell in cells)
    assert none == {"mean": -137.0, "error": 0.2, "kind": "exact", "measure": "return"}
    assert noise == {**none, "kind": "upper bound", "measure": "true_return"}
    assert rewarded == {**none, "kind": "upper bound"}
    assert ceilings.ceilings_of(tmp_path, cells, compute=False) == found


def test_ceilings_of_a_study_that_is_read_only_are_computed(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "rtd3jax.envs.pendulum.optimum.mean_optimal_return", lambda _: (-137.0, 0.2)
    )

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(ceilings, "write_bytes_atomically", refuse)
    found = ceilings.ceilings_of(tmp_path, _cells("none"), compute=True)
    assert found["pendulum", "none"]["mean"] == -137.0 and not list(tmp_path.iterdir())
