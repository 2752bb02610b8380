"""Transforms of batches against elementwise definitions, and the drawing of elements."""

import pytest
import torch

from esp_cli.symmetry import Element, Transform, build_transform, mirror, rotation, transform_set
from esp_cli.symmetry.maps import Dense, Gather
from esp_cli.symmetry.representation import state_operator
from esp_envs.spec import Field, Items, Kind, Spaces, joint_layout, layout
from tests.symmetry.toy_actions import EVERYTHING, FORCE, FOUR_DIRECTIONS, WHEELS

ELEMENTS = [rotation(90), mirror(0), rotation(270)]
MOVING = [rotation(90) @ Element(permutation=(1, 2, 0)), mirror(45), Element(permutation=(0, 2, 1))]
BATCHES = [(4,), (2, 3), (0,), ()]


def batch(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def sigma(element: Element) -> tuple[int, ...]:
    return element.permutation or (0, 1, 2)


def per_action(transform: Transform, x: torch.Tensor) -> torch.Tensor:
    """Return what counts over actions [S, ..., N, A] where K_g brings it."""
    return transform.output_map.push(x.reshape(transform.num_seeds, -1, transform.output_map.width)).reshape(x.shape)


def test_rows_by_hand(make_spec) -> None:
    transform = build_transform([rotation(90), mirror(0)], make_spec(num_agents=2))
    #                 velocity battery rate wheels  landmarks   other  tags
    row = torch.tensor([1.0, 2, 7, 3, 0.25, 0.5, 1, 0, 0, 1, 4, 5, 8, 9]).expand(2, 1, 2, 14)
    turned, mirrored = transform.obs(row)[:, 0, 0]
    assert turned.tolist() == [-2, 1, 7, 3, 0.25, 0.5, 0, 1, -1, 0, -5, 4, 8, 9]
    assert mirrored.tolist() == [1, -2, 7, -3, 0.5, 0.25, 1, 0, 0, -1, 4, -5, 8, 9]


def seeing(side: int, joint: bool) -> Spaces:
    """Return spaces of three agents that see a picture; the state holds all that they see, or pictures of its own."""
    picture = Field("picture", Kind.PICTURE, pixels=(side, side))
    observation = layout(picture, Field("others", Kind.VECTOR, 2, items=Items.OTHERS))
    own = layout(
        Field("positions", Kind.VECTOR, 3, items=Items.AGENTS),
        Field("map", Kind.PICTURE, pixels=(side, side)),
        Field("views", Kind.PICTURE, 3, pixels=(side, side), items=Items.AGENTS),
        Field("rate", Kind.PSEUDOSCALAR),
    )
    return Spaces(
        num_agents=3,
        observation=observation,
        state=joint_layout(observation, 3) if joint else own,
        action=FOUR_DIRECTIONS,
        symmetry="d4*agents",
    )


@pytest.mark.parametrize("joint", [True, False], ids=["joint", "own"])
@pytest.mark.parametrize("elements", [ELEMENTS, [*MOVING, rotation(180)]], ids=["plane", "agents"])
def test_states_with_pictures_are_gathered_and_equal_the_matrix(elements, joint) -> None:
    spaces = seeing(7, joint)
    transform = build_transform(elements, spaces)
    matrix = Dense(torch.as_tensor(state_operator(spaces, elements).matrix, dtype=torch.float32))
    state = batch(len(elements), 5, spaces.state.width)
    assert isinstance(transform.state_map, Gather)
    assert torch.equal(transform.state(state), matrix.push(state))
    assert torch.equal(transform.state_map.pull(state), matrix.pull(state))
    assert not torch.equal(transform.state(state), state), "the control"


@pytest.mark.parametrize("joint", [True, False], ids=["joint", "own"])
def test_states_with_pictures_of_84_by_84_pixels_are_no_matrix_of_their_square(joint) -> None:
    """The matrices of the 48 elements would take some 86 GB in the joint state, more in the own one."""
    spaces = seeing(84, joint)
    *_, last = transform_set("d4*agents", spaces).each()
    state = batch(1, 1, spaces.state.width)
    assert torch.equal(last.state_map.pull(last.state(state)), state)


@pytest.mark.parametrize("lead", BATCHES, ids=str)
@pytest.mark.parametrize("elements", [ELEMENTS, MOVING], ids=["plane", "agents"])
def test_actions_and_pull_back_against_their_definitions(make_spec, elements, lead) -> None:
    transform = build_transform(elements, make_spec())
    action = torch.randint(5, (3, *lead, 3), generator=torch.Generator().manual_seed(0))
    logits = batch(3, *lead, 3, 5)
    moved, home, one_hot = transform.action(action), transform.pull_back(logits), per_action(transform, logits)
    for s, element in enumerate(elements):
        k = transform.action_index[s]
        for n in range(3):
            there = sigma(element)[n]
            assert torch.equal(moved[s, ..., there], k[action[s, ..., n]])
            assert torch.equal(home[s, ..., n, :], logits[s, ..., there, :][..., k])
            assert torch.equal(one_hot[s, ..., there, :][..., k], logits[s, ..., n, :])


@pytest.mark.parametrize("action", [FORCE, WHEELS, EVERYTHING], ids=["force", "wheels", "everything"])
@pytest.mark.parametrize("elements", [ELEMENTS, MOVING], ids=["plane", "agents"])
def test_continuous_actions_come_home(make_spec, elements, action) -> None:
    transform = build_transform(elements, make_spec(action=action))
    x = batch(3, 2, 4, 3, action.width)
    assert torch.equal(transform.pull_back(transform.action(x)), x)


@pytest.mark.parametrize("elements", [ELEMENTS, MOVING], ids=["plane", "agents"])
def test_variances_come_home_as_squares_of_numbers_do(make_spec, elements) -> None:
    transform = build_transform(elements, make_spec(action=EVERYTHING))
    x = batch(3, 2, 4, 3, EVERYTHING.width)
    assert torch.equal(transform.pull_back_variance(x.square()), transform.pull_back(x).square())
    assert not torch.equal(transform.pull_back_variance(x.square()), x.square())


def test_continuous_actions_by_hand(make_spec) -> None:
    transform = build_transform([rotation(90) @ Element(permutation=(1, 0))], make_spec(2, EVERYTHING))
    x = torch.tensor([[[1.0, 2, 3, 4, 5], [6, 7, 8, 9, 10]]])[None]
    assert transform.action(x)[0, 0].tolist() == [[-7, 6, 8, 9, 10], [-2, 1, 3, 4, 5]]
    flip = build_transform([mirror(0)], make_spec(2, EVERYTHING))
    assert flip.action(x)[0, 0].tolist() == [[1, -2, 4, 3, -5], [6, -7, 9, 8, -10]]


@pytest.mark.parametrize("elements", [ELEMENTS, MOVING], ids=["plane", "agents"])
def test_the_inverse_elements_undo(make_spec, elements) -> None:
    spec = make_spec()
    there, back = build_transform(elements, spec), build_transform([e.inverse() for e in elements], spec)
    obs, state, logits = batch(3, 5, 3, spec.observation.width), batch(3, 5, spec.state.width), batch(3, 5, 3, 5)
    assert torch.equal(back.obs(there.obs(obs)), obs)
    assert torch.equal(back.state(there.state(state)), state)
    assert torch.equal(there.pull_back(per_action(there, logits)), logits)
    assert torch.equal(back.per_agent(there.per_agent(obs[..., 0])), obs[..., 0])
    assert torch.equal(there.values(there.per_agent(obs[..., 0])), obs[..., 0])


def test_values(make_spec) -> None:
    moving = build_transform([Element(permutation=(1, 2, 0))], make_spec())
    v = torch.tensor([[[10.0, 11, 12]]])
    assert moving.per_agent(v).tolist() == [[[12, 10, 11]]]
    assert moving.values(v).tolist() == [[[11, 12, 10]]]
    assert moving.values(v[..., :1]).tolist() == [[[10]]]
    assert build_transform([rotation(90)], make_spec()).values(v) is v
    with pytest.raises(ValueError, match=r"axis -1 of \[1, 3, 1\] must hold 3 agents"):
        moving.action(torch.zeros(1, 3, 1, dtype=torch.int64))


def test_one_element_serves_any_number_of_seeds(make_spec) -> None:
    spec = make_spec()
    one, three = build_transform([MOVING[0]], spec), build_transform([MOVING[0]] * 3, spec)
    x, logits = batch(3, 2, 4, 3, spec.observation.width), batch(3, 2, 4, 3, 5)
    assert torch.equal(one.obs(x), three.obs(x))
    assert torch.equal(one.pull_back(logits), three.pull_back(logits))


def test_one_element_needs_no_seed_axis(make_spec) -> None:
    spec = make_spec()
    for element in (rotation(90), MOVING[0]):
        transform = build_transform([element], spec)
        x, state, action = (
            batch(2, 4, 3, spec.observation.width),
            batch(2, 4, spec.state.width),
            batch(2, 4, 3, 5).argmax(-1),
        )
        for name, data in {
            "obs": x,
            "state": state,
            "action": action,
            "pull_back": x[..., :5],
            "values": x[..., 0],
        }.items():
            act = getattr(transform, name)
            torch.testing.assert_close(act(data[0]), act(data)[0], rtol=0, atol=0)
            torch.testing.assert_close(act(data[0, 0]), act(data)[0, 0], rtol=0, atol=0)


def test_rows_need_no_agent_axis_where_agents_stay(make_spec) -> None:
    spec = make_spec()
    transform = build_transform(ELEMENTS, spec)
    x, logits = batch(3, 4, 3, spec.observation.width), batch(3, 4, 3, 5)
    assert torch.equal(transform.obs(x.flatten(1, 2)), transform.obs(x).flatten(1, 2))
    assert torch.equal(transform.pull_back(logits.flatten(1, 2)), transform.pull_back(logits).flatten(1, 2))


def test_gradients_flow_back_through_the_pull_back(make_spec) -> None:
    logits = batch(3, 4, 3, 5).requires_grad_()
    weight = batch(3, 4, 3, 5)
    transform = build_transform(MOVING, make_spec())
    (transform.pull_back(logits) * weight).sum().backward()
    assert torch.equal(logits.grad, per_action(transform, weight))


def test_shapes_are_checked(make_spec) -> None:
    spec = make_spec()
    width = spec.observation.width
    with pytest.raises(ValueError, match="of 3 seeds was given data of 2"):
        build_transform(ELEMENTS, spec).obs(batch(2, 4, 3, width))
    with pytest.raises(ValueError, match=f"{width} numbers was given rows of 5"):
        build_transform(ELEMENTS, spec).obs(batch(3, 4, 3, 5))
    for lead in ((3, 4, 2), (3, 12)):
        with pytest.raises(ValueError, match="must hold 3 agents"):
            build_transform(MOVING, spec).obs(batch(*lead, width))
    with pytest.raises(ValueError, match="of 5 numbers was given rows of 2"):
        build_transform(ELEMENTS, spec).pull_back(batch(3, 4, 3, 2))
    with pytest.raises(ValueError, match="of 2 numbers was given rows of 5"):
        build_transform(ELEMENTS, make_spec(action=FORCE)).pull_back(batch(3, 4, 3, 5))
    with pytest.raises(ValueError, match="one element per seed"):
        build_transform([], spec)


def test_sets_know_their_elements(make_spec) -> None:
    d4 = transform_set("d4", make_spec())
    assert d4.is_finite
    assert d4.size == 7
    assert d4.names[0] == "rot90"
    assert [t.elements[0].name for t in d4.each()] == list(d4.names)
    so2 = transform_set("so2", make_spec(action=FORCE))
    assert (so2.is_finite, so2.size, so2.names) == (False, 0, ("so2",))
    with pytest.raises(ValueError, match="so2 cannot be listed"):
        so2.each()


@pytest.mark.parametrize(
    ("text", "num_agents", "action"),
    [("d4", 3, None), ("d4*agents", 3, None), ("o2", 3, FORCE), ("so2*agents", 3, FORCE), ("d4*agents", 5, None),
     ("agents", 8, None)],
)  # fmt: skip
def test_a_seed_draws_the_same_alone_and_among_ten(make_spec, text, num_agents, action) -> None:
    spec = make_spec(num_agents, action) if action else make_spec(num_agents)
    transforms = transform_set(text, spec)

    def draws(seeds: list[int], times: int = 5) -> list[Transform]:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        return [transforms.draw(generators) for _ in range(times)]

    together, alone = draws(list(range(10))), draws([7])
    assert [t.elements[7] for t in together] == [t.elements[0] for t in alone]
    row = batch(1, 1, num_agents, spec.observation.width)
    assert torch.equal(together[-1].obs(row.expand(10, -1, -1, -1))[7], alone[-1].obs(row)[0])
    assert not any(e.is_identity for t in together for e in t.elements)
    assert len({e for t in together for e in t.elements}) > 5


def test_draws_equal_what_is_built_from_the_drawn_elements(make_spec, generators) -> None:
    spec = make_spec()
    drawn = transform_set("d4*agents", spec).draw(generators)
    built = build_transform(drawn.elements, spec)
    x = batch(3, 4, 3, spec.observation.width)
    assert torch.equal(drawn.obs(x), built.obs(x))
    assert torch.equal(drawn.pull_back(x[..., :5]), built.pull_back(x[..., :5]))


def test_every_element_is_drawn_about_equally_often(make_spec) -> None:
    generator = torch.Generator().manual_seed(0)
    transforms = transform_set("c4", make_spec())
    counts = dict.fromkeys(transforms.names, 0)
    for _ in range(300):
        counts[transforms.draw([generator]).elements[0].name] += 1
    # 100 expected with a standard deviation of 8.2.
    assert all(70 < count < 130 for count in counts.values())


def test_large_listed_sets_are_built_as_drawn(make_spec, generators) -> None:
    spec = make_spec(5)
    transforms = transform_set("d4*agents", spec)
    assert transforms.size == 8 * 120 - 1
    assert transforms.draw(generators).obs_map.matrix.shape == (
        3,
        5 * spec.observation.width,
        5 * spec.observation.width,
    )
    assert len(transforms.each()) == transforms.size


@pytest.mark.gpu
@pytest.mark.parametrize("text", ["d4", "d4*agents"])
def test_a_gpu_draws_and_computes_the_same(make_spec, text) -> None:
    spec = make_spec()

    def draw(device: str) -> Transform:
        return transform_set(text, spec, device).draw([torch.Generator().manual_seed(seed) for seed in range(3)])

    here, there = draw("cpu"), draw("cuda")
    assert here.elements == there.elements
    obs, state, logits = batch(3, 5, 3, spec.observation.width), batch(3, 5, spec.state.width), batch(3, 5, 3, 5)
    action = torch.randint(5, (3, 5, 3), generator=torch.Generator().manual_seed(0))
    assert torch.equal(here.obs(obs), there.obs(obs.cuda()).cpu())
    assert torch.equal(here.state(state), there.state(state.cuda()).cpu())
    assert torch.equal(here.action(action), there.action(action.cuda()).cpu())
    assert torch.equal(here.pull_back(logits), there.pull_back(logits.cuda()).cpu())


def test_rows_of_no_numbers_stay():
    seen = layout(Field("others", Kind.VECTOR, 0))
    spaces = Spaces(num_agents=1, observation=seen, state=seen, action=FOUR_DIRECTIONS, symmetry="d4")
    transform = build_transform([rotation(90)], spaces)
    assert transform.obs(torch.zeros(1, 3, 1, 0)).shape == (1, 3, 1, 0)
    assert transform.state(torch.zeros(1, 3, 0)).shape == (1, 3, 0)
