"""One admission alone: what is asked of the trial and given to the classifier."""

import threading

import numpy as np
import pytest

from tactile_rt.classifier.classifier import EVERY
from tactile_rt.classifier.enrolment import EnrolledObject
from tactile_rt.classifier.trial import Trial, TrialLimits
from tactile_rt.core.errors import ModelError
from tactile_rt.daemon import admission as module
from tactile_rt.daemon.admission import Admission, file_stamp
from tactile_rt.daemon.config import LimitsConfig, ModelConfig
from tactile_rt.daemon.items import Opened
from tactile_rt.testing import ArraySource, cut_chunks
from tests.helpers.tiny_model import CARD, STEPS, force_rule, write_model
from tests.helpers.touch_streams import QUIET, SAME_RATE, push_all, pushes, signal, stream
from tests.helpers.waiting import PATIENCE_S

LIMITS = LimitsConfig(model_mb=300.0, model_s=7.0)
STEP_MS = CARD.substeps * CARD.period_ns / 1e6


class Trials:
    """Stands in for the process that tries a model; says what it was asked."""

    def __init__(self, monkeypatch, step_s=0.001, during=lambda: None):
        self.asked = []
        self.found = Trial("a" * 64, 0.25, step_s, 22.0)
        self._during = during
        monkeypatch.setattr(module, "try_model", self)

    def __call__(self, path, limits, every, given_up):
        self.asked.append((path, limits, every))
        self._during()
        return self.found


@pytest.fixture
def model(tmp_path):
    return write_model(tmp_path / "m.onnx")


def opened(live=True):
    source = ArraySource(SAME_RATE, cut_chunks(np.zeros((1, *SAME_RATE.shape), np.float32), 100.0))
    source.live = live
    return Opened("a", SAME_RATE, "url", source, 1, 0, ())


def admitted(model, stream_of=None, age=lambda t_ns: 0.0, known=None, **config):
    made = Admission(ModelConfig(file=str(model), **config), LIMITS, stream_of, age, known)
    assert made.finished.wait(PATIENCE_S)
    return made


@pytest.mark.parametrize(
    "config, every",
    [
        ({}, 0),
        ({"every": 3}, 0),
        ({"mode": "sliding"}, EVERY),
        ({"mode": "sliding", "every": 3}, 3),
    ],
)
def test_the_trial_steps_as_the_classifier_will(model, monkeypatch, config, every):
    trials = Trials(monkeypatch)
    made = admitted(model, **config)
    assert trials.asked == [(model, TrialLimits(300.0, 7.0), every)]
    assert made.error is None and made.classifier is None and made.trial is trials.found


def test_a_model_that_is_given_up_while_it_is_tried_is_not_loaded(model, monkeypatch):
    over = threading.Event()
    Trials(monkeypatch, during=lambda: over.wait(PATIENCE_S))
    made = Admission(ModelConfig(file=str(model)), LIMITS, opened(), lambda t_ns: 0.0)
    made.give_up()
    over.set()
    assert made.finished.wait(PATIENCE_S) and made.error is None and made.classifier is None


def test_what_was_tried_is_not_tried_again(model, monkeypatch):
    trials = Trials(monkeypatch)
    made = admitted(model, opened(), known=trials.found)
    assert trials.asked == [] and made.classifier is not None


@pytest.mark.parametrize("step_ms, said", [(STEP_MS, False), (STEP_MS + 0.01, True)])
def test_one_that_cannot_keep_up_is_admitted_and_told(model, monkeypatch, step_ms, said):
    Trials(monkeypatch, step_s=step_ms / 1e3)
    made = admitted(model, opened())
    assert ("it cannot keep up" in made.words) == said
    assert made.words.startswith(f"{model}, sha256 {'a' * 12}: warm after 0.25 s, 22 MB, ")
    assert "cannot keep up" not in admitted(model, None).words


def test_touches_within_fuse_s_are_of_one_object(tmp_path, monkeypatch):
    Trials(monkeypatch)
    objects = (EnrolledObject.of("cup", np.array([[4.0, 8.0]])),)
    model = write_model(tmp_path / "cup.onnx", identity=force_rule(), enrolled=objects)
    found = push_all(admitted(model, opened(), fuse_s=2.0).classifier, pushes([8, 8]))
    assert [(d.object, d.object_touches) for d in found if d.final] == [("cup", 1), ("cup", 2)]


def test_behind_ms_and_deadline_ms_are_milliseconds(model, monkeypatch):
    """Old by 0.3 s: beyond a deadline of 0.2 s, within 0.4 s."""
    Trials(monkeypatch)
    values = signal([(QUIET, QUIET + 60, 1.0)], QUIET + 100)
    for behind_ms, deadline_ms, decided, late in (
        (400.0, 200.0, STEPS, STEPS), (400.0, 400.0, STEPS, 0), (250.0, 0.0, 0, 0),
    ):  # fmt: skip
        made = admitted(
            model, opened(), age=lambda t_ns: 0.3, behind_ms=behind_ms, deadline_ms=deadline_ms
        )
        found = push_all(made.classifier, stream(values))
        assert (len(found), made.classifier.stats.late) == (decided, late)


def test_of_a_recording_nothing_is_old(model, monkeypatch):
    Trials(monkeypatch)
    made = admitted(model, opened(live=False), age=lambda t_ns: 100.0)
    values = signal([(QUIET, QUIET + 60, 1.0)], QUIET + 100)
    assert len(push_all(made.classifier, stream(values))) == STEPS


def test_a_file_that_changes_while_it_is_tried_is_refused(model, monkeypatch):
    Trials(monkeypatch, during=lambda: write_model(model, temperature=2.0))
    made = admitted(model, opened())
    assert isinstance(made.error, ModelError) and "written while it was being tried" in made.words
    assert made.stamp != file_stamp(model)


def test_whatever_goes_wrong_is_the_model_s_fault_and_names_it(model, monkeypatch):
    def fail():
        raise ZeroDivisionError("by zero")

    Trials(monkeypatch, during=fail)
    made = admitted(model)
    assert made.words == f"{model}: ZeroDivisionError: by zero"
