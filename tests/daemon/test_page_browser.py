"""The page in a real Chromium: live, alone, by itself back after a restart, and deaf to markup."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from bench.daemon.process import free_port
from tactile_rt.classifier.classifier import Classification
from tactile_rt.daemon.config import PageConfig
from tactile_rt.daemon.items import Decision, Event, Opened, SourceChunk
from tactile_rt.daemon.page import Page
from tactile_rt.daemon.states import Diagnostic, ModelState, PartState, Snapshot, SourceState
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.browser import MARKS, Tab, open_browser
from tests.helpers.daemons import load_checked, running_daemon

TOKEN = "correct horse battery"
EVIL = "<img src=x onerror=\"document.title='owned'\">"

pytestmark = MARKS


@pytest.fixture(scope="module")
def chromium():
    with open_browser() as browser:
        yield browser


@pytest.fixture
def tab(chromium):
    tabs = []

    def make(**options):
        tabs.append(Tab(chromium, **options))
        return tabs[-1]

    yield make
    for one in tabs:
        one.context.close()


@pytest.fixture
def port():
    return free_port()


@pytest.fixture
def configured(port, tmp_path):
    """Load a configuration with a page."""
    more = f'[page]\nport = {port}\n[log]\nfile = "log"\n'
    return lambda text: load_checked(tmp_path, f"version = 1\n{text}{more}")


LIVE = "+document.getElementById('link').dataset.rate > 0"


def test_it_shows_live_data_and_comes_back_after_a_restart(tab, port, configured):
    loaded = configured(
        '[[source]]\nname = "first"\nurl = "synthetic:30x6"\n'
        '[[source]]\nname = "second"\nurl = "synthetic:5x2?rate_hz=50"\n'
    )
    with running_daemon(loaded):
        one = tab()
        one.page.goto(f"http://127.0.0.1:{port}/")
        one.has(LIVE)
        assert "30 elements × 6 channels, 1000 Hz" in one.text("#subtitle")
        one.has("document.getElementById('figures').textContent.includes('Samples per second')")
        assert one.page.locator("#element option").count() == 30
        assert one.page.locator("#recording").is_hidden()
        painted = (
            "(() => { const c = document.getElementById('trace0'); const d = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data; return d.some((v) => v > 0); })()"
        )
        one.has(painted)

        one.page.select_option("#source", "second")
        one.has("document.getElementById('subtitle').textContent.startsWith('5 elements')")
        one.has(LIVE)
    one.has("document.getElementById('banner').textContent.includes('lost')")
    assert one.text("#link") == "not connected"
    with running_daemon(loaded):
        one.has("document.getElementById('banner').textContent.includes('restarted')")
        one.has(LIVE)
        assert "5 elements" in one.text("#subtitle")
    assert all(url.startswith(f"http://127.0.0.1:{port}/") for url in one.asked)
    assert one.faults() == []


def test_without_an_array_it_says_why(tab, port, configured):
    source = '[[source]]\nname = "finger"\nurl = "{}"\n'
    with running_daemon(configured(source.format("serial:/dev/gone?codec=native"))) as daemon:
        one = tab()
        one.page.goto(f"http://127.0.0.1:{port}/")
        one.has("document.getElementById('empty').textContent.includes('/dev/gone: no such port')")
        one.has("document.getElementById('link').textContent === 'connected, no samples'")
        assert one.page.locator("#map-card").is_hidden()
        daemon.reload(configured(source.format("synthetic:3x6")))
        one.has(LIVE)
        assert one.page.locator("#map-card").is_visible()
        assert one.page.locator("#empty-card").is_hidden()
        assert one.faults() == []


class HostileView:
    """A daemon whose every name is markup."""

    SPEC = replace(
        small_spec(), name=EVIL, elements=(EVIL, "b", "c"), channels=(EVIL, "y"), frame=EVIL
    )

    def __init__(self):
        self.part = PartState("source.a", "waiting", EVIL, 1, 1, 1)

    def snapshot(self):
        now = time.monotonic_ns()
        model = replace(self.part, name="model.m")
        return Snapshot(
            EVIL, 1, EVIL, now, time.time_ns(), 7, 0, "degraded", (EVIL,),
            sources=(SourceState(self.part, EVIL, newest_ns=now),),
            models=(ModelState(model, "a", EVIL, labels=(EVIL, "y"), touching=True),),
            diagnostics=(Diagnostic("source.a", EVIL, EVIL, says=EVIL, do=EVIL),),
        )  # fmt: skip

    def streams(self):
        return {"a": Opened("a", self.SPEC, EVIL, ArraySource(self.SPEC, []), 7, 0)}

    def report(self, *event):
        raise AssertionError(event)


class Fed:
    """A page that is fed; also with what a label must not do."""

    def __init__(self, port, **options):
        self.page = Page("page", PageConfig(port=port, **options))
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.feed)

    def __enter__(self):
        self.page.open(HostileView())
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        self.page.close()

    def feed(self):
        spec = HostileView.SPEC
        p = np.array([0.9, 0.1], np.float32)
        while not self.over.wait(0.03):
            now = time.monotonic_ns()
            (chunk,) = cut_chunks(
                np.random.default_rng(0).normal(size=(9, 3, 2)), 300.0, start_ns=now
            )
            made = Classification(
                now - 10**8, now, 2, False, EVIL, (EVIL, "y"), p, 0.001, (EVIL, "y"), 0.9
            )
            self.page.handle(
                [
                    SourceChunk("a", spec, chunk, now, 0),
                    Decision("a", "m", EVIL, made, now, now, 0),
                    Event("source.a", "waiting", EVIL, "error", now, 0),
                ]
            )


def test_names_that_are_markup_stay_text(tab, port):
    with Fed(port):
        one = tab()
        one.page.goto(f"http://localhost:{port}/")
        one.has(LIVE)
        one.has("document.getElementById('label').textContent.startsWith('<img')")
        one.has("document.getElementById('events').textContent.includes('onerror')")
        assert one.page.locator("img").count() == 0
        possible = one.text("#prediction-set")
        assert "one of: <img" in possible and "90 % coverage" in possible
        assert "<img" in one.text("#degraded") and "<img" in one.text("#parts")
        assert one.page.title() == f"{EVIL} · tactile_rt"
        assert {url.rpartition("/")[2].partition("?")[0] for url in one.asked} <= {
            "", "app.js", "draw.js", "stream.js", "style.css", "icon.svg", "live",
        }  # fmt: skip
        assert one.faults() == []
        # The browser itself refuses markup, should a later change try it.
        blocked = "try { document.body.innerHTML = '<b>x</b>'; } catch (e) { e.name }"
        assert one.page.evaluate(blocked) == "TypeError"


def test_a_wrong_token_opens_nothing_and_the_right_one_lasts(tab, port):
    with Fed(port, token=TOKEN):
        one = tab(viewport={"width": 390, "height": 844})
        one.page.goto(f"http://127.0.0.1:{port}/")
        one.page.locator("#login").wait_for(state="visible")
        assert one.page.locator("#main").is_hidden()
        one.page.fill("#token", TOKEN + "x")
        one.page.click("#login button")
        one.has("document.getElementById('login-error').textContent === 'the token is wrong'")
        assert one.page.locator("#main").is_hidden() and one.context.cookies() == []
        one.page.fill("#token", TOKEN)
        one.page.click("#login button")
        one.has(LIVE)
        one.page.reload()
        one.has(LIVE)
        assert one.page.locator("#login").is_hidden()
        assert one.page.evaluate("document.cookie") == ""  # scripts cannot see it
        # Nothing is wider than a phone.
        assert one.page.evaluate("document.documentElement.scrollWidth") <= 390
        assert one.faults() == []


@pytest.mark.parametrize(("url", "shown"), [("synthetic:mouse", True), ("replay:demo", False)])
def test_beside_decisions_on_made_up_touches_it_says_so(tab, port, configured, url, shown):
    with running_daemon(configured(f'[[source]]\nname = "a"\nurl = "{url}"\n[[model]]\n')):
        one = tab()
        one.page.goto(f"http://127.0.0.1:{port}/")
        one.has("!document.getElementById('by-model').hidden && document.title.includes('mouse')")
        assert one.page.locator("#made-up").is_visible() == shown
