"""The physics against numbers worked out by hand."""

import math

import pytest
import torch

from esp_envs.mpe.particles import Bodies, ParticleWorlds, exact_matmul

CPU = torch.device("cpu")
FREE = Bodies(radius=(0.15,), gain=(5.0,), max_speed=None, contacts=())
PAIR = Bodies(radius=(0.15, 0.15), gain=(5.0, 5.0), max_speed=None, contacts=((0, 1),))


def worlds_with(bodies: Bodies, positions: list[list[float]], velocity_first: bool = True) -> ParticleWorlds:
    worlds = ParticleWorlds(bodies, 1, CPU, velocity_first)
    worlds.entity[:, :, 0] = torch.tensor(positions)
    worlds.measure()
    return worlds


def push(worlds: ParticleWorlds, *controls: tuple[float, float]) -> None:
    control = torch.zeros(len(controls), 2, worlds.num_lanes)
    control[:, :, 0] = torch.tensor(controls)
    worlds.advance(control)


@pytest.mark.parametrize(("velocity_first", "place"), [(True, [0.23, -0.05]), (False, [0.24, -0.1])])
def test_a_step_by_hand(velocity_first: bool, place: list[float]) -> None:
    worlds = worlds_with(FREE, [[0.2, -0.1]], velocity_first)
    worlds.velocity[0, :, 0] = torch.tensor([0.4, 0.0])
    push(worlds, (0.0, 1.0))
    # v = 0.75 (0.4, 0) + 0.1 * 5 (0, 1) = (0.3, 0.5);  x = (0.2, -0.1) + 0.1 v, or by the old velocity
    torch.testing.assert_close(worlds.velocity[0, :, 0], torch.tensor([0.3, 0.5]))
    torch.testing.assert_close(worlds.position[0, :, 0], torch.tensor(place))


def test_speed_is_capped_and_keeps_its_direction() -> None:
    worlds = worlds_with(Bodies((0.05,), (4.0,), (1.3,), ()), [[0.0, 0.0]])
    worlds.velocity[0, :, 0] = torch.tensor([3.0, 4.0])
    push(worlds, (0.0, 0.0))
    # 0.75 * 5 = 3.75 is above 1.3, so the velocity becomes 1.3 (0.6, 0.8)
    torch.testing.assert_close(worlds.velocity[0, :, 0], torch.tensor([0.78, 1.04]))
    push(worlds, (0.0, 0.0))
    torch.testing.assert_close(worlds.velocity[0, :, 0], torch.tensor([0.585, 0.78]))


def test_overlapping_bodies_push_each_other_apart() -> None:
    worlds = worlds_with(PAIR, [[-0.1, 0.0], [0.1, 0.0]])
    push(worlds, (0.0, 0.0), (0.0, 0.0))
    # overlap 0.3 - 0.2 = 0.1, softplus(100) = 100: force 100 * 0.1 = 10, velocity +-0.1 * 10 = +-1
    torch.testing.assert_close(worlds.velocity[:, 0, 0], torch.tensor([-1.0, 1.0]))
    assert worlds.velocity[:, 1, 0].abs().max() == 0


@pytest.mark.parametrize(("apart", "speed"), [(0.3, 0.01 * math.log(2)), (0.5, 0.0)])
def test_bodies_that_just_touch_feel_the_soft_margin_and_distant_ones_nothing(apart: float, speed: float) -> None:
    worlds = worlds_with(PAIR, [[0.0, 0.0], [0.0, apart]])
    push(worlds, (0.0, 0.0), (0.0, 0.0))
    # no overlap: force 100 * 1e-3 * ln 2, velocity 0.1 of it
    assert worlds.velocity[1, 1, 0].item() == pytest.approx(speed, rel=1e-3, abs=1e-20)


def test_coinciding_centres_stay_finite() -> None:
    worlds = worlds_with(PAIR, [[0.3, 0.3], [0.3, 0.3]])
    push(worlds, (1.0, 0.0), (0.0, 0.0))
    torch.testing.assert_close(worlds.velocity[:, 0, 0], torch.tensor([0.5, 0.0]))


def test_fixed_bodies_push_but_do_not_move() -> None:
    bodies = Bodies((0.05, 0.2), (4.0,), (1.3,), ((0, 1),))
    worlds = worlds_with(bodies, [[0.2, 0.0], [0.0, 0.0]])
    push(worlds, (0.0, 0.0))
    # overlap 0.05: force 5, velocity 0.5
    torch.testing.assert_close(worlds.velocity[0, :, 0], torch.tensor([0.5, 0.0]))
    assert worlds.entity[1, :, 0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("count", [1, 5, 63, 64, 65, 200])
def test_a_world_does_not_depend_on_how_many_stand_beside_it(count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    start = torch.rand(4, 2, count, generator=generator) - 0.5
    control = torch.rand(2, 2, count, generator=generator) * 2 - 1
    together = run_from(start, control)
    for k in {0, count // 2, count - 1}:
        alone = run_from(start[:, :, k : k + 1], control[:, :, k : k + 1])
        assert torch.equal(alone, together[:, k : k + 1])


def run_from(start: torch.Tensor, control: torch.Tensor) -> torch.Tensor:
    """Return the physics [rows, W] of pairs after ten steps of the same control."""
    worlds = ParticleWorlds(PAIR, start.shape[-1], CPU)
    worlds.rows.copy_(start.reshape(8, -1))
    worlds.measure()
    padded = torch.zeros(2, 2, worlds.num_lanes)
    padded[:, :, : start.shape[-1]] = control
    for _ in range(10):
        worlds.advance(padded)
    return worlds.rows.clone()


def test_products_stay_exact_when_torch_may_round_them() -> None:
    generator = torch.Generator().manual_seed(0)
    right = torch.rand(16, 512, generator=generator)
    left = torch.zeros(40, 16)
    left[range(40), [k % 16 for k in range(40)]] = 1.0
    left[range(40), [(k + 3) % 16 for k in range(40)]] = -1.0
    expected = torch.stack([right[k % 16] - right[(k + 3) % 16] for k in range(40)])
    assert torch.equal(exact_matmul(left, right), expected)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        assert torch.equal(exact_matmul(left, right), expected)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert not torch.equal((left @ right).float(), expected)
            assert torch.equal(exact_matmul(left, right), expected)
    finally:
        torch.set_float32_matmul_precision(before)
