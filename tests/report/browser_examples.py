"""A browser for pages; a test module uses it by pytest_plugins = ["browser_examples"].

Not in a conftest.py of this folder: that would hide tests/conftest.py from all that import from it.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """The system's Chromium, of Playwright's sync API; the test is skipped where package or browser are absent."""
    api = pytest.importorskip("playwright.sync_api", reason="pages are tested with Playwright: pip install playwright")
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"pages are tested in a browser; none of {', '.join(NAMES)} is here")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def open_page(browser: Any) -> Callable[..., AbstractContextManager[Any]]:
    """Opens a page: `with open_page(path, width=1280, **more) as page`; more is of Playwright's contexts."""
    return partial(opened_page, browser)


@contextmanager
def opened_page(browser: Any, path: Path, width: int = 1280, **more: Any) -> Iterator[Any]:
    """A page from disk without a network; errors and requests fail the test."""
    context = browser.new_context(viewport={"width": width, "height": 900}, **more)
    context.set_offline(True)
    page = context.new_page()
    wrong: list[str] = []
    page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda asked: None if asked.url.startswith(("file:", "data:")) else wrong.append(asked.url))
    page.goto(path.as_uri())
    yield page
    context.close()
    assert wrong == []
