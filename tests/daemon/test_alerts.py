"""The alert rules that ship: of metrics that there are, and by Prometheus' own tool."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tactile_rt.daemon.metrics import ALERTS, exposition
from tests.helpers.published import busy_snapshot

TESTS = Path(__file__).parent / "data" / "alerts.test.yml"


def test_rules_are_of_metrics_that_there_are():
    told = re.findall(r"# TYPE (tactile_\S+) ", exposition(busy_snapshot()).decode())
    rules = [line for line in ALERTS.read_text().splitlines() if "summary" not in line]
    asked = set(re.findall(r"tactile_\w+", "\n".join(rules)))
    assert len(asked) >= 8 and asked <= set(told)


def test_every_rule_is_tried():
    names = re.findall(r"- alert: (\w+)", ALERTS.read_text())
    assert len(names) == len(set(names))
    assert set(names) == set(re.findall(r"alertname: (\w+)", TESTS.read_text()))


@pytest.mark.skipif(
    shutil.which("promtool") is None, reason="needs promtool: apt install prometheus"
)
def test_prometheus_takes_the_rules_and_they_fire_when_they_should(tmp_path):
    shutil.copy(ALERTS, tmp_path)
    shutil.copy(TESTS, tmp_path)
    for what, file in (("check", ALERTS.name), ("test", TESTS.name)):
        done = subprocess.run(
            ["promtool", what, "rules", file], cwd=tmp_path, capture_output=True, text=True,
            timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
