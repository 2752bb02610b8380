"""Compare a wheel with the checkout: it holds every tracked file of the packages, and nothing else.

python -m tests.wheel dist/esp_marl-*.whl
"""

import subprocess
import sys
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLACES = {"esp_cli/": "esp_cli/", "environments/esp_envs/": "esp_envs/", "checkpoints/": "esp_cli/checkpoints/"}
"""Where the files of these folders go in a wheel."""
METADATA = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE"}


def tracked() -> list[str]:
    """Return the paths of all files in the checkout that git tracks."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    return listed.stdout.split("\0")[:-1]


def differences(wheel: Path, files: Iterable[str]) -> list[str]:
    """Return a sentence for each file that is missing from a wheel, and for each that does not belong there."""
    wanted = {
        target + file.removeprefix(source)
        for file in files
        for source, target in PLACES.items()
        if file.startswith(source)
    }
    found = set(zipfile.ZipFile(wheel).namelist())
    (about,) = {name.split("/")[0] for name in found if name.split("/")[0].endswith(".dist-info")}
    wanted |= {f"{about}/{name}" for name in METADATA}
    missing = [f"{name} is missing" for name in sorted(wanted - found)]
    return missing + [f"{name} does not belong in the wheel" for name in sorted(found - wanted)]


if __name__ == "__main__":
    wrong = differences(Path(sys.argv[1]), tracked())
    print("\n".join(wrong) or f"{sys.argv[1]} holds what it should, {Path(sys.argv[1]).stat().st_size / 1e6:.1f} MB")
    sys.exit(bool(wrong))
