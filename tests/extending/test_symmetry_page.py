"""The geometry that docs/add-a-symmetry.md adds: in groups, a loop of one's own, a task, and a network."""

from __future__ import annotations

import itertools
import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from esp_cli import Symmetry, Transitions
from esp_cli.networks.constrained import EquivariantConfig
from esp_cli.networks.contract import IoSpec
from esp_cli.prior import SeedBatch, SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import (
    Element,
    FiniteGroup,
    Geometry,
    build_transform,
    carried_groups,
    default_transforms,
    parse,
    parse_elements,
    parse_group,
    plane,
    representation,
    transform_set,
)
from esp_envs.errors import UserError
from esp_envs.spec import Continuous, Field, Items, Kind, Layout, Spaces, joint_layout, layout
from tests.cli.running import TINY_OPTIONS, esp, refused

PAGE = Path(__file__).parents[2] / "docs" / "add-a-symmetry.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
WALKERS = PAGE.with_name("walkers.py").read_text(encoding="utf-8")


@pytest.fixture
def legs(tmp_path, monkeypatch) -> Any:
    """The page's file, imported; what it registers is taken out again."""
    monkeypatch.setattr(parse, "READERS", parse.READERS.copy())
    monkeypatch.setattr(plane, "KIND_MATRICES", plane.KIND_MATRICES.copy())
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "legs.py").write_text(BLOCKS[0])
    (tmp_path / "walkers.py").write_text(WALKERS)
    monkeypatch.chdir(tmp_path)
    module = ModuleType("legs")
    monkeypatch.setitem(sys.modules, "legs", module)
    monkeypatch.delitem(sys.modules, "walkers", raising=False)
    exec(compile(BLOCKS[0], "legs.py", "exec"), module.__dict__)  # noqa: S102 - the page is part of the repository
    return module


def seen(kind: Kind, items: Items = Items.OTHERS) -> Layout:
    return layout(Field("speed", Kind.SCALAR), Field("knees", kind), Field("others", kind, 2, items=items))


def spaces(kind: Kind, symmetry: str = "legs*agents", joint: bool = False) -> Spaces:
    observation = seen(kind)
    return Spaces(
        num_agents=3,
        observation=observation,
        state=joint_layout(observation, 3) if joint else layout(Field("knees", kind, 3, items=Items.AGENTS)),
        action=Continuous(layout(Field("torque", kind))),
        symmetry=symmetry,
    )


def test_legs_and_agents_move_by_hand(legs) -> None:
    # Knees (1, 2), (3, 4), (5, 6) and speeds 10, 20, 30; agent 0 goes to place 1, 1 to 2, 2 to 0, and all legs swap.
    transform = transform_set("swap-legs*agents-1-2-0", spaces(legs.LEGS)).each()[0]
    rows = torch.tensor([[10.0, 1, 2, 3, 4, 5, 6], [20, 3, 4, 1, 2, 5, 6], [30, 5, 6, 1, 2, 3, 4]])
    moved = [[30, 6, 5, 2, 1, 4, 3], [10, 2, 1, 6, 5, 4, 3], [20, 4, 3, 6, 5, 2, 1]]
    assert transform.obs(rows).tolist() == moved
    assert transform.state(torch.tensor([1.0, 2, 3, 4, 5, 6])).tolist() == [6, 5, 2, 1, 4, 3]
    assert transform.action(torch.tensor([[1.0, 2], [3, 4], [5, 6]])).tolist() == [[6, 5], [2, 1], [4, 3]]
    assert transform.elements[0].name == "swap-legs*agents-1-2-0"


@pytest.mark.parametrize(
    ("group", "order"), [("legs*agents", 12), ("d4*legs", 16), ("legs*d4*agents", 96), ("d4*legs*agents*marks-2", 192)]
)
def test_products_are_homomorphisms(legs, group: str, order: int) -> None:
    observation = layout(*seen(legs.LEGS).fields, Field("way", Kind.VECTOR), Field("marks", Kind.SCALAR, 2))
    whole = replace(spaces(legs.LEGS, group), observation=observation, state=joint_layout(observation, 3))
    elements = parse_group(group, 3).elements
    assert len(elements) == order
    x, torque = torch.randn(3, observation.width), torch.randn(3, 2)
    chosen = elements if len(elements) < 20 else elements[:: len(elements) // 12]
    for g, h in itertools.product(chosen, chosen):
        first, second, both = (build_transform([e], whole) for e in (h, g, g @ h))
        assert torch.equal(both.obs(x), second.obs(first.obs(x)))
        assert torch.equal(both.state(x.flatten()), second.state(first.state(x.flatten())))
        assert torch.equal(both.action(torque), second.action(first.action(torque)))
        assert torch.equal(first.pull_back(first.action(torque)), torque)
    assert transform_set(group, whole).size == len(elements) - 1
    assert all(parse_elements(e.name, 3) == (e,) for e in elements[1:])


def test_a_task_carries_what_it_declares(legs) -> None:
    declared = spaces(legs.LEGS)
    assert carried_groups(declared) == ("legs", "agents")
    assert default_transforms(declared) == "legs"
    assert default_transforms(declared, weighed=True) == "legs", "d4 leaves legs where they are"
    with_way = replace(declared, observation=layout(*declared.observation.fields, Field("way", Kind.VECTOR)))
    assert default_transforms(with_way, weighed=True) == "d4"
    prior = SymmetryPrior(PriorConfig(transforms="swap-legs"), declared)
    batch = SeedBatch(torch.randn(2, 3, 1, 3, 7), torch.randn(2, 3, 1, 6), torch.randn(2, 3, 1, 3, 2))
    swapped = batch.state.unflatten(-1, (3, 2)).flip(-1).flatten(-2)
    assert torch.equal(prior.copies(batch, []).rows.state[:, 3:], swapped)
    for text, sentence in (
        ("rot90", "rot90 is no symmetry of its dynamics and reward, which carry legs; use a group within legs"),
        ("legs*marks-2", "the task has no field 'marks', but speed, knees, others, torque"),
    ):
        with pytest.raises(UserError, match=sentence):
            transform_set(text, declared)
    alone = replace(declared, symmetry="legs")
    with pytest.raises(UserError, match="its declared symmetry, legs, does not say that agents may be exchanged"):
        transform_set("swap-legs*agents-1-0-2", alone)
    coupled = replace(declared, symmetry="swap-legs*agents-1-0-2")
    assert transform_set("swap-legs*agents-1-0-2", coupled).size == 1
    for text, sentence in (
        ("swap-legs", "swap-legs is no symmetry of its dynamics and reward, which carry swap-legs.agents-1-0-2"),
        ("agents-1-0-2", "swap-legs.agents-1-0-2, does not say that agents may be exchanged by themselves"),
        ("swap-legs*agents-0-2-1", "swap-legs is no symmetry"),
    ):
        with pytest.raises(UserError, match=sentence):
            transform_set(text, coupled)


def test_agents_move_where_no_geometry_knows_a_field(legs) -> None:
    unknown = spaces(Kind("feelers", 5), "agents")
    assert transform_set("agents", unknown).size == 5
    with pytest.raises(UserError, match="a planar transform does not say how field 'knees' of kind feelers turns"):
        transform_set("rot90", replace(unknown, symmetry="o2"))


def test_what_does_not_commute_or_fit_is_refused(legs, monkeypatch) -> None:
    monkeypatch.setitem(plane.KIND_MATRICES, legs.LEGS, lambda planar: planar)
    with pytest.raises(UserError, match=r"swap-legs and rot90 do not commute on field 'knees'"):
        build_transform(parse_elements("rot90*swap-legs", 3), spaces(legs.LEGS))
    monkeypatch.setitem(plane.KIND_MATRICES, legs.LEGS, lambda planar: np.eye(3))
    with pytest.raises(UserError, match="rot45 transforms 3 numbers of field 'knees', but an item of it has 2"):
        build_transform(parse_elements("rot45", 3), spaces(legs.LEGS))
    monkeypatch.delitem(plane.KIND_MATRICES, legs.LEGS)
    with pytest.raises(UserError, match="does not say how field 'knees' of kind legs turns"):
        build_transform(parse_elements("rot90*swap-legs", 3), spaces(legs.LEGS))


def test_the_loop_of_the_page_augments_and_compares(legs) -> None:
    exec(compile(BLOCKS[1], str(PAGE), "exec"), legs.__dict__)  # noqa: S102 - the page is part of the repository
    symmetry = Symmetry(
        observation=seen(legs.LEGS),
        action=Continuous(layout(Field("torque", legs.LEGS))),
        group="legs*agents",
        num_agents=3,
        copies="all",
    )
    obs, torque = torch.randn(5, 3, 7), torch.randn(5, 3, 2)
    rows, actions, (numbers,) = symmetry.augment(obs, torque, per_agent=(torch.arange(3.0).expand(5, 3),))
    assert (rows.shape, actions.shape) == ((60, 3, 7), (60, 3, 2))
    assert {tuple(row) for row in numbers.tolist()} == set(itertools.permutations((0.0, 1.0, 2.0)))

    def fair(x: Tensor) -> Tensor:
        return x[..., 1:3] - 0.1 * x[..., 3:].unflatten(-1, (2, 2)).sum(-2)

    assert symmetry.policy_loss(fair, obs) < 1e-12
    assert symmetry.policy_loss(lambda x: fair(x) * torch.tensor([1.0, -1.0]), obs) > 0.1, "one leg goes the other way"
    assert symmetry.policy_loss(lambda x: x[..., 3:5], obs) > 0.1, "the first of the others is preferred"


def transitions(left: float = 0.3, right: float = 0.3) -> Transitions:
    """Return single steps of three pairs of knees, each drawn to those of the others and pulled back."""
    generator = torch.Generator().manual_seed(0)
    knees, torque = torch.randn(2, 500, 3, 2, generator=generator)
    after = 0.7 * knees + 0.2 * torque + 0.3 * knees.mean(-2, keepdim=True) - torch.tensor([left, right])

    def observed(x: Tensor) -> Tensor:
        rows = [torch.cat([x[:, i], *(x[:, j] for j in range(3) if j != i)], -1) for i in range(3)]
        return torch.stack(rows, 1)

    rows = (observed(knees), torque, -after.square().sum(-1), observed(after))
    return Transitions(*(x.unsqueeze(1) for x in rows))


def test_a_wrong_order_of_agents_a_wrong_sign_and_a_limp_are_seen(legs, monkeypatch) -> None:
    def verdicts(data: Transitions, items: Items = Items.OTHERS) -> dict[str, str]:
        observation = layout(Field("knees", legs.LEGS), Field("others", legs.LEGS, 2, items=items))
        action = Continuous(layout(Field("torque", legs.LEGS)))
        symmetry = Symmetry(observation=observation, action=action, group="legs*agents", num_agents=3)
        return {verdict.element: verdict.outcome for verdict in symmetry.check(data)}

    assert set(verdicts(transitions()).values()) == {"holds"}
    assert verdicts(transitions(), Items.FIXED)["agents-1-2-0"] == "broken", "who the others are is forgotten"
    limping = verdicts(transitions(right=0.0))
    assert limping["swap-legs"] == "broken"
    assert limping["agents-1-0-2"] == "holds"
    right = legs.LegSwap.block
    monkeypatch.setattr(legs.LegSwap, "block", lambda g, field: right(g, field) * (-1 if g.swapped else 1))
    monkeypatch.setattr(representation, "_item_operator", representation._item_operator.__wrapped__)
    assert verdicts(transitions())["swap-legs"] == "broken", "the sign is another"


OPTIONS = ["train", "--task", "walkers:Walkers", *TINY_OPTIONS, "--steps", 150]


def test_a_task_trains_with_it_and_its_check_sees_a_lame_leg(legs) -> None:
    esp(*OPTIONS, "--transforms", "legs*agents", "--out", "run")
    esp("train", "--resume", "run", "--task", "walkers:Walkers")
    assert "lacks" not in esp("eval", "run", "--episodes", 4, "--task", "walkers:Walkers").stdout
    esp(*OPTIONS, "--prior", "auto", "--out", "weighed")
    weights = json.loads(Path("weighed/config.json").read_text())["prior"]["weights"]
    assert weights.keys() == {"swap-legs"}, "not of turns, which leave legs alone"
    assert "c8 cannot act on walkers" in refused(*OPTIONS, "--transforms", "c8", "--out", "no")
    for lame, outcome in ((False, 0), (True, 1)):
        said = esp("check", "symmetry", "walkers:Walkers", "--transforms", "legs*agents", "--set", f"task.lame={lame}",
                   code=outcome).stdout  # fmt: skip
        assert ("broken" in said) is lame


def test_an_equivariant_network_has_it(legs) -> None:
    config, generators = EquivariantConfig(group="legs", hidden=(24, 24)), [torch.Generator().manual_seed(0)]
    io = IoSpec(spaces(legs.LEGS), "own")
    network, obs = config.build(generators, 0, 0, 1.0, io), torch.randn(1, 6, 3, 7)
    (swap,) = transform_set("legs", io.spaces).each()
    here, there = (network(x.flatten(1, 2)).detach().view(1, 6, 3, 2) for x in (obs, swap.obs(obs)))
    torch.testing.assert_close(swap.pull_back(there), here)
    assert (there - here).abs().max() > 0.1, "the control"
    with pytest.raises(UserError, match="choose a finite group that moves no agents"):
        io.group("legs*agents")
    esp(*OPTIONS, "--prior", "none", "--network", "equivariant", "--set", "network.group=legs", "--out", "run")


@dataclass(frozen=True)
class SpaceTurn(Geometry):
    """A quarter turn in space: a signed permutation of the three axes with determinant 1."""

    rows: tuple[tuple[int, ...], ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

    name = property(lambda self: f"turn{self.rows}")  # type: ignore[assignment]
    sort_key = property(lambda self: (not self.is_identity, self.rows))  # type: ignore[assignment]
    is_identity = property(lambda self: self.rows == SpaceTurn.rows)  # type: ignore[assignment]

    @classmethod
    def of(cls, matrix: np.ndarray) -> SpaceTurn:
        return cls(tuple(map(tuple, np.rint(matrix).astype(int).tolist())))

    def __matmul__(self, other: SpaceTurn) -> SpaceTurn:
        return SpaceTurn.of(np.array(self.rows) @ np.array(other.rows))

    def inverse(self) -> SpaceTurn:
        return SpaceTurn.of(np.array(self.rows).T)

    def block(self, field: Field) -> np.ndarray:
        return np.array(self.rows, dtype=float) if field.kind.width == 3 else np.eye(field.item_width)


def test_turns_in_space_and_agents(legs) -> None:
    about_z, about_x = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    octa = FiniteGroup.generated_by("octa", [SpaceTurn.of(about_z), SpaceTurn.of(about_x)])
    assert octa.order == 24
    assert octa.elements[0].is_identity
    parse.READERS.append(lambda word, _: octa if word == "octa" else None)
    space = Kind("vector3", 3, is_vector=True)
    symmetry = Symmetry(
        observation=layout(Field("position", space), Field("mass", Kind.SCALAR)),
        action=Continuous(layout(Field("force", space))),
        group="octa*agents",
        num_agents=2,
        copies="all",
    )
    obs, force = torch.randn(4, 2, 4, dtype=torch.float64), torch.randn(4, 2, 3, dtype=torch.float64)
    assert symmetry.augment(obs, force)[0].shape == (4 * 48, 2, 4)
    assert symmetry.policy_loss(lambda x: x[..., 3:] * x[..., :3], obs) < 1e-12
    assert symmetry.policy_loss(lambda x: x[..., :3].abs(), obs) > 0.1, "the control"
    turn = build_transform([Element.of(SpaceTurn.of(about_z)) @ Element(permutation=(1, 0))], symmetry.spaces)
    assert turn.obs(torch.tensor([[1.0, 2, 3, 7], [4, 5, 6, 8]])).tolist() == [[-5, 4, 6, 8], [-2, 1, 3, 7]]
