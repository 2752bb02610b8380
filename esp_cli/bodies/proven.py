"""Proof of the mirrors in the file beside this one: run it with pytest, or as it is. It needs numpy alone."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np

MIRROR, RECORDED = "", dict[str, Any]()  # DATA


def mirror() -> Any:
    """Return the file with the mirrors as a module."""
    spec = importlib.util.spec_from_file_location("mirror", Path(__file__).with_name(MIRROR))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def maps(module: Any) -> dict[str, list[Any]]:
    """Return the matrices of each element on observations and actions."""
    groups = [*module.OBSERVATIONS, None]
    rows = {group: np.eye(len(RECORDED[group or "action"]["row"])) for group in groups}
    return {name: [module.mirrored(rows[group], name, group).T for group in groups] for name in module.ELEMENTS}


def test_images_are_those_that_were_recorded() -> None:
    """Compare images of a row with those that the layouts gave."""
    module = mirror()
    for group, recorded in RECORDED.items():
        for name in module.ELEMENTS:
            image = module.mirrored(np.array([recorded["row"]]), name, None if group == "action" else group)
            np.testing.assert_allclose(image, [recorded[name]], atol=1e-9)


def test_each_element_is_undone_by_one_of_them() -> None:
    """Find the inverse of each element; a mirror is its own."""
    found = maps(mirror())
    for name, own in found.items():
        undone = [
            all(np.allclose(a @ b, np.eye(len(a)), atol=1e-9) for a, b in zip(own, other, strict=True))
            for other in found.values()
        ]
        assert any(undone), f"nothing undoes {name}"
        if name.startswith("flip"):
            assert undone[list(found).index(name)], f"{name} does not undo itself"


def test_one_after_the_other_is_one_of_them() -> None:
    """Multiply all pairs of elements."""
    found = maps(mirror())
    known = [*found.values(), [np.eye(len(x)) for x in next(iter(found.values()))]]
    for first in found.values():
        for second in found.values():
            product = [a @ b for a, b in zip(second, first, strict=True)]
            assert any(all(map(np.allclose, product, one)) for one in known)


def test_copies_stand_behind_their_originals() -> None:
    """Look at what the loop is handed."""
    module = mirror()
    group = next(iter(module.OBSERVATIONS), None)
    if group is not None:
        rows, actions = (np.array([RECORDED[name]["row"]] * 2) for name in (group, "action"))
        seen, acted, reward = module.augment(rows, actions, np.array([1.0, 2.0]))
        images = [module.mirrored(rows, name, group) for name in module.ELEMENTS]
        np.testing.assert_array_equal(seen, np.concatenate([rows, *images]))
        assert (len(acted), reward.tolist()) == (len(seen), [1.0, 2.0] * (1 + len(images)))


if __name__ == "__main__":
    for test in [value for name, value in list(globals().items()) if name.startswith("test_")]:
        test()
    sys.stdout.write("proven\n")
