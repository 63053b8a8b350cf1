"""Tests the error messages of configurations that cannot be read."""

import json

import pytest

import rtd3jax as rtd
from rtd3jax.study.cells import Cell
from rtd3jax.study.contents import Contents


def _config(path, **changes):
    cell = Cell("rover", "ar1-slip", rtd.Config("td3")).to_dict()
    study = {"cells": [{**cell, **changes}], "seeds": [0], "final_episodes": 1}
    path.write_text(json.dumps({"format": 2, "study": study}))
    return path


def test_an_agent_that_is_not_registered_here_is_named_with_the_remedy(tmp_path):
    path = _config(tmp_path / "config.json", algorithm="my-own-td3")
    with pytest.raises(rtd.UserError, match="my-own-td3.*register it.*--import"):
        Contents.read(path)
    path = _config(tmp_path / "config.json", memory="my-own-cell")
    with pytest.raises(rtd.UserError, match="my-own-cell.*register it"):
        Contents.read(path)


def test_an_impossible_value_says_why(tmp_path):
    path = _config(tmp_path / "config.json", gamma=2.0)
    with pytest.raises(rtd.UserError, match="is not a study's configuration: gamma must be"):
        Contents.read(path)


def test_a_field_of_another_version_is_named_with_this_version(tmp_path):
    path = _config(tmp_path / "config.json", colour="red")
    with pytest.raises(rtd.UserError, match="does not know the field 'colour'$"):
        Contents.read(path)
    content = json.loads(path.read_text())
    made_with = [{"made_with": {"versions": {"rtd3jax": version}}} for version in ("7.1", "7.2")]
    path.write_text(json.dumps(content | made_with[0]))
    with pytest.raises(rtd.UserError, match="'colour'; version 7.1 wrote it: install that"):
        Contents.read(path)
    path.write_text(json.dumps(content | made_with[0] | {"grown": made_with[1:]}))
    with pytest.raises(rtd.UserError, match="'colour'; version 7.2 wrote it"):
        Contents.read(path)


def test_what_is_no_study_says_so(tmp_path):
    path = _config(tmp_path / "config.json", history_length=[])
    path.write_text(json.dumps({"format": 2, "study": {"cells": 3}}))
    with pytest.raises(rtd.UserError, match="is not a study's configuration"):
        Contents.read(path)
