"""A real Chromium and its tabs; tests that import this are skipped without playwright."""

import shutil
import time
from contextlib import contextmanager

import pytest

pytest.importorskip(
    "playwright.sync_api", reason="needs playwright (165 MB): pip install playwright"
)

from playwright.sync_api import sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
PATIENCE_MS = 30_000
MARKS = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium"),
]


@contextmanager
def open_browser():
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=ARGS)
        yield browser
        browser.close()


class Tab:
    """A page in the browser, and what it asked for and complained of."""

    def __init__(self, browser, **options):
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.asked, self.said = [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(f"uncaught: {error}"))

    def has(self, expression):
        # Not wait_for_function: the page's policy forbids what that evaluates inside the page.
        self._await(expression, lambda: self.page.evaluate(expression))

    def shows(self, selector, text):
        self._await((selector, text), lambda: text in (self.text(selector) or ""))

    def _await(self, what, condition):
        end = time.monotonic() + PATIENCE_MS / 1000
        while not condition():
            assert time.monotonic() < end, (what, self.said)
            self.page.wait_for_timeout(50)

    def text(self, selector):
        return self.page.locator(selector).text_content()

    def faults(self):
        """Of the page itself; a connection that is refused is the daemon's restart."""
        return [
            s for s in self.said if "uncaught" in s or "Content Security" in s or "Trusted" in s
        ]
