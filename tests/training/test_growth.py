"""What measures an hour of training finds a command that leaks memory or files, and passes one that does not."""

import json
import sys
from pathlib import Path

import pytest

from tests.benchmarks import growth

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="counts by /proc, which Linux has")
LEAKS_MEMORY = "import time; held = []\nwhile True: held.append(b'x' * 2**20); time.sleep(0.02)"
LEAKS_FILES = "import time; held = []\nwhile True: held.append(open('/dev/null')); time.sleep(0.02)"
IN_A_CHILD = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {LEAKS_MEMORY!r}])"


def measured(tmp_path, *command):
    """Return the exit code and the growth that is found in a second or two of a command."""
    record = tmp_path / "growth.json"
    options = ["--minutes", "0.03", "--every", "0.1", "--warmup", "0.008", "--json", str(record)]
    exit_code = growth.main([*options, "--", *command])
    return exit_code, json.loads(record.read_text())["growth"]


@pytest.mark.slow
def test_a_command_that_holds_what_it_holds_does_not_grow(tmp_path, capsys):
    code, found = measured(tmp_path, "sleep", "60")
    assert code == 0
    assert found["files"] == 0
    assert "after 0.008 min: RSS +0.00 MB/hour" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("leak", [LEAKS_MEMORY, IN_A_CHILD])
def test_memory_that_leaks_is_found_in_the_command_and_in_its_children(tmp_path, leak):
    code, found = measured(tmp_path, sys.executable, "-c", leak)
    assert code == 1
    assert found["anonymous_mb_per_hour"] > 1000
    assert found["files"] == 0


@pytest.mark.slow
def test_files_that_leak_are_found(tmp_path):
    code, found = measured(tmp_path, sys.executable, "-c", LEAKS_FILES)
    assert code == 1
    assert found["files"] > 1


def test_a_command_that_fails_early_is_no_measurement(tmp_path):
    with pytest.raises(ValueError, match="ended with exit code 3 after"):
        measured(tmp_path, sys.executable, "-c", "raise SystemExit(3)")


def test_one_peak_does_not_count_as_growth():
    samples = [growth.Sample(minute, 900.0 if minute == 30 else 400.0, 200.0, 5, 4, 1) for minute in range(60)]
    assert growth.fit(samples, 10, 0) == growth.Growth(0.0, 0.0, 0.0, 0)
    rising = [growth.Sample(minute, 400.0 + minute, 200.0, 5, 4, 1) for minute in range(60)]  # negative control
    assert growth.fit(rising, 10, 0).rss_mb_per_hour == pytest.approx(60)
    with pytest.raises(ValueError, match="are too few; give more --minutes"):
        growth.fit(samples, 56, 0)
