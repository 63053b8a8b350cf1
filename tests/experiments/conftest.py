"""What tests of the experiments' scripts share."""

import sys

import pytest


@pytest.fixture
def leave_the_path_alone(monkeypatch):
    """Scripts put their directory into the path; it does not stay there."""
    monkeypatch.setattr(sys, "path", list(sys.path))
