"""Pictures turn by moving pixels, and Eq. 5 and 6 hold exactly in wildlife monitoring."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from esp_cli.symmetry import Transform, build_transform, carried_groups, mirror, parse_elements, rotation
from esp_cli.symmetry.maps import Gather
from esp_cli.symmetry.plane import PlaneElement, picture_sources
from esp_envs import Environment, make
from tests.symmetry.checks import environment_errors

STEPS = 6


def turn_picture(picture: Tensor, element) -> Tensor:
    sources = picture_sources(tuple(picture.shape), PlaneElement.of(element).matrix)
    return picture.flatten()[torch.as_tensor(sources)].view(picture.shape)


def test_a_picture_turns_counter_clockwise() -> None:
    picture = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert turn_picture(picture, rotation(90)).tolist() == [[2, 4], [1, 3]]
    assert turn_picture(picture, mirror(0)).tolist() == [[3, 4], [1, 2]]  # in the x-axis: top and bottom swap
    odd = torch.arange(15.0).view(3, 5)
    assert torch.equal(turn_picture(odd, rotation(180)), odd.flip((0, 1)))
    assert torch.equal(turn_picture(torch.arange(9.0).view(3, 3), rotation(90)), torch.arange(9.0).view(3, 3).rot90())


def worlds(elements: str, seeds: int | None = None, **settings) -> tuple[Environment, Transform]:
    probe = make("wildlife", 1, [0], settings)
    listed = parse_elements(elements, probe.spec.num_agents)
    env = make("wildlife", 30, range(seeds or len(listed)), settings)
    env.reset()
    return env, build_transform(listed, env.spec)


def errors(env: Environment, transform: Transform, turn_chance: bool = True) -> dict[str, float]:
    plan = env.plan.clone()
    state = torch.stack([env.plan[k % len(env.plan), 0, :, 1:] for k in range(env.num_seeds)]).flatten(-2).float()
    state = state.clamp(-2, 2)  # crowded, so that drones meet and poachers are trapped

    def restore(same: Environment, turned: Transform | None) -> None:
        matrix = torch.eye(2).expand(same.num_seeds, 2, 2)
        order = list(range(same.settings.num_agents))
        same.plan.copy_(plan)
        if turned is not None and turn_chance:
            planar = np.stack([PlaneElement.of(e).matrix for e in turned.elements])
            matrix = torch.as_tensor(planar, dtype=torch.float32)
            same.plan.copy_(torch.einsum("sij,tsenj->tseni", matrix.expand(same.num_seeds, 2, 2), plan.float()))
            for s, element in enumerate(turned.elements):
                for i, place in enumerate(element.permutation or order):
                    moved = (plan[:, s, :, 1 + i].float() @ matrix[s].T).to(plan.dtype)
                    same.plan[:, s, :, 1 + place] = moved

    return environment_errors(env, transform, state, [env.random_action() for _ in range(STEPS)], restore)


SIZES = [("d4", {}), ("d4*agents", {"width": 5, "height": 5}), ("d2", {"width": 5, "height": 7})]


@pytest.mark.parametrize("convention", ["esp", "corrected"])
@pytest.mark.parametrize(("group", "size"), SIZES, ids=str)
def test_every_declared_transform_leaves_reward_and_transition_alone(group, size, convention) -> None:
    env, transform = worlds(group, convention=convention, **size)
    assert carried_groups(env.spec)[-2] == group.split("*")[0]
    measured = errors(env, transform)
    assert measured == dict.fromkeys(("observation", "reward", "next_obs", "next_state", "end"), 0.0)


def test_the_check_sees_poachers_trapped() -> None:
    env, _ = worlds("d4")
    ends = sum(int(env.step(env.heuristic()).terminated.sum()) for _ in range(STEPS))
    assert ends > 20


def test_a_wrong_action_table_is_noticed() -> None:
    env, right = worlds("rot90")
    wrong = replace(right, action_index=build_transform([mirror(0)], env.spec).action_index)
    measured = errors(env, wrong)
    assert measured["observation"] == 0
    assert min(measured["next_state"], measured["next_obs"]) >= 1
    assert measured["end"] == 1
    assert measured["reward"] > 0.1


def test_pictures_that_do_not_turn_along_are_noticed() -> None:
    env, right = worlds("rot90")
    assert isinstance(right.obs_map, Gather)
    still = right.obs_map.source.clone()
    pixels = env.spec.observation.slices()["picture"]
    still[:, pixels] = torch.arange(pixels.start, pixels.stop)
    assert errors(env, replace(right, obs_map=replace(right.obs_map, source=still)))["observation"] == 1


def test_a_poacher_whose_moves_are_not_turned_along_is_noticed() -> None:
    env, transform = worlds("d4")
    assert errors(env, transform, turn_chance=False)["next_state"] >= 1
