"""Tests of the Markdown summary."""

import math

import pandas as pd

from rtd3jax.study.derive import _values_and_owners
from rtd3jax.study.results import CELL
from rtd3jax.study.statistics import summarise
from rtd3jax.study.summary import summary_markdown


def rows(algorithm, length, returns, disturbance="none", offset=0.0):
    """One episode per seed; the true return is ``offset`` above the return."""
    return [
        {
            "env": "pendulum",
            "disturbance": disturbance,
            "algorithm": algorithm,
            "history_length": length,
            "seed": seed,
            "episode": 0,
            "return": value,
            "true_return": value + offset,
        }
        for seed, value in enumerate(returns)
    ]


def failure(algorithm="td3", length=0, seed=0, reason="loss is nan", step=400):
    return {
        "env": "pendulum",
        "disturbance": "none",
        "algorithm": algorithm,
        "history_length": length,
        "seed": seed,
        "step": step,
        "reason": reason,
    }


def render(episode_rows, failures=(), planned=None, config=None):
    """The summary; by default, the study has the lanes of the episodes and failures."""
    episodes = pd.DataFrame(episode_rows, columns=list(rows("td3", 0, [0.0])[0]))
    if planned is None:
        planned = {}
        for row in [*episode_rows, *failures]:
            if row["seed"] >= 0:
                cell = tuple(row[name] for name in CELL)
                planned.setdefault(cell, set()).add(row["seed"])
    return summary_markdown(config or {}, planned, episodes, list(failures))


def table(text, heading):
    """Body rows of the table under ``heading``, each a list of cells."""
    section = text.split(f"### {heading}\n")[1].split("\n#")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def header(text):
    return next(line for line in text.splitlines() if line.startswith("| algorithm"))


def test_the_configuration_is_shown_in_order():
    text = render([], config={"steps": 50_000, "batch size": 64})
    assert "- steps: 50000\n- batch size: 64\n" in text


def test_a_row_gives_the_summary_over_seeds():
    values = [1.0, 2.0, 3.0, 6.0]
    expected = summarise(values)
    (row,) = table(render(rows("lstm-td3", 3, values)), "pendulum, none")
    interval = f"2.5 [{expected.iqm_low:.4g}, {expected.iqm_high:.4g}]"
    assert row == ["lstm-td3", "3", "4 / 4", f"3 ± {expected.std:.4g}", interval]


def test_the_best_iqm_comes_first():
    episodes = rows("td3", 0, [-9.0, -9.0]) + rows("lstm-td3", 3, [-1.0, -1.0])
    episodes += rows("h-td3", 5, [-4.0, -4.0])
    names = [row[0] for row in table(render(episodes), "pendulum, none")]
    assert names == ["lstm-td3", "h-td3", "td3"]


def test_references_come_last_however_good_they_are():
    played = rows("constant", 0, [7.0]) + rows("random", 0, [5.0])
    episodes = rows("td3", 0, [-9.0]) + [row | {"seed": -1} for row in played]
    names = [row[0] for row in table(render(episodes), "pendulum, none")]
    assert names == ["td3", "random (reference)", "constant (reference)"]


def test_references_are_averaged_over_their_episodes():
    played = [
        row | {"seed": -1, "episode": episode}
        for episode, row in enumerate(rows("random", 0, [1.0, 3.0]))
    ]
    (row,) = table(render(played), "pendulum, none")
    assert row[3] == "2 ± 1.414"


def test_each_disturbance_has_its_own_table():
    text = render(rows("td3", 0, [1.0]) + rows("td3", 0, [2.0], disturbance="drift"))
    assert table(text, "pendulum, none")[0][3] == "1"
    assert table(text, "pendulum, drift")[0][3] == "2"


def test_the_true_state_return_is_shown_where_it_differs():
    text = render(rows("td3", 0, [1.0, 1.0], offset=5.0))
    assert table(text, "pendulum, none")[0][-1] == "6 ± 0"


def test_the_true_state_return_is_left_out_where_it_agrees():
    assert "true-state" not in header(render(rows("td3", 0, [1.0, 1.0])))


def test_a_cell_known_only_from_a_failure_is_shown_as_missing():
    text = render(rows("td3", 0, [1.0]), [failure("lstm-td3", 5)])
    row = table(text, "pendulum, none")[-1]
    assert row == ["lstm-td3", "5", "0 / 1", "missing", "missing"]


def test_a_cell_of_which_no_lane_has_ended_is_shown_as_missing():
    text = render([], planned={("pendulum", "none", "h-td3", 3): range(2)})
    (row,) = table(text, "pendulum, none")
    assert row == ["h-td3", "3", "0 / 2", "missing", "missing"]


def test_the_counts_include_lanes_that_have_not_ended():
    text = render(rows("td3", 0, [1.0, 2.0]), planned={("pendulum", "none", "td3", 0): range(5)})
    assert table(text, "pendulum, none")[0][2] == "2 / 5"


def test_a_cell_with_only_nan_returns_is_shown_as_missing():
    (row,) = table(render(rows("td3", 0, [math.nan, math.nan])), "pendulum, none")
    assert row[2:] == ["0 / 2", "missing", "missing"]


def test_a_lost_seed_lowers_the_finished_count():
    text = render(rows("td3", 0, [1.0, 2.0]), [failure(seed=7)])
    assert table(text, "pendulum, none")[0][2] == "2 / 3"


def test_a_lost_lane_is_listed_with_its_cell_seed_step_and_reason():
    text = render([], [failure("lstm-td3", 5, seed=2, step=800, reason="critic diverged")])
    lost = text.split("## Lanes lost\n\n")[1]
    assert lost == "- pendulum, none, lstm-td3, l = 5, seed 2, step 800: critic diverged\n"


def test_without_lost_lanes_the_section_says_none():
    assert render(rows("td3", 0, [1.0])).endswith("## Lanes lost\n\nnone\n")


def test_the_order_of_failures_does_not_matter():
    lost = [failure(seed=1), failure(seed=0)]
    assert render([], lost) == render([], lost[::-1])


def test_a_reason_of_several_lines_stays_one_item():
    lost = render([], [failure(reason="first\nsecond | third")]).split("## Lanes lost\n\n")[1]
    assert lost.count("\n") == 1 and "first second \\| third" in lost


def test_an_empty_study_still_has_a_summary():
    assert "No results." in render([])


def test_the_ceiling_is_the_last_row_where_it_is_known():
    columns = list(rows("td3", 0, [0.0])[0])
    episodes = pd.DataFrame(rows("td3", 0, [-3.0]), columns=columns)
    planned = {("pendulum", "none", "td3", 0): [0]}

    def last(best):
        text = summary_markdown({}, planned, episodes, [], {("pendulum", "none"): best})
        return table(text, "pendulum, none")[-1]

    exact = {"mean": -1.206, "error": 0.001, "kind": "exact", "measure": "return"}
    assert last(exact) == ["ceiling", "–", "–", "-1.206 ± 0.001", "–"]
    bound = {"mean": -0.5, "error": 0.0, "kind": "upper bound", "measure": "return"}
    assert last(bound) == ["ceiling (an upper bound)", "–", "–", "-0.5", "–"]
    assert last({"missing": "nobody knows"})[0] == "td3"
    episodes["true_return"] -= 1.0
    of_truth = {**bound, "measure": "true_return"}
    assert last(of_truth) == ["ceiling (an upper bound)", "–", "–", "–", "–", "-0.5"]
    assert last(bound) == ["ceiling (an upper bound)", "–", "–", "-0.5", "–", "–"]


def test_lanes_and_references_with_episodes_without_a_number_say_so():
    """Their other episodes are no fair mean; the reference `random` has one episode per row."""
    trained = rows("td3", 0, [-1.0, -2.0])
    trained += [{**trained[1], "episode": 1, "return": math.inf}]
    reference = [
        {**row, "seed": -1, "episode": row["seed"]} for row in rows("random", 0, [-9.0, math.nan])
    ]
    text = render(trained + reference)
    agent, other = table(text, "pendulum, none")
    assert agent[2:4] == ["1 / 2", "-1"]
    assert other[3] == "1 of 2 episodes diverged"
    listed = text.split("## Lanes without a mean return\n\n")[1]
    assert listed.startswith("- pendulum, none, td3, l = 0, seed 1: 1 of 2 final episodes")
    assert "Lanes without a mean return" not in render(rows("td3", 0, [1.0]))


def test_fields_in_which_cells_differ_have_their_owners():
    def cells(env, algorithms, **fields):
        return [{"env": env, "algorithm": algorithm, **fields} for algorithm in algorithms]

    agents = ("td3", "h-td3")
    found = cells("rover", agents, gamma=0.0) + cells("pendulum", agents[:1], gamma=0.9)
    found += cells("pendulum", agents[1:], gamma=0.99)
    said = "0.0 (rover); 0.9 (pendulum: td3); 0.99 (pendulum: h-td3)"
    assert _values_and_owners("gamma", found) == said
    assert _values_and_owners("gamma", found[2:]) == "0.9 (td3); 0.99 (h-td3)"
