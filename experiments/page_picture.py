"""Takes the README's picture of a study's page: its beginning, in headless Chromium.

Usage: python experiments/page_picture.py RUN PNG

The script writes the page of the run directory RUN again and photographs it. It needs Playwright
(`pip install '.[test]'`) and Chromium.
"""

import argparse
import pathlib
import shutil

from playwright.sync_api import sync_playwright

from rtd3jax.study.report.page import write_page
from rtd3jax.study.rundir import RunDirectory

SIZE = {"width": 1100, "height": 1260}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("png", type=pathlib.Path)
    options = parser.parse_args(arguments)
    page_file = write_page(RunDirectory.open(options.run))
    with sync_playwright() as playwright:
        path = shutil.which("chromium")  # without it, Playwright takes its own
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        page.goto(page_file.resolve().as_uri())
        page.wait_for_timeout(1_000)  # the charts are drawn
        page.screenshot(path=options.png)
        browser.close()


if __name__ == "__main__":
    main()
