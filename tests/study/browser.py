"""A headless Chromium for the tests of the page; without one, a test is skipped."""

import contextlib
import shutil
import subprocess
import sys

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextlib.contextmanager
def chromium():
    """A started browser of Playwright.

    One that the system has is taken; where it has none, Playwright is asked to fetch its own. The
    test is skipped, with the reason, where neither can be had.
    """
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    with sync_api.sync_playwright() as playwright:
        if path is None:
            path = _fetched(playwright)
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


def _fetched(playwright):
    path = playwright.chromium.executable_path
    if not shutil.which(path):
        command = [sys.executable, "-m", "playwright", "install", "--only-shell", "chromium"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=60)
        except (subprocess.SubprocessError, OSError) as error:
            pytest.skip(f"no Chromium here, and Playwright could not fetch one ({error})")
        return None
    return path
