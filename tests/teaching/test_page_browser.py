"""The page with buttons in a real Chromium: shown, pressed, and deaf to markup."""

import shutil
import time

import numpy as np
import pytest

pytest.importorskip(
    "playwright.sync_api", reason="needs playwright (165 MB): pip install playwright"
)

from playwright.sync_api import sync_playwright

from tactile_rt.teaching.lesson import Lesson
from tactile_rt.teaching.model import FewShot
from tactile_rt.teaching.page import TeachingPage
from tactile_rt.teaching.teacher import Teacher
from tests.helpers.made_up_touches import NOISE, wrench_spec

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
PATIENCE_MS = 30_000
EVIL = "b <img src=x onerror=document.title='owned'>"

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium"),
]


def test_buttons_are_orders_and_what_is_said_is_shown(tmp_path):
    lesson = Lesson.begin(tmp_path / "a", FewShot(wrench_spec(), np.float32(0.3 * NOISE)))
    teacher = Teacher(lesson, ["press", "slide"], 2)
    shown, orders = [None], []
    rng = np.random.default_rng(0)

    def touch(at):
        size = (lesson.taught.timing.steps, lesson.taught.network.size)
        features = (at + rng.normal(size=size)).astype(np.float32)
        teacher.take(teacher.label, features, "session-1.mcap", (at, at + 1))

    def state():
        return teacher.state() if shown[0] else {"prompt": "touch nothing for 2 s"}

    page = TeachingPage("127.0.0.1", 0, state, orders.append)
    try:
        with sync_playwright() as p:
            browser = p.chromium.launch(executable_path=CHROMIUM, args=ARGS)
            tab = browser.new_page()
            tab.set_default_timeout(PATIENCE_MS)
            faults = []
            tab.on("pageerror", lambda error: faults.append(str(error)))

            def has(selector, text):
                ends = time.monotonic() + PATIENCE_MS / 1000
                while text not in (tab.locator(selector).text_content() or ""):
                    assert time.monotonic() < ends, (text, tab.content(), faults)
                    tab.wait_for_timeout(50)

            def press(button, order):
                tab.get_by_role("button", name=button).click()
                ends = time.monotonic() + PATIENCE_MS / 1000
                while not orders:
                    assert time.monotonic() < ends, faults
                    tab.wait_for_timeout(20)
                assert orders == [order]
                return teacher.obey(orders.pop())

            tab.goto(page.url)
            has("#prompt", "touch nothing for 2 s")
            shown[0] = True
            has("#prompt", "touch it: press (1 of 2)")
            for at in (0, 0, 9, 9):
                touch(at)
            teacher.done = False
            has("#classes", "press2 of 2 touches, 2 told right")
            has("#told", "4 of 4 touches are right, leave-one-out: judged by all others.")
            press("Take the last touch back", "undo")
            has("#note", "touch 4 (slide) is taken back")
            has("#prompt", "touch it: slide (2 of 2)")
            press("press", "press")
            has('[aria-pressed="true"]', "press")
            tab.locator("#name").fill("a/b")
            press("Add", "a/b")
            has("#note", "cannot be part of a file's name")
            teacher.wanted.append(EVIL)  # which no teacher would take
            has("#classes", EVIL)
            assert tab.title() == "Teach touches"
            press("Done: learn", "done")
            assert teacher.done
            page.close()
            has("#prompt", "The teaching program has ended.")
            assert faults == []
            browser.close()
    finally:
        page.close()
