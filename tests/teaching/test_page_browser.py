"""The page with buttons in a real Chromium: shown, pressed, and deaf to markup."""

import numpy as np

from tactile_rt.teaching.lesson import Lesson
from tactile_rt.teaching.model import FewShot
from tactile_rt.teaching.page import TeachingPage
from tactile_rt.teaching.teacher import Teacher
from tests.helpers.browser import MARKS, Tab, open_browser
from tests.helpers.made_up_touches import NOISE, wrench_spec
from tests.helpers.waiting import until

EVIL = "b <img src=x onerror=document.title='owned'>"

pytestmark = MARKS


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
        with open_browser() as browser:
            tab = Tab(browser)

            def press(button, order):
                tab.page.get_by_role("button", name=button).click()
                until(lambda: orders, meanwhile=lambda: tab.page.wait_for_timeout(20))
                assert orders == [order]
                return teacher.obey(orders.pop())

            tab.page.goto(page.url)
            tab.shows("#prompt", "touch nothing for 2 s")
            shown[0] = True
            tab.shows("#prompt", "touch it: press (1 of 2)")
            for at in (0, 0, 9, 9):
                touch(at)
            teacher.done = False
            tab.shows("#classes", "press2 of 2 touches, 2 told right")
            tab.shows("#told", "4 of 4 touches are right, leave-one-out: judged by all others.")
            press("Take the last touch back", "undo")
            tab.shows("#note", "touch 4 (slide) is taken back")
            tab.shows("#prompt", "touch it: slide (2 of 2)")
            press("press", "press")
            tab.shows('[aria-pressed="true"]', "press")
            tab.page.locator("#name").fill("a/b")
            press("Add", "a/b")
            tab.shows("#note", "cannot be part of a file's name")
            teacher.wanted.append(EVIL)  # which no teacher would take
            tab.shows("#classes", EVIL)
            assert tab.page.title() == "Teach touches"
            press("Done: learn", "done")
            assert teacher.done
            page.close()
            tab.shows("#prompt", "The teaching program has ended.")
            assert tab.faults() == []
    finally:
        page.close()
