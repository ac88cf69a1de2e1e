"""The dialogue of a lesson: the user names what is touched, and sees how well it is told apart.

commands (keys, lines, a page's buttons) --> Teacher <-- touches
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.teaching.lesson import ANYTHING_ELSE, NAMING, Lesson, LessonProgress, check_label

ELSE_S = 20.0  # for touches of anything else
LONG = 9  # digits: more are no class's number


@dataclass
class Teacher:
    """State machine of a lesson's dialogue: executes commands, adds touches, prompts the user."""

    lesson: Lesson
    # names of the classes to be taught, in their order; more come as they are named
    wanted: list[str]
    each: int
    label: str = ""  # name of what is touched now; empty: not named yet
    done: bool = False  # whether the user has ended the lesson, or all wanted touches were made
    ended: str = ""  # how the lesson ended; empty: it goes on
    said: str = ""
    progress: LessonProgress = field(default_factory=lambda: LessonProgress((), (), ()))
    _planned: bool = False  # whether the lesson ends after a list of classes
    _ends_s: float | None = None  # when the time for touches of anything else is over

    def __post_init__(self) -> None:
        for name in self.wanted:
            check_label(name)
        self.progress = self.lesson.leave_one_out()
        self.label = next(iter(self._list_short()), "")
        self._planned = bool(self.label)
        self.wanted += [name for name in self.lesson.labels if name not in self.wanted]

    def obey(self, order: str) -> str:
        """Execute a command: one of `ORDERS`, a class's name or number; return the answer.

        Further commands are ``forget NAME`` and ``rename OLD NEW``; quote names with spaces.
        """
        return self.note(self._obey(order.strip()))

    def note(self, said: str) -> str:
        """Store an answer to show it on the page, too; return it."""
        self.said = said
        return said

    def _obey(self, order: str) -> str:
        if order == "done":
            self.done = True
            return ""
        if order == "undo":
            return self._undo()
        if order == "next":
            return self._go_to_next()
        if order == "list":
            return "\n".join(self._describe_classes()) or "nothing is taught yet"
        if order.partition(" ")[0] in NAMING:
            return self._rename(order)
        if order.isdecimal() and order not in self.wanted:
            number = int(order) if len(order) < LONG else 0
            if not 1 <= number <= len(self.wanted):
                return f"there is no class {order[:LONG]}: there are {len(self.wanted)}"
            order = self.wanted[number - 1]
        try:
            self.label = check_label(order)
        except ConfigError as error:
            return str(error)
        if order not in self.wanted and order != ANYTHING_ELSE:
            self.wanted.append(order)
        return self.prompt()

    def watch(self, now_s: float | None) -> None:
        """Set `done` if touches of anything else had enough time, or samples end (None)."""
        if self.label != ANYTHING_ELSE or not self._planned:
            self._ends_s = None
        elif now_s is None:
            self.done = True
        else:
            self._ends_s = self._ends_s or now_s + ELSE_S
            self.done = self.done or now_s > self._ends_s

    def take(
        self,
        label: str,
        features: NDArray[np.float32],
        recording: str,
        span_s: tuple[float, float],
    ) -> str:
        """Add a touch to the lesson under a label; return the answer for the user."""
        if not label:
            return self.note("touched, but what? say so first: nothing was learnt")
        self.lesson.add(label, features, recording, span_s)
        texts = [f"{len(self.lesson.touches):3d}  {label} {self.lesson.count(label)}"]
        before = set(self.progress.odd)
        self.progress = self.lesson.leave_one_out()
        refused, others = self.progress.others
        other = label == ANYTHING_ELSE and self.lesson.taught_enough
        texts.append(f"refused: {refused} of {others}" if other else self._describe_progress())
        texts += [
            f"touch {number} is unlike the others of {self.lesson.touches[number - 1].label}"
            + ("" if like == self.lesson.touches[number - 1].label else f", more like {like}")
            for number, like in self.progress.odd
            if (number, like) not in before
        ]
        enough = self.lesson.count(label) >= self.each and label != ANYTHING_ELSE
        changed = self.label == label and enough
        if changed:
            self._choose_next()
        if self.done or changed:
            texts.append(self.prompt())
        return self.note("\n".join([", ".join(filter(None, texts[:2])), *texts[2:]]))

    def prompt(self) -> str:
        """Return the present instruction to the user."""
        if self.ended:
            return self.ended
        if self.done:
            return "all touches are there"
        if not self.label:
            return "what is touched next? name it, or choose its number"
        if self.label == ANYTHING_ELSE:
            return f"touch it in any other way, for {ELSE_S:g} s: that will be refused"
        count = self.lesson.count(self.label)
        of = f" of {self.each}" if count < self.each else ""
        return f"touch it: {self.label} ({count + 1}{of})"

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows; safe from any thread."""
        # Called in another thread: what is read twice must not change in between.
        progress, touches = self.progress, tuple(self.lesson.touches)
        right, of = progress.right
        rows = {name: (count, good) for name, count, good in progress.classes}
        return {
            "said": self.said,
            "label": self.label,
            "each": self.each,
            "done": self.done,
            "ended": bool(self.ended),
            "prompt": self.prompt(),
            "classes": [
                {
                    "name": name,
                    "touches": sum(touch.label == name for touch in touches),
                    "right": rows[name][1] if name in rows else None,
                }
                for name in tuple(self.wanted)
            ],
            "right": right,
            "of": of,
            "odd": [
                [n, touches[n - 1].label, like] for n, like in progress.odd if n <= len(touches)
            ],
            "confused": [list(pair) for pair in progress.confused[:3]],
        }

    def summary(self) -> Sequence[str]:
        """Return lines on the result of each class, and on classes that are confused."""
        lines = [
            f"{name}: {good} of {count} touches right, leave-one-out"
            for name, count, good in self.progress.classes
        ]
        lines += [f"{a} and {b} feel the same: make them one" for a, b in self.progress.same]
        same = {frozenset(pair) for pair in self.progress.same}
        others = [pair for pair in self.progress.confused if frozenset(pair) not in same]
        lines += [f"{a} is taken for {b}" for a, b in others[:3]]
        learnt = self.lesson.taught_enough
        if learnt and not lines:
            lines = [f"{learnt[0]} is the only class: teach another to compare"]
        refused, count = self.progress.others
        if count and learnt:
            lines.append(f"{ANYTHING_ELSE}: {refused} of {count} touches refused, leave-one-out")
        few = self.lesson.taught.few
        for name in self.lesson.labels:
            count, wanted = self.lesson.count(name), max(few, self.each)
            if name not in learnt:
                lines.append(f"{name}: one touch is too few, and was not learnt")
            elif count < few and len(learnt) > 1:
                lines.append(
                    f"{name}: {count} touches are few: later ones may be called unknown: "
                    f"give it {wanted - count} more"
                )
        return lines

    def _describe_classes(self) -> list[str]:
        right = {name: f", {good} right" for name, _, good in self.progress.classes}
        names = self.lesson.labels
        return [f"{name}: {self.lesson.count(name)} touches{right.get(name, '')}" for name in names]

    def _rename(self, order: str) -> str:
        """Execute a command to rename or forget a class; return the answer."""
        try:
            verb, old, *new = shlex.split(order)
            if len(new) != (verb == "rename"):
                raise ValueError
            self.lesson.rename(old, "".join(new))
        except ConfigError as error:
            return str(error)
        except ValueError:
            return "say forget NAME or rename OLD NEW; a name with spaces in quotes"
        names = (new[0] if name == old and new else name for name in self.wanted)
        self.wanted = list(dict.fromkeys(n for n in names if new or n != old))
        self.progress = self.lesson.leave_one_out()
        if self.label == old:
            self.label = "".join(new)
        return f"{old} is {f'called {new[0]} now' if new else 'forgotten'}\n{self.prompt()}"

    def _describe_progress(self) -> str:
        right, of = self.progress.right
        if len(self.progress.classes) < 2:
            return ""
        worst = min(self.progress.classes, key=lambda c: c[2] / c[1])
        weak = f"; weakest: {worst[0]}, {worst[2]} of {worst[1]}" if worst[2] < worst[1] else ""
        return f"told apart, leave-one-out: {right} of {of} touches{weak}"

    def _undo(self) -> str:
        gone = self.lesson.undo()
        if gone is None:
            return "there is no touch to take back"
        self.progress = self.lesson.leave_one_out()
        self.label, self.done = gone.label, False
        return f"touch {len(self.lesson.touches) + 1} ({gone.label}) is taken back\n{self.prompt()}"

    def _go_to_next(self) -> str:
        if not self.wanted:
            return self.prompt()
        at = self.wanted.index(self.label) + 1 if self.label in self.wanted else 0
        self.label = self.wanted[at % len(self.wanted)]
        return self.prompt()

    def _choose_next(self) -> None:
        """Choose the next class that lacks touches, else `ANYTHING_ELSE`, else end the list."""
        short = self._list_short()
        if short:
            self.label = short[0]
        elif self._planned and not self.lesson.count(ANYTHING_ELSE):
            self.label = ANYTHING_ELSE
        else:
            self.done = self._planned

    def _list_short(self) -> list[str]:
        return [name for name in self.wanted if self.lesson.count(name) < self.each]
