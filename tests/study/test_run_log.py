"""Tests the reading of a log that grows."""

import json

from rtd3jax.study import log
from rtd3jax.study.log import LoggedReturns, append_rows

LANE = {"env": "rover", "disturbance": "none", "algorithm": "td3", "history_length": 0, "seed": 0}
KEY = tuple(LANE.values())


def test_each_line_of_a_log_that_grows_is_read_once_and_the_last_return_counts(
    tmp_path, monkeypatch
):
    """A process that trains one lane after the other would read the whole log for each lane."""
    path, real, read = tmp_path / "log.jsonl", log.parse_log, []
    monkeypatch.setattr(log, "parse_log", lambda text: (read.append(text), real(text))[1])
    logged = LoggedReturns(path)
    assert logged.update() == {}
    append_rows(path, [{**LANE, "step": step, "return": -1.0 * step} for step in (1, 2)])
    assert logged.update() == {(*KEY, 1): -1.0, (*KEY, 2): -2.0}
    append_rows(path, [{**LANE, "step": 2, "return": -5.0}])
    with path.open("a") as file:
        file.write(json.dumps({**LANE, "step": 3, "return": -3.0}))  # SIGKILL cut off its end
    expected = {(*KEY, 1): -1.0, (*KEY, 2): -5.0, (*KEY, 3): -3.0}
    assert logged.update() == LoggedReturns(path).update() == expected
    assert path.read_text().endswith("}\n")
    assert [text.count("\n") for text in read] == [2, 2, 4]
