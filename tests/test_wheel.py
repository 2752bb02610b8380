"""What compares the wheel with the checkout finds what is missing and what is too much."""

import zipfile
from pathlib import Path

from tests.wheel import METADATA, ROOT, differences, tracked

FILES = ["esp_cli/app.py", "environments/esp_envs/py.typed", "checkpoints/manifest.json", "tests/wheel.py", "README.md"]
RIGHT = {"esp_cli/app.py", "esp_envs/py.typed", "esp_cli/checkpoints/manifest.json"}


def wheel(folder: Path, names: set[str]) -> Path:
    path = folder / "esp_marl-1-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as file:
        for name in sorted(names | {f"esp_marl-1.dist-info/{name}" for name in METADATA}):
            file.writestr(name, "")
    return path


def test_a_wheel_of_the_packages_and_the_bundled_policies_is_right(tmp_path: Path) -> None:
    assert differences(wheel(tmp_path, RIGHT), FILES) == []


def test_what_is_missing_and_what_is_too_much_is_named(tmp_path: Path) -> None:
    found = differences(wheel(tmp_path, RIGHT - {"esp_envs/py.typed"} | {"tests/wheel.py", "esp_cli/x.pyc"}), FILES)
    assert found == [
        "esp_envs/py.typed is missing",
        "esp_cli/x.pyc does not belong in the wheel",
        "tests/wheel.py does not belong in the wheel",
    ]


def test_no_test_and_no_script_lies_among_the_files_that_are_packed() -> None:
    packed = [name for name in tracked() if name.startswith(("esp_cli/", "environments/esp_envs/", "checkpoints/"))]
    assert len(packed) > 200
    code, templates, data = {".py", ".cpp", ".h", ".c"}, {".html", ".jinja"}, {".json", ".typed", ".safetensors"}
    assert {Path(name).suffix for name in packed} == code | templates | data
    assert not [name for name in packed if Path(name).name.startswith(("test_", "conftest")) or "/tests/" in name]
    assert not [name for name in packed if (ROOT / name).is_symlink()]
